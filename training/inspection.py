"""A policy read by people: its matrix in physical units, what drives what, its symmetry and its worst case."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.robot import LEGS, Array
from runtime.control.policy import Policy
from training.symmetry import (
    FRONT_BACK,
    LEFT_RIGHT,
    mirror_action,
    mirror_grf_action,
    mirror_matrix,
    mirror_observation,
    symmetry_error,
)

BOX = np.array([0.05, 0.3, 0.3, 0.3, 0.5, 0.5, 0.3, 1.5, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0])
"""Half-widths of a hard but plausible observation: m, rad, m/s, rad/s; contacts in [0, 1]. Shape (14,)."""


class NotLinear(ValueError):
    """The policy has a hidden layer: it has no matrix to show."""


@dataclass(frozen=True, slots=True)
class Inspection:
    """What a matrix says."""

    physical: Array
    """Action in m, N, N·m per observation in m, rad, m/s, rad/s, contact. Shape (actions, 28)."""
    left_right: float
    """Distance from the left-right mirror image, as a share of the norm."""
    front_back: float
    worst: Array
    """Largest |action| over the box |observation| ≤ ``BOX``, contacts in [0, 1], before bounds. Shape (actions,)."""
    bound: Array
    """What the policy's own bounds leave of it. Shape (actions,)."""
    dead_contact: Array
    """Largest change of each action when a foot's contact is never felt, by foot. Shape (actions, 4)."""


def inspect(policy: Policy) -> Inspection:
    """Read a linear policy.

    Raises:
        NotLinear: it has a hidden layer.
    """
    matrix = matrix_of(policy)
    physical = np.array(policy.action_scale)[:, None] * matrix * np.array(policy.observation_scale)[None, :]
    mirror = mirror_grf_action if policy.output == "grf" else mirror_action
    errors = [
        symmetry_error(matrix.ravel(), mirror_matrix(mirror(one), mirror_observation(one)))
        for one in (LEFT_RIGHT, FRONT_BACK)
    ]
    contact = [10 + leg for leg in range(len(LEGS))]
    dead = np.abs(physical[:, contact] + physical[:, [14 + column for column in contact]])
    worst = worst_case(physical, np.array(policy.observation_offset or (0.0,) * 28))
    return Inspection(physical, errors[0], errors[1], worst, np.array(policy.action_bound), dead)


def matrix_of(policy: Policy) -> Array:
    """The matrix in scaled units, (actions, 28).

    Raises:
        NotLinear: the policy has a hidden layer.
    """
    if not policy.matrix:
        raise NotLinear(
            f"{policy.name}: a fully-connected policy of {len(policy.hidden)} neurons has no matrix to show"
        )
    return np.array(policy.matrix)


def worst_case(physical: Array, offset: Array) -> Array:
    """Exact maximum of |M (s - offset)| over the box: a linear function is largest in a corner. Shape (actions,).

    Contacts lie in [0, 1], all else about zero.
    """
    low, high = -np.concatenate([BOX, BOX]), np.concatenate([BOX, BOX])
    low[10:14] = low[24:28] = 0.0
    at_low, at_high = physical * (low - offset), physical * (high - offset)
    largest, smallest = np.maximum(at_low, at_high).sum(axis=1), np.minimum(at_low, at_high).sum(axis=1)
    return np.asarray(np.maximum(largest, -smallest))


def describe(policy: Policy, strongest: int = 4) -> str:
    """The inspection as text: for each action what drives it most, both halves of the observation taken together."""
    found = inspect(policy)
    together = found.physical[:, :14] + found.physical[:, 14:]
    half = BOX
    lines = [
        f"{policy.name} for {policy.robot}: {policy.reading} reading, {policy.output} output, "
        f"{matrix_of(policy).size} numbers",
        f"left-right symmetry error {found.left_right:.3f}, front-back {found.front_back:.3f}",
        f"terms: {', '.join(f'{name} {getattr(policy.terms, name):g}' for name in policy.terms.__struct_fields__)}",
        "",
        f"{'action':14} {'worst case':>10} {'bound':>8} {'dead contact':>12}   driven by (per unit)",
    ]
    for row, name in enumerate(policy.action_names):
        order = np.argsort(-np.abs(together[row]) * half)[:strongest]
        drivers = ", ".join(f"{policy.observation_names[i]} {together[row, i]:+.3g}" for i in order)
        numbers = f"{found.worst[row]:10.3g} {found.bound[row]:8.3g} {found.dead_contact[row].max():12.3g}"
        lines.append(f"{name:14} {numbers}   {drivers}")
    made = policy.provenance.get("made", "unknown")
    return "\n".join([*lines, "", f"made: {made}"])


def compare(first: Policy, second: Policy, strongest: int = 12) -> str:
    """Where two policies of one shape differ most, in physical units.

    Raises:
        NotLinear: one has a hidden layer.
        ValueError: their rows differ.
    """
    if first.action_names != second.action_names:
        raise ValueError(f"{first.name} and {second.name} have other actions: {first.output} and {second.output}")
    ours, theirs = inspect(first), inspect(second)
    difference = theirs.physical - ours.physical
    weight = np.abs(difference) * np.concatenate([BOX, BOX]) / ours.bound[:, None]
    lines = [
        f"{first.name} → {second.name}",
        f"distance {np.linalg.norm(matrix_of(second) - matrix_of(first)):.3f} in scaled units, "
        f"norms {np.linalg.norm(matrix_of(first)):.3f} and {np.linalg.norm(matrix_of(second)):.3f}",
    ]
    shape = (
        "reading",
        "shift_time_constant",
        "terms",
        "observation_scale",
        "observation_offset",
        "action_scale",
        "action_bound",
    )
    lines += [
        f"{name}: {getattr(first, name)} → {getattr(second, name)}"
        for name in shape
        if getattr(first, name) != getattr(second, name)
    ]
    for flat in np.argsort(-weight, axis=None)[:strongest]:
        row, column = divmod(int(flat), 28)
        if difference[row, column] != 0.0:
            lines.append(
                f"{first.action_names[row]:14} by {first.observation_names[column]:20} "
                f"{ours.physical[row, column]:+10.3g} → {theirs.physical[row, column]:+10.3g}"
            )
    return "\n".join(lines)
