"""The tour: a client that drives a simulated robot through everything it can do, and measures how well it did.

It speaks to the daemon over zenoh alone, as any operator's program would. Velocities in the report are the
simulator's truth; the robot's own estimate is held against it in a column of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np
import zenoh

from drivers.robot import Array
from runtime.config import Config
from runtime.control.records import Clamp, Records
from runtime.messages.event import Event
from runtime.messages.mode import Mode, ModeReply, Request
from runtime.messages.simulation import SimPush, SimTruth
from runtime.messages.status import Status
from station.session import Station, StationError
from station.ticks import TickStream

SEND_PERIOD = 0.05
"""Between two velocity commands, s: a quarter of what makes one expire."""
SETTLE = 1.0
"""From the start of a leg of the tour to the first sample that counts, s."""
ARM_TIMEOUT = 20.0
"""For the loop to become punctual, s."""
MODE_TIMEOUT = 15.0
"""For standing up and sitting down, s."""
SLOWEST = 0.25
"""Of real time: a body that a busy computer slows down gets the time that its ticks count, down to this share."""
Velocity = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Leg:
    """One stretch of the tour."""

    name: str
    velocity: Velocity
    """vx, vy m/s, yaw rate rad/s."""
    seconds: float
    push: float = 0.0
    """Impulse per mass from the side in the middle of it, m/s to the left."""


class LegResult(msgspec.Struct, frozen=True, kw_only=True):
    """What one leg showed."""

    name: str
    commanded: Velocity
    measured: Velocity
    """Mean of the simulator's truth after the first second."""
    rmse: float
    """Of vx and vy together, m/s, after the first second."""
    yaw_rate_error: float
    """Of the mean yaw rate, rad/s."""
    roll: float
    """Largest magnitude, rad."""
    pitch: float
    falls: int
    estimator_rmse: float
    """Of the estimated velocity against the truth, m/s."""
    tick_p50: float
    """s."""
    tick_p99: float
    overruns: int
    problems: list[str]
    """Bounds that were missed."""


class TourReport(msgspec.Struct, frozen=True, kw_only=True):
    """The whole tour."""

    robot: str
    rate_hz: float
    passed: bool
    seconds: float
    legs: list[LegResult]
    events: list[str]
    recording: str = ""
    """Where the recording of it lies."""
    problems: list[str] = []
    """What went wrong outside the legs."""


def plan_tour(config: Config) -> list[Leg]:
    """The stretches of walking, scaled to the robot."""
    scale, push = config.tour.speed_scale, config.tour.push_speed
    return [
        Leg("forward 0.4", (0.4 * scale, 0.0, 0.0), 5.0),
        Leg("forward 0.8", (0.8 * scale, 0.0, 0.0), 5.0),
        Leg("backward 0.4", (-0.4 * scale, 0.0, 0.0), 5.0),
        Leg("left 0.3", (0.0, 0.3 * scale, 0.0), 4.0),
        Leg("right 0.3", (0.0, -0.3 * scale, 0.0), 4.0),
        Leg("turn left 0.8", (0.0, 0.0, 0.8), 4.0),
        Leg("turn right 0.8", (0.0, 0.0, -0.8), 4.0),
        Leg("arc", (0.5 * scale, 0.2 * scale, 0.5), 5.0),
        Leg("push from right", (0.0, 0.0, 0.0), 4.0, push),
        Leg("push from left", (0.0, 0.0, 0.0), 4.0, -push),
    ]


@dataclass
class Seen:
    """What arrived during one leg."""

    ticks: list[Records] = field(default_factory=list)
    truth: list[SimTruth] = field(default_factory=list)


class TourError(StationError):
    """The robot refused or did not get there: the tour cannot go on."""


class Tour:
    """One drive through the plan. A context manager around its subscriptions."""

    def __init__(self, station: Station, config: Config, show: Callable[[Status | None, str], None]) -> None:
        self._station, self._config, self._show = station, config, show
        self._ticks = TickStream(station)
        declare = station.session.declare_subscriber
        self._truth = declare(station.keys.sim_truth, zenoh.handlers.RingChannel(2000))
        self._statuses = declare(station.keys.status, zenoh.handlers.RingChannel(4))
        self._velocity = station.session.declare_publisher(station.keys.velocity)
        self._push = station.session.declare_publisher(station.keys.sim_push)
        self._status: Status | None = None
        self.events: list[Event] = []

    def drive(self) -> TourReport:
        """Damp → arm → stand → every leg → stand → sit → damp. Never raises for what the robot did."""
        start = time.monotonic()
        legs: list[LegResult] = []
        problems: list[str] = []
        try:
            self._rest("damp", 1.0)
            self._arm()
            self._ask(Request.STAND)
            self._await("standing up", Mode.STAND)
            self._rest("stand", 1.0)
            self._ask(Request.WALK)
            for leg in plan_tour(self._config):
                legs.append(self._walk(leg))
                if legs[-1].falls:
                    raise TourError(f"{leg.name}: it fell")
            self._ask(Request.STAND)
            self._rest("stand", 1.5)
            self._ask(Request.SIT)
            self._await("sitting down", Mode.DAMP)
        except StationError as error:
            problems.append(str(error))
        problems += self._end()
        problems += [f"{event.kind}: {event.text}" for event in self.events if event.kind == "fault"]
        return TourReport(
            robot=self._config.robot.name,
            rate_hz=self._config.control.rate_hz,
            passed=not problems and not any(leg.problems for leg in legs),
            seconds=time.monotonic() - start,
            legs=legs,
            events=[f"{event.kind}: {event.text}" for event in self.events],
            problems=problems,
        )

    def _end(self) -> list[str]:
        try:
            self._ask(Request.DAMP)
        except StationError as error:
            return [str(error)]
        return []

    def _arm(self) -> None:
        """Ask until the computer was punctual for long enough; any other obstacle is final."""
        end = time.monotonic() + ARM_TIMEOUT
        while True:
            reply = self._station.ask_for(ModeReply, self._station.keys.mode, Request.ARM.value.encode())
            if reply.accepted:
                return
            if {check.name for check in reply.checks if not check.ok} != {"timing"} or time.monotonic() > end:
                raise TourError(f"arm refused: {reply.reason}")
            self._rest("damp, until the loop is punctual", 0.5)

    def _ask(self, wish: Request) -> None:
        reply = self._station.ask_for(ModeReply, self._station.keys.mode, wish.value.encode())
        if not reply.accepted:
            raise TourError(f"{wish.value} refused: {reply.reason}")

    def _rest(self, activity: str, seconds: float) -> None:
        self._pump(activity, seconds, Seen(), lambda _elapsed: None)

    def _await(self, activity: str, mode: Mode) -> None:
        end = time.monotonic() + MODE_TIMEOUT
        while self._status is None or self._status.mode != mode.name:
            self._rest(activity, SEND_PERIOD)
            if self._status is not None and self._status.fault:
                raise TourError(f"{activity}: {self._status.fault}")
            if time.monotonic() > end:
                raise TourError(f"{activity}: not {mode.name} within {MODE_TIMEOUT:g} s")

    def _walk(self, leg: Leg) -> LegResult:
        seen = Seen()
        vx, vy, yaw_rate = leg.velocity
        payload = msgspec.json.encode({"linear": (vx, vy), "yaw_rate": yaw_rate})
        pushed = leg.push == 0.0

        def send(elapsed: float) -> None:
            nonlocal pushed
            self._velocity.put(payload)
            if not pushed and elapsed > SETTLE:
                pushed = True
                duration = self._config.tour.push_time
                force = leg.push * self._config.robot.mass / duration
                self._push.put(msgspec.json.encode(SimPush((0.0, force, 0.0), duration)))

        self._pump(leg.name, leg.seconds, seen, send)
        return self._judge(leg, seen)

    def _pump(self, activity: str, seconds: float, seen: Seen, act: Callable[[float], None]) -> None:
        """Receive for ``seconds`` of the body's time, calling ``act`` with those since the start every SEND_PERIOD."""
        start, elapsed, rate = time.monotonic(), 0.0, self._config.control.rate_hz
        while elapsed < seconds:
            act(elapsed)
            seen.ticks.append(self._ticks.take())
            self.events += self._ticks.take_events()
            while (sample := self._truth.handler.try_recv()) is not None:
                seen.truth.append(msgspec.json.decode(sample.payload.to_bytes(), type=SimTruth))
            while (sample := self._statuses.handler.try_recv()) is not None:
                self._status = msgspec.json.decode(sample.payload.to_bytes(), type=Status)
            self._show(self._status, activity)
            time.sleep(SEND_PERIOD)
            real = time.monotonic() - start
            elapsed = min(real, max(sum(map(len, seen.ticks)) / rate, SLOWEST * real))

    def _judge(self, leg: Leg, seen: Seen) -> LegResult:
        ticks = np.concatenate(seen.ticks)
        if not seen.truth or not len(ticks):
            raise TourError(f"{leg.name}: no truth from the body: is it the simulator?")
        stamps = np.array([truth.stamp for truth in seen.truth])
        velocity = np.array([truth.velocity for truth in seen.truth])
        rpy = np.array([truth.rpy for truth in seen.truth])
        settling = min(round(SETTLE * self._config.control.rate_hz), len(ticks) - 1)
        counted = stamps > ticks["stamp"][settling]
        commanded = np.array(leg.velocity)
        error = velocity[counted] - commanded
        mean = velocity[counted].mean(axis=0)
        result = LegResult(
            name=leg.name,
            commanded=leg.velocity,
            measured=_triple(mean),
            rmse=_planar_rms(error),
            yaw_rate_error=float(abs(mean[2] - commanded[2])),
            roll=float(np.abs(rpy[:, 0]).max()),
            pitch=float(np.abs(rpy[:, 1]).max()),
            falls=int(any(truth.fallen for truth in seen.truth) or bool((ticks["mode"] == Mode.DAMP).any())),
            estimator_rmse=_planar_rms(_estimate_at(ticks, stamps)[counted] - velocity[counted]),
            tick_p50=float(np.percentile(ticks["compute"], 50)),
            tick_p99=float(np.percentile(ticks["compute"], 99)),
            overruns=int(ticks["overruns"][-1] - ticks["overruns"][0]),
            problems=[],
        )
        last = error[stamps[counted] > ticks["stamp"][-1 - settling]]
        problems = self._missed(leg, result, _planar_rms(last))
        expired = int(((ticks["clamps"] & np.uint32(Clamp.EXPIRED)) != 0).sum())
        if problems and expired:
            problems.append(f"no fresh command on {expired} ticks: this computer is too busy")
        return msgspec.structs.replace(result, problems=problems)

    def _missed(self, leg: Leg, result: LegResult, last_second: float) -> list[str]:
        """Bounds that were missed; a pushed robot only has to be itself again in the last second."""
        bounds = self._config.tour
        checks = [("velocity RMSE after the push", last_second, bounds.velocity_bound)]
        if not leg.push:
            checks = [
                ("roll", result.roll, bounds.tilt_bound),
                ("pitch", result.pitch, bounds.tilt_bound),
                ("velocity RMSE", result.rmse, bounds.velocity_bound),
                ("yaw rate error", result.yaw_rate_error, bounds.yaw_rate_bound),
            ]
        missed = [f"{name} {value:.3f} above {bound:g}" for name, value, bound in checks if not value <= bound]
        return ["it fell", *missed] if result.falls else missed

    def __enter__(self) -> Tour:
        self._ticks.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._ticks.__exit__(None, None, None)
        for declared in (self._truth, self._statuses, self._velocity, self._push):
            declared.undeclare()  # type: ignore[no-untyped-call]


def _estimate_at(ticks: Records, stamps: Array) -> Array:
    """The robot's own velocity estimate at ``stamps``: vx, vy, yaw rate. Shape (n, 3)."""
    twist = ticks["twist"]
    return np.stack([np.interp(stamps, ticks["stamp"], twist[:, i]) for i in (0, 1, 5)], axis=1)


def _planar_rms(error: Array) -> float:
    return float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())) if len(error) else float("nan")


def _triple(values: Array) -> Velocity:
    x, y, z = values.tolist()
    return x, y, z
