"""Policy files: load, verify, find. The form is JSON that people read: rows and columns named, one row a line."""

from __future__ import annotations

import hashlib
import math
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np

from drivers.description import UNDECODABLE
from drivers.robot import Array
from runtime.control.observation import OBSERVATION_NAMES
from runtime.control.policy import GRF_NAMES, SHIFT_NAMES, WRENCH_NAMES, Policy
from runtime.control.state import HIDDEN

SHIPPED = Path(__file__).parent / "policies"
FORMAT = 1
"""Of the files that are read and written."""
LARGEST_FILE = 4_000_000
"""Bytes; a policy of 504 numbers needs 15 000."""


class PolicyError(ValueError):
    """A policy that cannot be used: the message names the file, the key, the value and the bound."""


def find_policy(name: str, beside: Path | None = None) -> Path:
    """The file that ``name`` means: a path, a file beside the robot's TOML, or a shipped one (``.json`` optional).

    Raises:
        PolicyError: none of these; the message lists the shipped ones.
    """
    file = name if name.endswith(".json") else f"{name}.json"
    candidates: list[Path] = [Path(file), SHIPPED / file]
    if beside is not None:
        candidates.insert(1, beside / file)
    for path in candidates:
        if path.is_file():
            return path
    known = ", ".join(sorted(path.stem for path in SHIPPED.glob("*.json")))
    raise PolicyError(f"policy {name!r}: no such file, and not one of the shipped ones: {known}")


def load(path: Path, robot: str) -> Policy:
    """Read and verify a policy file for ``robot``.

    Raises:
        PolicyError: unreadable, or as ``decode`` says.
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise PolicyError(f"{path}: {error.strerror}") from error
    return decode(data, robot, str(path))


def decode(data: bytes, robot: str, place: str) -> Policy:
    """Verify the bytes of a policy file for ``robot``; ``place`` is how messages name where they came from.

    Raises:
        PolicyError: too large, not JSON, unknown key, wrong shape, a number that is not finite, another robot's.
    """
    if len(data) > LARGEST_FILE:
        raise PolicyError(f"{place}: {len(data)} bytes; a policy has at most {LARGEST_FILE}")
    try:
        _check_format(msgspec.json.decode(data, type=_Formatted).format, place)
        policy = msgspec.json.decode(data, type=Policy)
    except UNDECODABLE as error:
        raise PolicyError(f"{place}: {error}") from error
    verify(policy, robot, place)
    return policy


class _Formatted(msgspec.Struct):
    """A file of any version: all have this key."""

    format: int


def _check_format(version: int, place: str) -> None:
    if version != FORMAT:
        advice = "update trotd" if version > FORMAT else "train or export it anew"
        raise PolicyError(f"{place}: format = {version}: this program reads {FORMAT}; {advice}")


def verify(policy: Policy, robot: str, place: str) -> None:
    """Check what types cannot: whose it is, its layout, its shapes and that every number is finite.

    Raises:
        PolicyError: naming what is wrong.
    """
    if policy.robot != robot:
        raise PolicyError(f"{place}: robot = {policy.robot!r}: this robot is {robot!r}")
    actions = SHIFT_NAMES + (WRENCH_NAMES if policy.output == "wrench" else GRF_NAMES)
    for key, names, wanted in (
        ("observation_names", policy.observation_names, OBSERVATION_NAMES),
        ("action_names", policy.action_names, actions),
    ):
        _same_names(key, names, wanted, place)
    _shape("observation_scale", (policy.observation_scale,), 1, 28, place)
    if policy.observation_offset:
        _shape("observation_offset", (policy.observation_offset,), 1, 28, place)
    _shape("action_scale", (policy.action_scale,), 1, len(actions), place)
    _shape("action_bound", (policy.action_bound,), 1, len(actions), place)
    if bool(policy.matrix) == bool(policy.hidden):
        raise PolicyError(f"{place}: a policy has either a matrix or hidden and readout layers")
    if policy.matrix:
        _shape("matrix", policy.matrix, len(actions), 28, place)
    else:
        if len(policy.hidden) > HIDDEN:
            raise PolicyError(f"{place}: hidden: {len(policy.hidden)} units; at most {HIDDEN}")
        _shape("hidden", policy.hidden, len(policy.hidden), 28, place)
        _shape("readout", policy.readout, len(actions), len(policy.hidden), place)


def layout_hash(output: str) -> str:
    """Digest of what a policy with this output sees and answers in this version, in order. 16 hex digits."""
    actions = SHIFT_NAMES + (WRENCH_NAMES if output == "wrench" else GRF_NAMES)
    return hashlib.sha256("\n".join((*OBSERVATION_NAMES, "", *actions)).encode()).hexdigest()[:16]


def check_manifest(policy: Policy, rate_hz: float, max_norm: float, place: str) -> None:
    """What a verified policy must fulfil besides, to be sent to a running robot: rate, layout and size of its gains.

    Raises:
        PolicyError: naming the value and the bound.
    """
    if policy.rate_hz and policy.rate_hz != rate_hz:
        raise PolicyError(f"{place}: rate_hz = {policy.rate_hz:g}: this robot ticks at {rate_hz:g}")
    if policy.layout and policy.layout != (layout := layout_hash(policy.output)):
        raise PolicyError(f"{place}: layout = {policy.layout!r}: this version has {layout!r}")
    norms = action_norms(policy)
    worst = int(norms.argmax())
    if norms[worst] > max_norm:
        name = policy.action_names[worst]
        raise PolicyError(f"{place}: {name} reaches {norms[worst]:.3g} times its bound, audition.max_norm {max_norm:g}")


def action_norms(policy: Policy) -> Array:
    """Each action with every scaled observation at one, against it, as a multiple of its bound."""
    if policy.matrix:
        reach = np.abs(np.array(policy.matrix)).sum(axis=1)
    else:  # a hidden unit gives one at most
        reach = np.abs(np.array(policy.readout)).sum(axis=1)
    norms: Array = reach * np.abs(policy.action_scale) / np.array(policy.action_bound)
    return norms


def _same_names(key: str, names: tuple[str, ...], wanted: tuple[str, ...], place: str) -> None:
    if len(names) != len(wanted):
        raise PolicyError(f"{place}: {key}: {len(names)} names; this version has {len(wanted)}")
    for index, (name, expected) in enumerate(zip(names, wanted, strict=True)):
        if name != expected:
            raise PolicyError(f"{place}: {key}[{index}] = {name!r}: this version has {expected!r} there")


def _shape(key: str, rows: tuple[tuple[float, ...], ...], height: int, width: int, place: str) -> None:
    if len(rows) != height:
        raise PolicyError(f"{place}: {key}: {len(rows)} rows; {height} wanted")
    for index, row in enumerate(rows):
        if len(row) != width:
            raise PolicyError(f"{place}: {key}: row {index} has {len(row)} numbers; {width} wanted")
    for value in chain.from_iterable(rows):
        if not math.isfinite(value):
            raise PolicyError(f"{place}: {key} = {value}: must be finite")
