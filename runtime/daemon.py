"""The service: startup → control and link in one TaskGroup → shutdown, and damp on every way out.

Start never moves the robot: the first command that leaves is damp, and only an operator's request changes that.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.errors import BusTimeout, CorruptFrame
from drivers.robot import Measurement, Robot, damp_command
from runtime import policies, realtime, state
from runtime.audition import Audition, Outcome
from runtime.config import Config
from runtime.control.policy import Policy
from runtime.control.records import VelocityCommand
from runtime.cycle import Cycle
from runtime.doors.answers import Channel
from runtime.faults import FaultHistory, fault_file
from runtime.flight_log import FlightLog
from runtime.link import Link
from runtime.messages.fault import FaultRecord
from runtime.messages.keys import Keys
from runtime.messages.mode import ArmingCheck, ModeReply, Request
from runtime.messages.motion import PoseMessage
from runtime.messages.policy import PolicyEntry
from runtime.messages.status import Status
from runtime.messages.tuning import TuningEntry, TuningReply, TuningRequest
from runtime.reasons import Reason
from runtime.shelf import PolicyFile, Shelf
from runtime.status import build_status
from runtime.stopping import damp, stopped_by_signals
from runtime.systemd import Notifier
from runtime.tick_record import Wake
from runtime.ticker import Ticker
from runtime.tuning import Tuning, TuningError

log = logging.getLogger("trotd")


@dataclass(frozen=True, slots=True)
class Job:
    """What a daemon is to do: everything that the front door decided."""

    config: Config
    robot_toml: str
    """The text that ``config`` was read from."""
    policy: Policy
    body: Robot
    folder: Path
    """State folder: lock, kept policy, recordings."""
    channels: Callable[[Keys], Sequence[Channel]] = field(default=lambda _keys: ())
    """Keys that belong to this body alone."""
    ready: Callable[[], None] = field(default=lambda: None)
    """Called once, after the first tick."""
    simulated: bool = False
    """The body is none that could break."""
    memory: Path | None = None
    """Where the ring of ticks lies: a folder that is kept in RAM spares the disk. Without one, the state folder."""
    policy_file: bytes = b""
    """What ``policy`` was read from; encoded anew if not given."""
    checks: Callable[[], Sequence[ArmingCheck]] = field(default=tuple)
    """What the body itself adds to the arming list."""


class Daemon:
    """One robot's service, from ``run`` to its return."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.config = job.config
        self.cycle = Cycle(job.config, job.policy)
        self.measurement: Measurement | None = None
        """The last one that came back."""
        name = job.config.robot.name
        memory = (job.memory or job.folder / "memory") / name
        self.flight = FlightLog(job.config, job.robot_toml, job.folder / "recordings" / name, memory, self.cycle)
        self.shelf = Shelf(self.cycle, job.folder, name, self.flight.take_policy, job.policy_file)
        self.history = FaultHistory(fault_file(job.folder, name))
        self.audition = Audition(self.cycle, self.shelf, job.config.audition)
        self.tuning = Tuning(job.config, self.cycle.controller.tuning, job.folder / "tuning" / f"{name}.json")
        self._compute = np.zeros(max(1, round(job.config.control.rate_hz)))
        self._stop: asyncio.Event | None = None
        self._held = False
        self._damped = False
        """The body was asked to damp, for good."""

    async def run(self) -> None:
        """Serve until a signal or ``stop``.

        Raises:
            LockError, LinkError, DriverError, RealtimeError: it could not start.
            ExceptionGroup: what broke the loop, after the body was damped.
        """
        self._stop = asyncio.Event()
        notifier = Notifier()
        folder = self.job.folder
        alone = state.lock(folder, self.config.robot.name, self.job.memory)
        with alone, contextlib.closing(notifier), stopped_by_signals(self._stop), self.flight.open():
            if why := state.refusal(folder):
                self.flight.refused[why] += 1
                self.cycle.note("state", f"{folder}: {why}: recordings, faults, policies and tuning cannot be kept")
            async with self._connected(), self._linked():
                await self._serve(notifier)

    def stop(self) -> None:
        """End the loop after this tick."""
        if self._stop is not None:
            self._stop.set()

    # Life --------------------------------------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def _connected(self) -> AsyncIterator[None]:
        body = self.job.body
        try:
            await body.connect()
            if problem := self.shelf.load_kept():
                self.cycle.note("policy", problem)
            self.tuning.load(lambda words: self.cycle.note("tuning", words))
            self.measurement = await body.exchange(damp_command(self.config.damp.kd))
            self.cycle.warm_up(self.measurement)
            self.audition.warm_up()
            yield
        finally:
            try:
                await self._damp_body()
            finally:
                await body.close()

    @contextlib.asynccontextmanager
    async def _linked(self) -> AsyncIterator[None]:
        keys = Keys(self.config.robot.name)
        self.link = Link(self.config, self, self.flight.folder, self.job.channels(keys))
        try:
            self.link.open()
            self.cycle.outside = self._checks
            yield
        finally:
            self.link.close()

    async def _serve(self, notifier: Notifier) -> None:
        for granted in realtime.apply(self.config.realtime):
            (log.info if granted.granted else log.warning)("%s", granted)
            self.cycle.note("realtime", str(granted))
        try:
            async with asyncio.TaskGroup() as group:
                sender = group.create_task(self.link.run(), name="link")
                writer = group.create_task(self.flight.run(), name="recordings")
                keeper = group.create_task(self.history.run(), name="faults")
                await self._control(notifier)
                for task in (sender, writer, keeper):
                    task.cancel()
        finally:
            await self._damp_body()  # before anything that waits for a disk
            notifier.tell("STOPPING=1")
            self._hold_garbage(False)
            self._finish()

    async def _control(self, notifier: Notifier) -> None:
        """The loop: one exchange and one step of the cycle a tick."""
        assert self._stop is not None
        stop, cycle, body, flight, link = self._stop, self.cycle, self.job.body, self.flight, self.link
        audition, tuning = self.audition, self.tuning
        feed_every = max(1, round(notifier.watchdog_period * self.config.control.rate_hz))
        fed = 0
        command = damp_command(self.config.damp.kd)
        realtime.settle_garbage()
        early = self.config.realtime.early_wake
        with realtime.shared_interpreter(), Ticker(self.config.control.rate_hz, early) as ticker:
            while not stop.is_set():
                index = await ticker.wait()
                wake = Wake(index, ticker.stamp, ticker.elapsed, ticker.lateness, ticker.overruns)
                try:
                    self.measurement = measurement = await body.exchange(command)
                except (BusTimeout, CorruptFrame) as error:
                    command = cycle.silent(wake, str(error))
                else:
                    command = cycle.step(wake, measurement)
                compute = time.monotonic() - ticker.stamp
                cycle.tick["compute"] = compute
                self._compute[flight.recorder.count % len(self._compute)] = compute
                flight.keep()
                link.offer(cycle.tick)
                tuning.step(cycle.state.mode)
                if audition.stage is not None:
                    audition.step()
                if flight.recorder.count == 1:
                    self.job.ready()
                    notifier.tell("READY=1")
                if cycle.events:
                    self._tell_events()
                if notifier.watchdog_period and index - fed >= feed_every:  # the index jumps where a tick was missed
                    fed = index
                    notifier.tell("WATCHDOG=1")

    async def _damp_body(self) -> None:
        """Ask the body to damp, once. Never raises."""
        if not self._damped:
            self._damped = True
            await damp(self.job.body, self.config.damp, 1.0 / self.config.control.rate_hz)

    def _finish(self) -> None:
        """The loop is over: say so, keep the recording."""
        self.cycle.damp(Reason.STOPPING)
        self.audition.stop()
        self._tell_events()
        self.flight.finish()
        self.history.save()
        self._tell_events()
        self.link.flush()

    # What happens between ticks ----------------------------------------------------------------------------------

    def _tell_events(self) -> None:
        while self.cycle.faults:
            self.history.take(self.cycle.faults.popleft())
        if self.history.problem:
            self.cycle.note("faults", f"history: {self.history.problem}")
            self.history.problem = ""
        while self.cycle.events:
            event = self.cycle.events.popleft()
            self.flight.take_event(event)
            self.link.tell(event)
            log.info("%s: %s", event.kind, event.text)
        if self.config.realtime.freeze_garbage:
            self._hold_garbage(self.cycle.state.armed)

    def _hold_garbage(self, hold: bool) -> None:
        if hold != self._held:
            self._held = hold
            realtime.hold_garbage(hold)

    # Doors (on the loop's thread) -------------------------------------------------------------

    def take_velocity(self, command: VelocityCommand) -> None:
        """The newest command of the operator."""
        self.cycle.command_velocity(command)

    def take_request(self, wish: Request) -> ModeReply:
        """An operator's wish, answered at once."""
        answer, words = self.cycle.request(wish, self.measurement)
        self._tell_events()
        checks = self.cycle.checks if wish is Request.ARM else ()
        return ModeReply(answer.accepted, answer.state.mode.name, words, checks)

    def lose_operator(self) -> None:
        """A driver is gone: a walking robot stands."""
        self.cycle.lose_operator(self.measurement)
        self._tell_events()

    def offer_policy(self, file: PolicyFile, immediate: bool, done: Future[Outcome]) -> None:
        """A verified candidate; ``done`` gets what became of it, which may take seconds.

        Raises:
            PolicyError: not now, or not on this body.
        """
        if immediate and not self.job.simulated:
            raise policies.PolicyError("immediate is for simulated bodies: a robot shadows first")
        self.audition.offer(file, immediate, done.set_result)

    def roll_back(self, done: Future[Outcome]) -> None:
        """Return to the last good policy.

        Raises:
            PolicyError: there is none, or not now.
        """
        self.audition.roll_back(done.set_result)

    def active_policy(self) -> PolicyFile:
        """The active policy and its file."""
        return self.shelf.active

    def list_policies(self) -> Callable[[], list[PolicyEntry]]:
        """What is known now, with what else a look at the disk finds; the look is for another thread."""
        known = self.shelf.entries()
        return lambda: known + self.shelf.on_disk()

    def take_pose(self, pose: PoseMessage) -> None:
        """The body pose that the operator's sticks ask for.

        Raises:
            TuningError: not standing, or out of reach.
        """
        self.tuning.pose(pose)

    def take_tuning(self, change: TuningRequest, done: Future[TuningReply]) -> None:
        """Change what may be changed; a saved value is on the disk before the answer."""
        try:
            value = self.tuning.change(change.name, change.value)
        except TuningError as error:
            done.set_result(TuningReply(False, str(error)))
            return
        self.cycle.note("tuning", f"{change.name} = {value}")
        if not change.save:
            done.set_result(TuningReply(True, f"{change.name} = {value}"))
            return
        saving = asyncio.get_running_loop().run_in_executor(
            None, self.tuning.save, change.name, None if change.value is None else value
        )

        def saved(written: asyncio.Future[None]) -> None:
            error = None if written.cancelled() else written.exception()
            words = f"{change.name} = {value}, " + ("saved" if error is None else f"not saved: {error}")
            done.set_result(TuningReply(error is None, words))

        saving.add_done_callback(saved)

    def list_tuning(self) -> list[TuningEntry]:
        """Everything that may be changed."""
        return self.tuning.entries()

    def refuse(self, door: str, why: str) -> None:
        """A message that did not come through a door."""
        self.cycle.note("refused", f"{door}: {why}")

    def record_now(self, reason: str, done: Future[Path]) -> None:
        """Write a recording with the next tick."""
        self.flight.ask(reason, done)

    def fault_history(self) -> list[FaultRecord]:
        """Every fault that stood lately, oldest first, those before this start too."""
        return self.history.records

    def status(self) -> Status:
        """Everything that people want to see."""
        compute = self._compute[: min(len(self._compute), max(1, self.flight.recorder.count))]
        refused = self.link.entrance.refused
        wires = self.job.body.troubles
        return build_status(self.cycle, self.shelf.active, compute, refused, self.flight.refused, wires)

    def _checks(self) -> tuple[ArmingCheck, ...]:
        """What the arming list has to say of the operator and of the body."""
        drivers, needed = len(self.link.entrance.drivers), self.config.arming.require_driver
        words = f"{drivers} driving" if drivers else "asked for over the link"
        if needed and not drivers:
            words = "no driver is there, and arming.require_driver asks for one: trotd joystick"
        return (ArmingCheck("operator", bool(drivers) or not needed, words), *self.job.checks())


def main(job: Job) -> Daemon:
    """Run a daemon on uvloop until it is stopped, and return it."""
    import uvloop

    daemon = Daemon(job)
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(daemon.run())
    return daemon
