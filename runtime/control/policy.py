"""The policy π(s) = M s: 504 numbers, with its scales, bounds and fixed terms. Paper III.A; method: Action.

The file form is ``runtime.policies``; here is the record that the core computes with and the arithmetic.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from drivers.description import NonNegative, Positive, Record, RobotDescription, composite_inertia
from drivers.robot import LEGS, Array
from runtime.control.compilation import compiled
from runtime.control.observation import OBSERVATION_NAMES
from runtime.control.records import Clamp, Records
from runtime.control.state import POLICY_DTYPE, stand_angles

SHIFT_NAMES = tuple(f"shift_{leg}_{axis}" for leg in LEGS for axis in "xyz")
WRENCH_NAMES = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z")
GRF_NAMES = tuple(f"grf_{leg}_{axis}" for leg in LEGS for axis in "xyz")
_SHIFT, _WRENCH = int(Clamp.SHIFT), int(Clamp.WRENCH)
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
SwingLift = Annotated[float, Meta(ge=0.0, le=0.15)]
"""m."""


class Terms(Record, frozen=True, kw_only=True):
    """The fixed terms around the matrix; all zero is the paper's letter. Method: Past the teacher."""

    velocity_integral: NonNegative = 0.0
    """Integral of the velocity error added to the command, 1/s."""
    integral_bound: NonNegative = 0.25
    """m/s."""
    integral_freeze: Positive = 0.4
    """The integral rests while the error is larger, m/s."""
    integral_delay: NonNegative = 0.3
    """And in the first moments of a walk, s."""
    capture_point: NonNegative = 0.0
    """Shift of the touchdown per velocity error, s."""
    velocity_error_bound: NonNegative = 0.0
    """Bound of the velocity error in the observation, m/s; 0 for none."""
    centripetal: NonNegative = 0.0
    """Share of m ω x v of the commanded motion that is fed forward."""
    slope_feet: NonNegative = 0.0
    """Share of the ground's estimated slope that the foot targets follow."""
    slope_body: NonNegative = 0.0
    """Share of it that the wanted roll and pitch follow (relative reading)."""
    swing_lift: SwingLift = 0.0
    """m by which feet swing higher than the gait says: a policy for uneven ground must clear it."""


class Policy(Record, frozen=True, kw_only=True):
    """One policy, whole: what its file says (``runtime.policies``)."""

    format: Literal[1] = 1
    name: Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_.-]{0,63}$")]
    robot: str
    """The robot that it was made for."""
    rate_hz: NonNegative = 0.0
    """Ticks a second that it was made for; 0 where it does not say."""
    layout: str = ""
    """``layout_hash`` of the version that made it; empty where it does not say."""
    reading: Literal["relative", "plain"] = "relative"
    output: Literal["wrench", "grf"] = "wrench"
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    observation_scale: tuple[Number, ...]
    """Multiplies the observation before the matrix; 28 numbers."""
    observation_offset: tuple[Number, ...] = ()
    """Taken from the observation before its scale; 28 numbers, or none for zero. One at the contacts makes a foot that
    is *not* on the ground the signal: what a trot needs for ever is then gone when all four stand."""
    action_scale: tuple[Number, ...]
    """m, N, N·m per unit of the matrix's output."""
    action_bound: tuple[Positive, ...]
    """m, N, N·m."""
    shift_time_constant: NonNegative = 0.05
    """Low-pass on the shifts, s."""
    terms: Terms = Terms()
    matrix: tuple[tuple[Number, ...], ...] = ()
    """Rows are actions, columns observations, in scaled units (linear policy)."""
    hidden: tuple[tuple[Number, ...], ...] = ()
    """First layer of the small fully-connected policy, tanh, instead of ``matrix``."""
    readout: tuple[tuple[Number, ...], ...] = ()
    provenance: dict[str, Any] = msgspec.field(default_factory=dict)
    """How it was made."""

    @property
    def parameters(self) -> Array:
        """The numbers that training moves, as one vector."""
        layers = (self.matrix,) if self.matrix else (self.hidden, self.readout)
        return np.concatenate([np.asarray(layer, np.float64).ravel() for layer in layers])


def policy_record(policy: Policy) -> Records:
    """A policy as the compiled core reads it. Shape (1,) of ``POLICY_DTYPE``."""
    record = np.zeros(1, POLICY_DTYPE)
    r = record[0]
    r["relative"], r["direct"] = policy.reading == "relative", policy.output == "grf"
    r["observation_scale"] = policy.observation_scale
    r["observation_offset"] = policy.observation_offset or 0.0
    actions = len(policy.action_names)
    r["action_scale"][:actions], r["action_bound"][:actions] = policy.action_scale, policy.action_bound
    r["shift_time_constant"] = policy.shift_time_constant
    for name in Terms.__struct_fields__:
        r[name] = getattr(policy.terms, name)
    if policy.terms.velocity_error_bound == 0.0:
        r["velocity_error_bound"] = np.inf
    set_parameters(record, policy, policy.parameters)
    return record


_MIXED = (
    "action_bound",
    "shift_time_constant",
    *(name for name in Terms.__struct_fields__ if name != "velocity_error_bound"),
)


def mix_terms(mixed: Records, active: Records, outgoing: Records, share: float) -> None:
    """Everything of a policy but its layers between two of them: ``share`` of ``active``, the rest ``outgoing``.

    The observation's bound may be infinite, so it is its inverse that moves.
    """
    m, a, o = mixed[0], active[0], outgoing[0]
    for name in _MIXED:
        m[name] = share * a[name] + (1.0 - share) * o[name] if share < 1.0 else a[name]
    m["velocity_error_bound"] = a["velocity_error_bound"]
    if share < 1.0:
        inverse = share / float(a["velocity_error_bound"]) + (1.0 - share) / float(o["velocity_error_bound"])
        m["velocity_error_bound"] = 1.0 / inverse if inverse > 0.0 else np.inf


def set_parameters(record: Records, policy: Policy, parameters: Array) -> None:
    """Write the trained numbers of a policy of this shape into its record: what training does before an episode."""
    r = record[0]
    actions = len(policy.action_names)
    if policy.matrix:
        r["matrix"][:, :actions] = parameters.reshape(actions, 28).T
        return
    hidden = len(policy.hidden)
    r["hidden_size"] = hidden
    r["hidden"][:hidden] = parameters[: hidden * 28].reshape(hidden, 28)
    r["readout"][:actions, :hidden] = parameters[hidden * 28 :].reshape(actions, hidden)


@compiled
def act(p, policy, outgoing, s, t):  # type: ignore[no-untyped-def]
    """Fill ``asked`` and ``action`` (18,) from the observation; a direct policy's forces go into ``grf`` (4, 3).

    Bounds are the tighter of the policy's own and the robot's; the shifts are low-passed before theirs. While the
    policy's share is below one, the ``outgoing`` one has the rest; both have one reading and one kind of output.
    Returns whether all that was asked is finite: a bound would make a number of what is none.
    """
    actions = 24 if policy.direct else 18
    out = np.zeros(24)
    ask(policy, t.observation, actions, out)
    if p.policy_share < 1.0:
        other, seen = np.zeros(24), np.empty(28)
        for i in range(28):
            seen[i] = (s.seen[i] - outgoing.observation_offset[i]) * outgoing.observation_scale[i]
        ask(outgoing, seen, actions, other)
        for a in range(actions):
            out[a] = p.policy_share * out[a] + (1.0 - p.policy_share) * other[a]
    for leg in range(4):
        for i in range(2):
            out[3 * leg + i] += policy.capture_point * (t.twist[i] - t.velocity_command[i])
    t.asked[:] = out[:18]
    if not np.isfinite(out.sum()):
        return False
    _bound_shifts(p, policy, s, t)
    if policy.direct:
        _bound_forces(p, policy, t, out)
        return True
    for i in range(6):
        bound = min(policy.action_bound[12 + i], p.wrench_bound[i])
        t.action[12 + i] = min(bound, max(-bound, out[12 + i]))
        if t.action[12 + i] != out[12 + i]:
            t.clamps |= _WRENCH
    return True


@compiled
def ask(policy, observation, actions, out):  # type: ignore[no-untyped-def]
    """What the policy alone answers to a scaled ``observation`` (28,), into the blank ``out`` (24,)."""
    if policy.hidden_size > 0:
        for h in range(policy.hidden_size):
            total = 0.0
            for i in range(28):
                total += policy.hidden[h, i] * observation[i]
            total = np.tanh(total)
            for a in range(actions):
                out[a] += policy.readout[a, h] * total
    else:
        for i in range(28):
            value = observation[i]
            for a in range(24):
                out[a] += policy.matrix[i, a] * value
    for a in range(actions):
        out[a] *= policy.action_scale[a]


@compiled
def _bound_shifts(p, policy, s, t):  # type: ignore[no-untyped-def]
    follow = p.dt / (p.dt + policy.shift_time_constant)
    for leg in range(4):
        for i in range(3):
            a = 3 * leg + i
            s.shifts[leg, i] += (t.asked[a] - s.shifts[leg, i]) * follow
            bound = min(policy.action_bound[a], p.shift_bound)
            t.action[a] = min(bound, max(-bound, s.shifts[leg, i]))
            if t.action[a] != s.shifts[leg, i]:
                t.clamps |= _SHIFT
                s.shifts[leg, i] = t.action[a]


@compiled
def _bound_forces(p, policy, t, out):  # type: ignore[no-untyped-def]
    """The direct variant: forces about an equal share of gravity's, bounded; the pyramid is cut in ``grf``."""
    t.asked[12:] = 0.0
    t.action[12:] = 0.0
    for leg in range(4):
        for i in range(3):
            bound = policy.action_bound[12 + 3 * leg + i]
            force = out[12 + 3 * leg + i]
            t.grf[leg, i] = min(bound, max(-bound, force))
            if t.grf[leg, i] != force:
                t.clamps |= _WRENCH


def balance_policy(description: RobotDescription, walking_height: float, terms: Terms | None = None) -> Policy:
    """A hand-built matrix for any robot: a spring and a damper on height, attitude and velocity of the rigid body.

    Natural frequencies and damping ratios are the same for all robots; mass and inertia make them forces.
    """
    mass = description.mass
    _, inertia = composite_inertia(description, stand_angles(description, walking_height))
    i = {name: index for index, name in enumerate(OBSERVATION_NAMES)}
    a = {name: index for index, name in enumerate(SHIFT_NAMES + WRENCH_NAMES)}
    gain = np.zeros((18, 28))
    for axis, rate in (("x", 6.0), ("y", 6.0), ("z", 14.0)):
        gain[a[f"force_{axis}"], i[f"velocity_{axis}"]] = -mass * rate
    gain[a["force_z"], i["height"]] = -mass * 10.0**2
    for k, (axis, angle, stiffness, damping) in enumerate(
        (("x", "roll", 12.0**2, 18.0), ("y", "pitch", 11.0**2, 16.0), ("z", "yaw", 6.0**2, 10.0))
    ):
        gain[a[f"moment_{axis}"], i[angle]] = -inertia[k, k] * stiffness
        gain[a[f"moment_{axis}"], i[f"rate_{axis}"]] = -inertia[k, k] * damping
    observation_scale = np.tile([10.0, 5.0, 5.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.0, 0.1, 0.1, 0.1, 0.1], 2)
    action_scale, action_bound = default_action_scale(description)
    matrix = gain / observation_scale / action_scale[:, None]
    return Policy(
        name="balance" if description.name == "stoch3" else f"balance-{description.name}",
        robot=description.name,
        observation_names=OBSERVATION_NAMES,
        action_names=SHIFT_NAMES + WRENCH_NAMES,
        observation_scale=tuple(observation_scale.tolist()),
        action_scale=tuple(action_scale.round(4).tolist()),
        action_bound=tuple(action_bound.round(4).tolist()),
        terms=terms or BALANCE_TERMS,
        matrix=tuple(tuple(row) for row in matrix.round(6).tolist()),
        provenance={"made": "by hand: trotd policy balance"},
    )


BALANCE_TERMS = Terms(
    velocity_integral=1.5,
    capture_point=0.13,
    velocity_error_bound=0.35,
    centripetal=1.0,
    slope_feet=1.0,
    slope_body=1.0,
)


def default_action_scale(description: RobotDescription) -> tuple[Array, Array]:
    """Scales and bounds (18,) of a robot's actions: Stoch3's, in proportion to weight and size."""
    weight = description.mass / 25.0
    size = description.reach / 0.614
    scale = np.array([0.1 * size] * 12 + [100.0 * weight] * 2 + [150.0 * weight] + [40.0 * weight * size] * 3)
    bound = np.array([0.3 * size] * 12 + [250.0 * weight] * 3 + [100.0 * weight * size] * 3)
    return scale, bound


def encode_policy(policy: Policy) -> bytes:
    """The policy as its file: every row of numbers or names on one line, so that people can read and compare it."""
    text = msgspec.json.format(msgspec.json.encode(policy), indent=1).decode()
    return (_INNERMOST.sub(lambda match: _one_line(match[0]), text) + "\n").encode()


_INNERMOST = re.compile(r"\[[^\[\]{}]*\]")


def _one_line(block: str) -> str:
    return " ".join(block.split()).replace("[ ", "[").replace(" ]", "]")
