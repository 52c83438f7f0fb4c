"""The engine behind the world: one import, no word printed, no client left, the same bits for the same scenario."""

from __future__ import annotations

import _ctypes
import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pybullet
import pytest
from worlds import FIELD, HEIGHT, STOCH3, stoch3_world, trot_in_place

import sim
from sim.bullet.native import find_client
from sim.errors import PhysicsError, SimulatorMissing
from sim.scenario import Noise, Push, Scenario
from sim.terrain import Slope, Steps
from sim.truth import Truth
from sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with stoch3_world() as world:
        yield world


SCENARIOS = (
    Scenario(rpy=(0.1, 0.0, 0.2)),
    Scenario(terrain=Slope(0.15), friction=0.6),
    Scenario(
        payload=3.0, friction=0.4, motor_strength=0.8, extra_delay=0.007, seed=5, noise=Noise(0.01, 0.1, 0.2, 0.01)
    ),
    Scenario(terrain=FIELD),
    Scenario(terrain=Steps(0.05, start=0.2)),
    Scenario(rpy=(3.1, 0.0, 0.0), height=1.0, pushes=(Push(0.1, 0.1, (0.0, 300.0, 0.0)),)),
)


def test_the_same_scenario_gives_the_same_bits_whatever_came_before(world: World) -> None:
    fresh = []
    for scenario in SCENARIOS:
        other = World(STOCH3, 200.0, HEIGHT)
        fresh.append(trot_in_place(other, scenario, 120))
        other.close()
    order = [0, 1, 0, 2, 2, 5, 0, 3, 1, 5, 4, 3, 3, 0, 2, 1]
    for length, index in enumerate(order):
        run = trot_in_place(world, SCENARIOS[index], 120)
        np.testing.assert_array_equal(run, fresh[index], err_msg=f"scenario {index} after {order[:length]}")
    assert len({run.tobytes() for run in fresh}) == len(SCENARIOS)


def test_physics_steps_in_compiled_code_have_the_bits_of_pybullets_module(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim.bullet.engine.find_client", lambda library, client: 0)  # as in a build without symbols
    plain = World(STOCH3, 200.0, HEIGHT)
    assert world._robot.direct and not plain._robot.direct
    for scenario in (*SCENARIOS, replace(SCENARIOS[0], rpy=(3.1, 0.0, 0.0))):
        runs = [trot_in_place(each, scenario, 120) for each in (world, plain)]
        np.testing.assert_array_equal(*runs)
        for field in fields(Truth):
            truths = [getattr(each.truth, field.name) for each in (world, plain)]
            np.testing.assert_array_equal(*truths, err_msg=field.name)
        np.testing.assert_array_equal(world.foot_contacts, plain.truth.foot_contacts)
        assert world.fallen() == plain.fallen()
    plain.close()


def test_a_library_without_pybullets_symbols_has_no_client() -> None:
    assert find_client(Path(_ctypes.__file__), 0) == 0


def test_close_releases_the_physics_client() -> None:
    world = World(STOCH3, 200.0, HEIGHT)
    client = world._engine.client
    assert pybullet.isConnected(client)
    world.close()
    assert not pybullet.isConnected(client)
    world.close()


def test_a_world_that_cannot_be_built_leaves_no_client(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [client for client in range(20) if pybullet.isConnected(client)]
    monkeypatch.setattr("sim.model._with_rotor", lambda inertia, axis, rotor: np.diag([0.1, 0.1, 1.0]))
    with pytest.raises(PhysicsError, match=r"link body: .* triangle"):
        World(STOCH3, 200.0, HEIGHT)
    assert [client for client in range(20) if pybullet.isConnected(client)] == before


def test_without_pybullet_one_line_names_the_python_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(SimulatorMissing, match=r"no PyBullet for Python .* Python 3\.11 on x86_64") as caught:
        World(STOCH3, 200.0, HEIGHT)
    assert "\n" not in str(caught.value)


def test_nothing_is_printed() -> None:
    program = (
        "from runtime.config import ROBOTS, load\nfrom sim.world import World\nfrom sim.scenario import Scenario\n"
        "from sim.terrain import HeightField\n"
        "world = World(load(ROBOTS / 'a1.toml').robot, 200.0, 0.33)\n"
        "world.reset(Scenario(payload=2.0, terrain=HeightField(0.05, extent=2.0)))\nworld.close()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_only_one_file_imports_pybullet() -> None:
    root = Path(sim.__file__).parent
    speakers = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        and any(
            name.startswith("pybullet") for name in [getattr(node, "module", "") or "", *(a.name for a in node.names)]
        )
    ]
    assert speakers == ["bullet/engine.py"]
