"""What the last run of the fault matrix measured, as a table for ``docs/failsafe.md``.

The figures are those that ``python tests/torture.py --keep docs/torture.json`` wrote; this only sets them.
"""

from __future__ import annotations

from pathlib import Path

import msgspec


class Worst(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The worst of one row of the matrix in one gait."""

    faults: int
    ends: dict[str, int]
    """Mode and fault at the end → how often."""
    answered_ticks: int | None
    """From the injection to the answer."""
    ticks_from_evidence: int | None
    """From the first reading that was past a bound of the configuration to the answer."""
    torque: float
    """N·m, in any sample."""
    joint_speed: float
    """rad/s."""
    impact: float | None
    """Speed of the body as it touched the ground, m/s."""
    falls_before_answer: int
    violations: int


HEAD = """
## What was measured

The worst of each row of the matrix (`tests/faults/matrix.py`), from `docs/torture.json`, which
`make torture ARGS="--keep docs/torture.json"` writes. Ticks to the answer count from the injection, which may be long
before anything shows; those from the evidence count from the first reading past a bound of the configuration, and a
minus says that the guard answered before there was one. Torque and joint speed are the largest in any sample after the
fault, m/s is the body's speed as it touched the ground.

| row | gait | faults | ends | ticks to answer | from evidence | N·m | rad/s | m/s | fell before | violations |
|---|---|---|---|---|---|---|---|---|---|---|
"""


def figures(path: Path) -> str:
    """The table of the file at ``path``.

    Raises:
        OSError: no such file.
        msgspec.ValidationError: not a file of torture's.
    """
    rows = msgspec.json.decode(path.read_bytes(), type=dict[str, dict[str, Worst]])
    return HEAD + "".join(_line(row, gait, worst) for row, gaits in rows.items() for gait, worst in gaits.items())


def _line(row: str, gait: str, worst: Worst) -> str:
    ends = ", ".join(f"{end.lower()} {count}" for end, count in list(worst.ends.items())[:3])
    cells = (
        f"`{row}`",
        gait,
        worst.faults,
        ends,
        _or_dash(worst.answered_ticks),
        _or_dash(worst.ticks_from_evidence),
        f"{worst.torque:.1f}",
        f"{worst.joint_speed:.1f}",
        "–" if worst.impact is None else f"{worst.impact:.2f}",
        worst.falls_before_answer,
        worst.violations,
    )
    return f"| {' | '.join(map(str, cells))} |\n"


def _or_dash(value: int | None) -> str:
    return "–" if value is None else str(value)
