"""What a candidate is held against: the active policy in shadow, and itself once it acts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from runtime.control.records import Clamp, SolverStatus
from runtime.parameters import AuditionConfig

TROUBLE = int(Clamp.SHIFT | Clamp.WRENCH | Clamp.REACH | Clamp.JOINT_LIMIT | Clamp.TORQUE)
"""Clamps that tell of a policy that asks too much."""


@dataclass(slots=True)
class Baseline:
    """What the active policy was like before: what a trial is held against."""

    tilt: float = 0.0
    height: float = 0.0
    clamped: float = 0.0
    fell_back: float = 0.0
    mode: int = -1
    """In which it was seen; -1 in none."""


def read_shadow(total: np.void, mode: int) -> tuple[Baseline, dict[str, float]]:
    """What the sums of a shadow (``SUMS_DTYPE``) say of the active policy, and of how the candidate differs from it."""
    ticks = float(total["ticks"])
    size = _size(total)
    before = float(total["clamped_active"]) / ticks
    baseline = Baseline(float(total["tilt"]), float(total["height"]), before, float(total["fell_back"]) / ticks, mode)
    report = {
        "ticks": ticks,
        "shift": math.sqrt(float(total["shift"]) / ticks),
        "force": math.sqrt(float(total["force"]) / ticks),
        "moment": math.sqrt(float(total["moment"]) / ticks),
        "agreement": float(total["along"]) / size if size > 0.0 else 0.0,
        "clamped_before": before,
        "clamped_now": float(total["clamped_candidate"]) / ticks,
    }
    return baseline, report


def object_to_shadow(total: np.void, report: dict[str, float], comparable: bool, config: AuditionConfig) -> str:
    """Why a candidate may not act after its shadow; empty when it may.

    Args:
        total: the sums of the shadow.
        report: of ``read_shadow``.
        comparable: both policies answer with the same quantities, so that their directions can be compared.
        config: the bounds.
    """
    before, now, agreement = report["clamped_before"], report["clamped_now"], report["agreement"]
    if total["not_finite"]:
        return f"in shadow it answered with no number in {int(total['not_finite'])} ticks"
    if now > before + config.clamp_rise:
        return f"in shadow it was at its bounds in {now:.0%} of the ticks, the active one in {before:.0%}"
    if comparable and _size(total) > 0.0 and agreement < config.min_agreement:
        return (
            f"in shadow it asked for the opposite of the active one: agreement {agreement:+.2f},"
            f" bound {config.min_agreement:g}"
        )
    return ""


def _size(total: np.void) -> float:
    return math.sqrt(float(total["active"]) * float(total["candidate"]))


class Watch:
    """One trial: what has risen beyond what the policy before was like."""

    def __init__(self, baseline: Baseline, config: AuditionConfig, dt: float) -> None:
        self._baseline, self._config = baseline, config
        self._follow = dt / config.window
        self._clamped = self._fell_back = 0.0

    def trouble(self, row: np.void, walking: bool, seconds: float) -> str:
        """After a tick, ``seconds`` into the trial: what is too much; empty when nothing is."""
        base, config = self._baseline, self._config
        known = base.mode == int(row["mode"])
        self._clamped += ((int(row["clamps"]) & TROUBLE != 0) - self._clamped) * self._follow
        self._fell_back += ((int(row["solver_status"]) > int(SolverStatus.SOLVED)) - self._fell_back) * self._follow
        slack = 1.0 if known or not walking else 2.0  # nothing to hold the first walk against
        pose = row["tuned_body_pose"]
        tilt = float(np.abs(row["rpy"][:2] - pose[:2] + config.tilt_ahead * row["twist"][3:5]).max())
        height = abs(float(row["height"] - row["tuned_walking_height"] - pose[3]))
        for name, value, before, rise, unit in (
            ("foreseen tilt", tilt, base.tilt, slack * config.tilt_rise, " rad"),
            ("error of the height", height, base.height, slack * config.height_rise, " m"),
            ("share of clamped ticks", self._clamped, base.clamped, slack * config.clamp_rise, ""),
            ("share of ticks without the first solver", self._fell_back, base.fell_back, config.fallback_rise, ""),
        ):
            if value > before + rise:
                return f"{name} {value:.2f}{unit} after {seconds:.2f} s, bound {before + rise:.2f}{unit}"
        return ""


def describe(report: dict[str, float]) -> str:
    """What a shadow found, in one line."""
    if not report:
        return "not shadowed"
    return (
        f"in shadow over {report['ticks']:.0f} ticks it differs by {report['shift'] * 1e3:.1f} mm,"
        f" {report['force']:.1f} N and {report['moment']:.1f} N·m (root mean square),"
        f" agreement {report['agreement']:+.2f},"
        f" at its bounds in {report['clamped_now']:.0%} of them against {report['clamped_before']:.0%}"
    )
