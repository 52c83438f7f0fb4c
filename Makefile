# make run: the robot walks a tour in the simulator.   make run-wire: the same over the real drivers.   make test: the suite.   make check: lint, types, contracts.
# make torture: the whole fault matrix; make torture ARGS="--row NAME --seed N": one fault again.
# make fuzz: random and mutated bytes at every door; make fuzz ARGS="--door xbus --inputs 1000000": at one.
# make soak: an hour of walking with everybody watching.   make soak-sim HOURS=24: simulated hours of commands and pushes.
# make failsafe: docs/failsafe.md from its table.   make mutation: every guard taken out once; at least one test must see it.
# make bench: what the numbers in docs/performance.md come from.
# Each creates the environment it needs in .venv; PYTHON names the interpreter to make it with.

PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do command -v $$p >/dev/null && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: run run-wire test test-service test-network test-arm64 test-extras check torture soak soak-sim fuzz failsafe mutation bench format clean

run: $(VENV)/.sim
	@$(BIN)/trotd tour

run-wire: $(VENV)/.sim
	@$(BIN)/trotd tour --wire

test: $(VENV)/.dev
	$(BIN)/pytest $(PYTEST_ARGS)

test-service: $(VENV)/.dev
	tests/service.sh

test-network: $(VENV)/.dev
	$(BIN)/pytest tests/test_network.py

test-arm64:
	tests/arm64.sh

torture: $(VENV)/.dev
	@$(BIN)/python tests/torture.py $(ARGS)

fuzz: $(VENV)/.dev
	@$(BIN)/python tests/fuzz.py $(ARGS)

test-extras: $(VENV)/.extras
	$(BIN)/pytest tests/test_training_ray.py tests/test_training_rl.py $(PYTEST_ARGS)

soak: $(VENV)/.dev
	@$(BIN)/python tests/soak.py daemon $(ARGS)

soak-sim: $(VENV)/.dev
	@$(BIN)/python tests/soak.py sim --hours $(or $(HOURS),24) $(ARGS)

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=tests $(BIN)/mypy tests/soak.py tests/torture.py tests/fuzz.py tests/mutation.py tests/faults
	$(BIN)/lint-imports --no-cache

failsafe: $(VENV)/.dev
	@$(BIN)/python -m runtime.failsafe docs/torture.json > docs/failsafe.md

mutation: $(VENV)/.dev
	@$(BIN)/python tests/mutation.py

bench: $(VENV)/.dev
	@$(BIN)/trotd bench

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "trotd needs Python 3.11 or newer: install it, or say make PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { echo "no venv module: on Debian, apt install python3-venv"; exit 2; }

$(VENV)/.sim: $(BIN)/python pyproject.toml constraints.txt
	@$(BIN)/python -c 'import platform, sys; sys.exit(not (sys.version_info < (3, 12) and platform.machine() == "x86_64"))' \
	  || { echo "the simulator (PyBullet) has wheels for Python 3.11 on x86-64 only: make PYTHON=python3.11 run"; exit 2; }
	@echo "installing trotd[sim] into $(VENV) (once) ..."
	@$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[sim]'
	@touch $@

$(VENV)/.dev: $(VENV)/.sim
	@echo "installing trotd[dev] into $(VENV) (once) ..."
	@$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(VENV)/.extras: $(VENV)/.dev
	@echo "installing trotd[ray,rl] into $(VENV) (once; PyTorch is large) ..."
	@$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[ray,rl]'
	@touch $@

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
