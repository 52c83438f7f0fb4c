"""The shapes of policy that are trained and compared (paper Section V.B), before their first number is learnt."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

import msgspec
import numpy as np

from drivers.description import RobotDescription
from drivers.robot import Array
from runtime.control.observation import OBSERVATION_NAMES
from runtime.control.policy import BALANCE_TERMS, GRF_NAMES, SHIFT_NAMES, Policy, Terms, balance_policy
from runtime.policies import PolicyError
from training.symmetry import (
    FRONT_BACK,
    LEFT_RIGHT,
    Folding,
    fold_under,
    mirror_action,
    mirror_grf_action,
    mirror_matrix,
    mirror_observation,
    no_folding,
)

ALL_DOWN = 2 * ((0.0,) * 10 + (1.0,) * 4)
"""Offset of an observation in which only feet in the air are seen."""
CONTACT_SCALE = 0.1
"""Of the contacts in the observation, where a stage does not say otherwise."""
_CONTACTS = [10, 11, 12, 13, 24, 25, 26, 27]
HIDDEN = 16
"""Neurons of the small fully-connected variant."""
SYMMETRIES = {"none": (), "left-right": (LEFT_RIGHT,), "both": (LEFT_RIGHT, FRONT_BACK)}


@dataclass(frozen=True, slots=True)
class Variant:
    """One of the alternatives."""

    output: str = "wrench"
    """``wrench``, shared among the legs by the quadratic programme, or ``grf`` straight from the policy."""
    hidden: int = 0
    """Neurons of the hidden layer; 0 is linear."""
    reading: str = "relative"
    """Of the observation: ``relative`` to the command, or ``plain``."""


VARIANTS = {
    "linear": Variant(),
    "linear-plain": Variant(reading="plain"),
    "linear-grf": Variant(output="grf"),
    "mlp": Variant(hidden=HIDDEN),
    "mlp-plain": Variant(hidden=HIDDEN, reading="plain"),
    "mlp-grf": Variant(hidden=HIDDEN, output="grf"),
}


Term = Literal["velocity_integral", "capture_point", "velocity_error_bound", "centripetal", "slope"]
"""One of the five fixed terms around the matrix (method: Past the teacher)."""
TERMS: tuple[Term, ...] = get_args(Term)


def find_terms(names: Collection[str]) -> tuple[Term, ...]:
    """The terms of these names, in their own order.

    Raises:
        PolicyError: no such term.
    """
    for name in names:
        if name not in TERMS:
            raise PolicyError(f"no fixed term {name!r}: there are {', '.join(TERMS)}")
    return tuple(term for term in TERMS if term in names)


def without_terms(policy: Policy, names: Collection[Term]) -> Policy:
    """The same policy with these fixed terms off."""
    off = {field: 0.0 for name in names for field in (("slope_feet", "slope_body") if name == "slope" else (name,))}
    return msgspec.structs.replace(policy, terms=msgspec.structs.replace(policy.terms, **off))


def make_policy(
    description: RobotDescription, walking_height: float, variant: Variant, terms: bool, name: str = "untrained"
) -> Policy:
    """A policy of this shape with all readout numbers zero; ``terms`` turns the fixed terms on."""
    like = balance_policy(description, walking_height)
    scale, bound = np.array(like.action_scale), np.array(like.action_bound)
    names = like.action_names
    if variant.output == "grf":
        weight = description.mass * 9.81
        names = SHIFT_NAMES + GRF_NAMES
        scale = np.concatenate([scale[:12], np.tile(np.array([0.15, 0.15, 0.5]) * weight, 4)])
        bound = np.concatenate([bound[:12], np.full(12, 2.0 * weight)])
    hidden: Array = np.random.default_rng(0).normal(0.0, 1.0 / np.sqrt(28), (variant.hidden, 28))
    readout = np.zeros((len(names), variant.hidden or 28))
    return msgspec.structs.replace(
        like,
        name=name,
        reading=variant.reading,
        output=variant.output,
        observation_names=OBSERVATION_NAMES,
        action_names=names,
        action_scale=tuple(scale.tolist()),
        action_bound=tuple(bound.tolist()),
        terms=BALANCE_TERMS if terms else Terms(),
        matrix=() if variant.hidden else _rows(readout),
        hidden=_rows(hidden) if variant.hidden else (),
        readout=_rows(readout) if variant.hidden else (),
        provenance={},
    )


def check_variant(policy: Policy, name: str) -> None:
    """Let a policy through whose numbers a run of this variant can begin with.

    Raises:
        PolicyError: it has another shape.
    """
    wanted, found = VARIANTS[name], Variant(policy.output, len(policy.hidden), policy.reading)
    if found != wanted:
        raise PolicyError(
            f"policy {policy.name!r} is no {name}: it has output {found.output}, {found.hidden} hidden neurons and "
            f"reading {found.reading}, where {wanted.output}, {wanted.hidden} and {wanted.reading} are wanted"
        )


def with_parameters(policy: Policy, parameters: Array) -> Policy:
    """The same shape with other numbers. ``parameters`` as ``Policy.parameters`` gives them."""
    if policy.matrix:
        return msgspec.structs.replace(policy, matrix=_rows(parameters.reshape(len(policy.matrix), 28)))
    hidden = len(policy.hidden)
    return msgspec.structs.replace(
        policy,
        hidden=_rows(parameters[: hidden * 28].reshape(hidden, 28)),
        readout=_rows(parameters[hidden * 28 :].reshape(-1, hidden)),
    )


def reading_contacts(policy: Policy, all_down: bool, scale: float = CONTACT_SCALE) -> Policy:
    """The same trot from a policy that reads the contacts less ``ALL_DOWN``, or as they are, by ``scale``.

    Each number changes so that with two feet on the ground, whichever diagonal, the same is answered as before; with
    four, all of it is new if the offset is (decision 14). The larger the scale, the faster the contacts' numbers learn.
    """
    wanted = ALL_DOWN if all_down else ()
    scales = np.array(policy.observation_scale)
    if policy.observation_offset == wanted and (scales[_CONTACTS] == scale).all():
        return policy
    layer = np.array(policy.matrix or policy.hidden)
    layer[:, _CONTACTS] *= scales[_CONTACTS] / scale
    scales[_CONTACTS] = scale
    for first in (10, 24) if policy.observation_offset != wanted else ():
        feet = layer[:, first : first + 4]
        feet -= 0.5 * feet.sum(axis=1, keepdims=True)
    read = msgspec.structs.replace(policy, observation_offset=wanted, observation_scale=tuple(scales.tolist()))
    return msgspec.structs.replace(read, **{"matrix" if policy.matrix else "hidden": _rows(layer)})


def swinging_higher(policy: Policy, lift: float) -> Policy:
    """The same policy with feet that swing higher than the gait says by ``lift`` m."""
    return msgspec.structs.replace(policy, terms=msgspec.structs.replace(policy.terms, swing_lift=lift))


def folding_of(policy: Policy, symmetry: str) -> Folding:
    """What stays free of a policy's numbers; a hidden layer has no mirror image of its own, so all of its.

    Raises:
        KeyError: ``symmetry`` is not one of ``SYMMETRIES``.
    """
    reflections = SYMMETRIES[symmetry]
    if not policy.matrix or not reflections:
        return no_folding(policy.parameters.size)
    mirror = mirror_grf_action if policy.output == "grf" else mirror_action
    mirrors = [mirror_matrix(mirror(reflection), mirror_observation(reflection)) for reflection in reflections]
    return fold_under(mirrors, policy.parameters.size)


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())
