"""Force problems of every kind that a robot meets, and many that it never should: seeded, built by the core itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime import config
from runtime.control.grf import GrfProblem, build_qp
from runtime.control.records import CONTROL_DTYPE
from runtime.control.state import build_parameters

KINDS = ("trot", "walk", "stand", "one leg", "none", "extreme", "slope", "hostile")
STANCES = {
    "trot": ((1, 0, 0, 1), (0, 1, 1, 0)),
    "walk": ((0, 1, 1, 1), (1, 0, 1, 1), (1, 1, 0, 1), (1, 1, 1, 0)),
    "stand": ((1, 1, 1, 1),),
    "one leg": ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    "none": ((0, 0, 0, 0),),
}
ROBOTS = ("stoch3", "mini_cheetah", "a1")


@dataclass(frozen=True, slots=True)
class Case:
    """One problem; ``legs`` is what ``build_qp`` answered (-1: not finite)."""

    kind: str
    legs: int
    problem: GrfProblem


class Corpus:
    """Draws problems from one generator; the same seed gives the same problems."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._record = np.zeros(1, CONTROL_DTYPE)
        self._robots = [config.load(config.find_robot(name)) for name in ROBOTS]
        self._parameters = [build_parameters(robot.robot, robot.control) for robot in self._robots]

    def cases(self, count: int) -> Iterator[Case]:
        """The first ``count`` problems; kinds take turns."""
        for index in range(count):
            yield self._draw(KINDS[index % len(KINDS)])

    def _draw(self, kind: str) -> Case:
        rng = self._rng
        index = int(rng.integers(len(ROBOTS)))
        robot, parameters = self._robots[index].robot, self._parameters[index].copy()
        p = parameters[0]
        record: Any = self._record[0]
        family = kind if kind in STANCES else ("trot", "walk", "stand")[int(rng.integers(3))]
        stances = STANCES[family]
        record["stance"] = stances[int(rng.integers(len(stances)))]
        size = robot.reach / 0.614
        feet = np.column_stack([p["nominal_footholds"], np.full(4, -0.85 * robot.reach)])
        feet += rng.normal(0.0, [0.08, 0.05, 0.02], (4, 3)) * size
        com = p["com"].copy()
        if kind == "slope":
            tilt = _tilt(*rng.uniform(-0.6, 0.6, 2))
            feet, com = feet @ tilt.T, tilt @ com
            p["friction"] = rng.uniform(0.2, 1.2)
        record["feet"] = feet
        record["target_wrench"] = self._wrench(kind, robot.mass, size)
        if kind == "hostile":
            p["min_force"], p["friction"] = rng.choice([0.0, 5.0, 60.0]), rng.uniform(0.05, 2.0)
            p["force_weight"] = 10.0 ** rng.uniform(-3, -1)
        hessian, gradient = np.empty(144), np.empty(12)
        legs = build_qp(_row(parameters), _row(self._record), com, hessian, gradient)
        n = 3 * max(0, legs)
        bounds = (float(p["friction"]), float(p["min_force"]), float(p["max_force"]))
        return Case(kind, legs, GrfProblem(hessian[: n * n].reshape(n, n), gradient[:n], *bounds))

    def _wrench(self, kind: str, mass: float, size: float) -> np.ndarray:
        rng = self._rng
        weight = mass * 9.81
        scale = np.array([0.15, 0.15, 0.2, 0.06 * size, 0.06 * size, 0.03 * size]) * weight
        wrench = rng.normal(size=6) * scale
        if kind in ("extreme", "hostile"):
            wrench *= 10.0 ** rng.uniform(0.0, 2.0)
        wrench[2] += weight
        return wrench


def _row(records: Any) -> Any:
    return records.view(np.recarray)[0]


def _tilt(roll: float, pitch: float) -> np.ndarray:
    c, s = np.cos(roll), np.sin(roll)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    c, s = np.cos(pitch), np.sin(pitch)
    turned: np.ndarray = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ about_x
    return turned
