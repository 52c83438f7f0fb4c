"""A recording through the cycle again: bit for bit the same commands, or the first tick and stage that differ.

What the operator asked for is read back from what changed between two ticks; everything else follows from the recorded
measurements. With another policy the same measurements answer "what would it have done": open loop, tick by tick.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from drivers.robot import ImuSample, JointState, Measurement
from runtime import config, policies
from runtime.control.policy import Policy
from runtime.control.records import COMMAND_FIELDS, ESTIMATE_FIELDS, FEET_FIELDS, Clamp, Records, VelocityCommand
from runtime.cycle import Cycle
from runtime.keyframe import KEYFRAME_DTYPE
from runtime.messages.mode import Mode, Request
from runtime.messages.tick import TICK_DTYPE, TUNED
from runtime.reasons import Reason
from runtime.recording import Recording, RecordingError
from runtime.tick_record import Wake

STAGES: dict[str, tuple[str, ...]] = {
    "mode": ("mode", "armed", "reason", "policy", "asked_velocity"),
    "estimate": tuple(row[0] for row in ESTIMATE_FIELDS),
    "observation": ("velocity_command", "observation"),
    "policy": ("asked", "action"),
    "trajectory": ("phase", "stance", "touchdown", "foot_targets"),
    "force": tuple(row[0] for row in FEET_FIELDS if row[0] in ("target_wrench", "grf", "solver_status")),
    "command": ("clamps", *(row[0] for row in COMMAND_FIELDS)),
}
"""Fields of a tick that a replay computes, in the order in which a tick does."""
WISHES = {Mode.STAND_UP: Request.STAND, Mode.STAND: Request.STAND, Mode.WALK: Request.WALK, Mode.SIT_DOWN: Request.SIT}


class ReplayError(ValueError):
    """A recording that cannot be replayed: the message says what it lacks."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first thing that came out otherwise."""

    tick: int
    stage: str
    field: str
    recorded: str
    replayed: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.stage}: {self.field} was {self.recorded}, is {self.replayed}"


@dataclass(slots=True)
class Replay:
    """How a replay went."""

    ticks: int = 0
    """Run through the cycle."""
    skipped: int = 0
    """Before the first keyframe."""
    difference: Difference | None = None
    modes: dict[str, int] = field(default_factory=dict)
    """Ticks by mode."""
    versions: dict[str, str] = field(default_factory=dict)
    """That wrote the recording."""


class Player:
    """One recording and a cycle that lives through it."""

    def __init__(self, recording: Recording, policy: Policy | None = None) -> None:
        """Build the robot of the recording; ``policy`` takes the place of the recorded ones.

        Raises:
            ReplayError: no keyframe among its ticks, another layout, or a policy that it does not hold.
            ConfigError, PolicyError: what it holds cannot be used.
        """
        header = recording.header
        place = str(recording.path)
        if recording.ticks.dtype != TICK_DTYPE:
            raise ReplayError(f"{place}: its ticks have the layout of another version")
        self.config = config.override(
            config.parse(header.config or tomllib.loads(header.robot_toml), place),
            place,
            {"control.rate_hz": header.rate_hz},
        )
        self._recording = recording
        self._ticks = recording.ticks
        self._given = policy
        self._decoded: dict[int, Policy] = {}
        keyframe, self.first = self._find_keyframe()
        start = self._ticks[self.first : self.first + 1]
        active, outgoing = int(start["policy"][0]), int(start["outgoing"][0])
        self.cycle = Cycle(self.config, self._policy(outgoing or active))
        if outgoing:
            self.cycle.swap_policy(self._policy(active), float(start["policy_share"][0]))
        self.cycle.recall(keyframe, start)
        self._measurement = measurement_of(start[0])

    def _find_keyframe(self) -> tuple[Records, int]:
        for data in self._recording.header.keyframes:
            if len(data) != KEYFRAME_DTYPE.itemsize:
                raise ReplayError(f"{self._recording.path}: a keyframe of another version")
            keyframe = np.frombuffer(data, KEYFRAME_DTYPE)
            found = np.flatnonzero(self._ticks["index"] == keyframe["index"][0])
            if len(found):
                return keyframe, int(found[0])
        raise ReplayError(f"{self._recording.path}: no keyframe among its ticks to begin from")

    def _policy(self, generation: int) -> Policy:
        if self._given is not None:
            return self._given
        if generation not in self._decoded:
            header = self._recording.header
            newest = int(self._ticks["policy"][-1])
            text = header.policies.get(generation, header.policy if generation >= newest else None)
            if text is None:
                raise ReplayError(f"{self._recording.path}: policy number {generation} is not in it")
            place = f"{self._recording.path}: policy {generation}"
            self._decoded[generation] = policies.decode(text.encode(), self.config.robot.name, place)
        return self._decoded[generation]

    def play(self) -> Iterator[tuple[Records, Records]]:
        """Every tick after the keyframe: as recorded and as it came out now, each of shape (1,)."""
        for index in range(self.first + 1, len(self._ticks)):
            before, tick = self._ticks[index - 1], self._ticks[index : index + 1]
            self._operate(before, tick[0])
            self._live(before, tick[0])
            yield tick, self.cycle.tick

    def _live(self, before: np.void, tick: np.void) -> None:
        cycle = self.cycle
        wake = Wake(*(tick[name].item() for name in ("index", "stamp", "period", "lateness", "overruns")))
        if tick["measured_stamp"] == before["measured_stamp"]:
            cycle.silent(wake, Reason.BODY_SILENT.words)
        else:
            self._measurement = measurement_of(tick)
            cycle.step(wake, self._measurement)
        cycle.tick["compute"] = tick["compute"]
        cycle.events.clear()

    def _operate(self, before: np.void, tick: np.void) -> None:
        """What came through the doors between two ticks."""
        if tick["reason"] == Reason.OPERATOR_LOST and before["reason"] != Reason.OPERATOR_LOST:
            self.cycle.lose_operator(self._measurement)
        for wish in self._wishes(before, tick):
            self.cycle.request(wish, self._measurement)
        generation = int(tick["policy"])
        if generation != self.cycle.generation:
            self.cycle.generation = generation - 1
            self.cycle.swap_policy(self._policy(generation), float(tick["policy_share"]))
        self._tune(tick)
        if tick["mode"] == Mode.WALK or tick["reason"] == Reason.COMMAND_LOST:
            velocity = tick["asked_velocity"].copy()
            self.cycle.command_velocity(VelocityCommand(self._heard(tick), velocity[:2], float(velocity[2])))

    def _tune(self, tick: np.void) -> None:
        tuned = np.frombuffer(tick.tobytes(), np.float64)[TUNED]
        if tuned.tobytes() != self.cycle.controller.tuning.tobytes():
            self.cycle.tune(tuned)

    def _wishes(self, before: np.void, tick: np.void) -> Iterator[Request]:
        """The requests that made ``tick`` out of ``before``, as far as the tick itself does not."""
        changed = any(before[name] != tick[name] for name in ("mode", "armed", "reason"))
        reason, mode = int(tick["reason"]), Mode(int(tick["mode"]))
        if changed and reason == Reason.SLOWING and before["reason"] != reason:
            yield Request.STAND
        if not changed or reason not in (Reason.REQUESTED, Reason.ARMED, Reason.CLEARED):
            return
        faulty = self.cycle.state.fault is not Reason.OK
        if reason == Reason.CLEARED or (faulty and tick["armed"]):
            yield Request.CLEAR
        if tick["armed"] and not before["armed"]:
            yield Request.ARM
        if reason == Reason.REQUESTED:
            yield WISHES.get(mode, Request.DAMP)

    def _heard(self, tick: np.void) -> float:
        """A stamp for the newest velocity command that explains what the tick did with it, s."""
        command, now = self.config.command, float(tick["stamp"])
        if tick["reason"] == Reason.COMMAND_LOST and tick["mode"] != Mode.WALK:
            return now - command.stand_after - 1.0
        if tick["clamps"] & Clamp.EXPIRED:
            return now - max(0.5 * (command.expiry + command.stand_after), math.nextafter(command.expiry, math.inf))
        return now


def measurement_of(tick: np.void) -> Measurement:
    """What the body said in a recorded tick."""
    imu = ImuSample(
        float(tick["imu_stamp"]),
        tick["orientation"].copy(),
        tick["angular_velocity"].copy(),
        tick["linear_acceleration"].copy(),
    )
    names = ("joint_position", "joint_velocity", "joint_torque", "joint_temperature", "joint_fault", "joint_age")
    joints = JointState(*(tick[name].copy() for name in names))
    return Measurement(float(tick["measured_stamp"]), imu, joints, float(tick["voltage"]))


def replay(recording: Recording) -> Replay:
    """Play it and hold every computed bit against the recorded one; stops at the first that differs.

    Raises:
        ReplayError, ConfigError, PolicyError: as ``Player`` says.
    """
    player = Player(recording)
    result = Replay(skipped=player.first + 1, versions=recording.header.versions)
    for recorded, replayed in player.play():
        result.ticks += 1
        name = Mode(int(recorded["mode"][0])).name
        result.modes[name] = result.modes.get(name, 0) + 1
        if recorded.tobytes() != replayed.tobytes():
            result.difference = _compare(recorded, replayed)
            if result.difference is not None:
                break
    return result


def _compare(recorded: Records, replayed: Records) -> Difference | None:
    """The first field whose bits differ, in the order of the tick; None when only padding does."""
    for stage, names in STAGES.items():
        for name in names:
            was, now = recorded[name][0], replayed[name][0]
            if was.tobytes() != now.tobytes():
                where, old, new = _first_element(np.atleast_1d(was), np.atleast_1d(now))
                return Difference(int(recorded["index"][0]), stage, f"{name}{where}", old, new)
    return None


def _first_element(was: np.ndarray, now: np.ndarray) -> tuple[str, str, str]:
    for place in np.ndindex(was.shape):
        if was[place].tobytes() != now[place].tobytes():
            return ("" if was.size == 1 else str(list(place))), repr(was[place].item()), repr(now[place].item())
    raise AssertionError("no element differs")


@dataclass(frozen=True, slots=True)
class Alternative:
    """What another policy would have asked for, over the ticks that walked: root mean squares."""

    ticks: int
    shift: float
    """Difference of the foot shifts, m."""
    force: float
    """Difference of the wanted force, N."""
    moment: float
    """N·m."""
    torque: float
    """Difference of the feed-forward torque, N·m."""
    clamped_before: float
    """Share of the ticks with any clamp, as recorded."""
    clamped_now: float
    """The same with the other policy."""


def compare_policy(recording: Recording, policy: Policy) -> Alternative:
    """The recorded measurements and commands under ``policy``: open loop, so believe it near the recorded
    walk only.

    Raises:
        ReplayError: nothing in the recording walks, or as ``Player`` says.
    """
    rows = [
        (recorded.copy(), replayed.copy())
        for recorded, replayed in Player(recording, policy).play()
        if recorded["mode"][0] == Mode.WALK
    ]
    if not rows:
        raise ReplayError(f"{recording.path}: nothing in it walks")
    was, now = (np.concatenate(column) for column in zip(*rows, strict=True))

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(difference))))

    action = now["action"] - was["action"]
    return Alternative(
        ticks=len(was),
        shift=rms(action[:, :12]),
        force=rms(action[:, 12:15]),
        moment=rms(action[:, 15:]),
        torque=rms(now["command_torque"] - was["command_torque"]),
        clamped_before=float((was["clamps"] != 0).mean()),
        clamped_now=float((now["clamps"] != 0).mean()),
    )


__all__ = ["Alternative", "Difference", "Player", "RecordingError", "Replay", "ReplayError", "compare_policy", "replay"]
