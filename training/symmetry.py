"""Mirror images of a linear policy, and the smaller set of numbers that is left when it must equal them.

A mirror is a signed permutation: ``mirrored = sign * vector[source]``. Reflections of the body act on observation and
action; a policy that treats left as right obeys ``M = mirror_action M mirror_observation``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array

Indices = NDArray[np.int64]


class Mirror(NamedTuple):
    """A signed permutation of a vector of n numbers."""

    source: Indices
    """Which old entry lands here. Shape (n,)."""
    sign: Array
    """+1 or -1. Shape (n,)."""

    def apply(self, vector: Array) -> Array:
        """The mirror image of ``vector`` (n,)."""
        return np.asarray(self.sign * vector[self.source])


LEFT_RIGHT = (np.array([1.0, -1.0, 1.0]), np.array([1, 0, 3, 2]))
"""Reflection in the x-z plane: what it does to a polar vector, and to the order of legs."""
FRONT_BACK = (np.array([-1.0, 1.0, 1.0]), np.array([2, 3, 0, 1]))
"""Reflection in the y-z plane."""


def mirror_observation(reflection: tuple[Array, Indices]) -> Mirror:
    """Of [height, rpy, twist, contacts] now and one tick ago (28); scales do not matter, they come in mirror pairs."""
    polar, legs = reflection
    axial = -polar  # a reflection turns rotations the other way about the axes that lie in its plane
    half_index = np.concatenate([np.arange(10), 10 + legs])
    half_sign = np.concatenate([[1.0], axial, polar, axial, np.ones(4)])
    return Mirror(np.concatenate([half_index, half_index + 14]), np.concatenate([half_sign, half_sign]))


def mirror_action(reflection: tuple[Array, Indices]) -> Mirror:
    """Of [shifts (4, 3), force, moment] (18)."""
    polar, legs = reflection
    shifts = (legs[:, None] * 3 + np.arange(3)).ravel()
    return Mirror(
        np.concatenate([shifts, np.arange(12, 18)]),
        np.concatenate([np.tile(polar, 4), polar, -polar]),
    )


def mirror_grf_action(reflection: tuple[Array, Indices]) -> Mirror:
    """Of [shifts (4, 3), grf (4, 3)] (24): the variant that predicts forces."""
    polar, legs = reflection
    points = (legs[:, None] * 3 + np.arange(3)).ravel()
    return Mirror(np.concatenate([points, points + 12]), np.tile(polar, 8))


def mirror_matrix(action: Mirror, observation: Mirror) -> Mirror:
    """Of a policy matrix (actions, observations), flattened row by row."""
    columns = len(observation.source)
    index = (action.source[:, None] * columns + observation.source[None, :]).ravel()
    return Mirror(index, np.outer(action.sign, observation.sign).ravel())


@dataclass(frozen=True, slots=True)
class Folding:
    """The free numbers of a vector that must equal all its mirror images: ``vector = sign * free[index]``."""

    index: Indices
    """Which free number stands here. Shape (n,)."""
    sign: Array
    """+1, -1, or 0 where symmetry forces zero. Shape (n,)."""
    size: int
    """How many numbers are free."""

    def unfold(self, free: Array) -> Array:
        """Free numbers (..., size) → vectors (..., n)."""
        return np.asarray(self.sign * free[..., self.index])

    def fold(self, vector: Array) -> Array:
        """Nearest symmetric vector's free numbers: the mean over each orbit. (n,) → (size,)."""
        total = np.bincount(self.index, weights=self.sign * vector, minlength=self.size)
        count = np.bincount(self.index, weights=np.abs(self.sign), minlength=self.size)
        return np.asarray(total / np.maximum(count, 1.0))


def no_folding(size: int) -> Folding:
    """Every number free."""
    return Folding(np.arange(size), np.ones(size), size)


def fold_under(mirrors: list[Mirror], size: int) -> Folding:
    """What stays free of ``size`` numbers under all ``mirrors`` and their combinations."""
    index = np.full(size, -1, dtype=np.int64)
    sign = np.zeros(size)
    free = 0
    for start in range(size):
        if index[start] >= 0:
            continue
        orbit = _orbit(start, mirrors)
        forced_zero = any(len(signs) == 2 for signs in orbit.values())
        for member, signs in orbit.items():
            index[member] = 0 if forced_zero else free
            sign[member] = 0.0 if forced_zero else next(iter(signs))
        free += not forced_zero
    return Folding(index, sign, free)


def _orbit(start: int, mirrors: list[Mirror]) -> dict[int, set[float]]:
    """Every entry that ``start`` is mirrored to or from, with the signs it comes with."""
    found: dict[int, set[float]] = {start: {1.0}}
    waiting = [(start, 1.0)]
    while waiting:
        entry, sign = waiting.pop()
        for mirror in mirrors:
            there = int(mirror.source[entry])
            image = sign * float(mirror.sign[entry])
            if image not in found.setdefault(there, set()):
                found[there].add(image)
                waiting.append((there, image))
    return found


def symmetry_error(vector: Array, mirror: Mirror) -> float:
    """How far ``vector`` is from its mirror image, as a share of its norm: 0 symmetric, up to 2."""
    norm = float(np.linalg.norm(vector))
    return float(np.linalg.norm(vector - mirror.apply(vector))) / norm if norm else 0.0
