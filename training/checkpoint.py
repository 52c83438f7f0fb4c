"""A run's folder: its plan, its curve, and after every iteration all that is needed to go on to the very same bits."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from drivers.description import UNDECODABLE
from training import pgpe
from training.plan import RunPlan


class RunError(ValueError):
    """A run folder that cannot be used: the message names the file and what is wrong."""


@dataclass(frozen=True, slots=True)
class Row:
    """One iteration of the learning curve."""

    stage: str
    iteration: int
    """Counted over the whole run."""
    mean_return: float
    """Of the mean itself, one episode."""
    population_mean: float
    population_best: float
    survival: float
    """Share of the population's episodes that ended without a fall."""
    lost: int
    """Episodes without a usable number."""
    steps: int
    """Ticks simulated."""
    stdev: float
    seconds: float
    terms: dict[str, float]
    """Of the mean's episode."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """After ``iteration`` iterations in all, ``state.iteration`` of them in stage number ``stage``."""

    stage: int
    iteration: int
    state: pgpe.State


class RunFolder:
    """Where a run lives. Every file is written whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(self, plan: RunPlan, about: dict[str, Any]) -> None:
        """Write down what will be done, with what.

        Raises:
            RunError: the folder already holds a run.
        """
        if (self.path / "run.json").exists():
            raise RunError(f"{self.path} already holds a run: resume it with --resume or choose another folder")
        (self.path / "checkpoints").mkdir(parents=True, exist_ok=True)
        write_whole(self.path / "versions.json", json.dumps(about, indent=1).encode())
        write_whole(self.path / "run.json", msgspec.json.format(msgspec.json.encode(plan), indent=1))

    def plan(self, config_hash: str) -> RunPlan:
        """What the run was to do.

        Raises:
            RunError: no run here, not readable, or made for another config.
        """
        file = self.path / "run.json"
        try:
            plan = msgspec.json.decode(file.read_bytes(), type=RunPlan)
        except FileNotFoundError as error:
            raise RunError(f"{self.path}: no run here (no run.json)") from error
        except UNDECODABLE as error:
            raise RunError(f"{file}: {error}") from error
        if plan.config != config_hash:
            raise RunError(
                f"{file}: made for config {plan.config}, the robot's is {config_hash} now: start a new run, "
                f"or bring the robot's TOML back"
            )
        return plan

    def save(self, checkpoint: Checkpoint, policy: bytes, row: Row | None) -> None:
        """Add an iteration.

        Raises:
            OSError: the disk is full; earlier checkpoints stay usable.
        """
        stem = self.path / "checkpoints" / f"{checkpoint.iteration:04d}"
        write_whole(stem.with_suffix(".json"), policy)
        if row is not None:
            rows = [old for old in self.curve() if old.iteration < row.iteration]
            lines = [json.dumps(asdict(one)) for one in (*rows, row)]
            write_whole(self.path / "curve.jsonl", ("\n".join(lines) + "\n").encode())
        arrays = asdict(checkpoint.state) | {"stage": checkpoint.stage, "total": checkpoint.iteration}
        _write(stem.with_suffix(".npz"), lambda file: np.savez(file, **arrays))

    def curve(self) -> list[Row]:
        """The iterations so far."""
        file = self.path / "curve.jsonl"
        if not file.exists():
            return []
        return [Row(**json.loads(line)) for line in file.read_text().splitlines()]

    def policy_file(self, iteration: int) -> Path:
        """The mean after ``iteration`` iterations, as a policy file."""
        return self.path / "checkpoints" / f"{iteration:04d}.json"

    def iterations(self) -> list[int]:
        """Which checkpoints there are, oldest first."""
        return sorted(int(file.stem) for file in (self.path / "checkpoints").glob("[0-9]*.npz"))

    def load(self, iteration: int | None = None) -> Checkpoint:
        """A checkpoint, the newest readable one if not said which.

        Raises:
            RunError: there is none.
        """
        for number in reversed(self.iterations()):
            if iteration is not None and number != iteration:
                continue
            try:
                return _read(self.path / "checkpoints" / f"{number:04d}.npz")
            except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
                continue
        which = "no checkpoint" if iteration is None else f"no checkpoint {iteration}"
        raise RunError(f"{self.path}: {which} that can be read")


def _read(path: Path) -> Checkpoint:
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        arrays = {name: file[name] for name in ("mean", "stdev", "gradient_mean", "gradient_square")}
        state = pgpe.State(iteration=int(file["iteration"]), **arrays)
        return Checkpoint(int(file["stage"]), int(file["total"]), state)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that a reader never sees half of it."""
    _write(path, lambda file: file.write(data))


def _write(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            fill(file)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
