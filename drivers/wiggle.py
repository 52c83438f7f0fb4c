"""One motor turned a little by its own power: torque raised until its encoder moves, then taken away.

Only that motor is energised, with a bound on its torque that goes out with every command, and it is stopped on every
way out; its own watchdog stands behind that.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np

from drivers.bus import Bus
from drivers.commissioning import LEAST_MOTION, CommissionError, MotorPlace
from drivers.errors import CorruptFrame
from drivers.mit import MitCodec
from drivers.moteus import MoteusCodec, Reading
from drivers.motor_codec import MotorCodec
from drivers.wiring import MotorsConfig

ENOUGH = 0.1
"""rad that the motor is let turn."""
RISE_TIME, HOLD_TIME = 1.0, 0.5
"""s in which the torque grows to its bound, and stays there, before the other direction is tried."""
SETTLE_TIME = 0.5
"""s in which the joint comes to rest, damped, before it is let go."""
PERIOD = 0.01
"""s between two commands."""
DAMPING, SETTLING = 0.2, 1.0
"""N·m·s/rad at the motor, while it is pushed and while it settles."""
_MISSES = 3
_STOPS = 3
_ATTEMPTS = 3
"""How often a motor that fell silent is let go and turned anew: its replies, or this program, may have been held up."""


class _SilentError(CommissionError):
    """No answer to some questions in a row."""


async def wiggle(
    bus: Bus,
    motors: MotorsConfig,
    place: MotorPlace,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> float:
    """How far the motor at ``place`` turned, rad as it reports it. Opens and closes ``bus``.

    Positive torque first; where that meets a stop, negative. A motor that falls silent is stopped and begun again with,
    a few times.

    Args:
        bus: back-end, closed.
        motors: protocol, gains and ``wiggle_torque``; nothing of the wiring.
        place: bus from 1, and id.
        sleep: as ``asyncio.sleep``.

    Raises:
        CommissionError: it does not answer, has a fault, or does not turn.
        DriverError: the bus cannot be opened.
    """
    motor = _Motor(bus, _codec(motors, place[1]), place, motors)
    await bus.open(motor.receive)
    try:
        for _ in range(_ATTEMPTS - 1):
            try:
                return await _turn(motor, motors.wiggle_torque, sleep)
            except _SilentError:
                await motor.stop()
                await sleep(SETTLE_TIME)
        return await _turn(motor, motors.wiggle_torque, sleep)
    finally:
        await motor.stop()
        await bus.close()


async def _turn(motor: _Motor, most: float, sleep: Callable[[float], Awaitable[None]]) -> float:
    start = await motor.ask(motor.codec.stop[0])
    if motor.codec.enable is not None:
        await motor.ask(motor.codec.enable[0])
    turned = 0.0
    for torque in (most, -most):
        turned = await _push(motor, torque, start, sleep)
        await _settle(motor, sleep)
        if abs(turned) >= LEAST_MOTION:
            return turned
    raise CommissionError(
        f"{motor.name} did not turn with {most:g} N·m either way, the most was {turned:+.3f} rad: "
        "is it jammed, or its leg on the ground? (motors.wiggle_torque)"
    )


async def _push(motor: _Motor, torque: float, start: float, sleep: Callable[[float], Awaitable[None]]) -> float:
    turned = 0.0
    rise = round(RISE_TIME / PERIOD)
    for step in range(rise + round(HOLD_TIME / PERIOD)):
        share = min(1.0, step / rise)
        turned = await motor.push(share * torque, DAMPING) - start
        if abs(turned) >= ENOUGH:
            break
        await sleep(PERIOD)
    return turned


async def _settle(motor: _Motor, sleep: Callable[[float], Awaitable[None]]) -> None:
    for _ in range(round(SETTLE_TIME / PERIOD)):
        await motor.push(0.0, SETTLING)
        await sleep(PERIOD)


def _codec(motors: MotorsConfig, motor: int) -> MotorCodec:
    if motors.protocol == "mit":
        return MitCodec([motor], model=motors.model)
    return MoteusCodec(
        [motor],
        max_torque=np.array([motors.wiggle_torque]),
        servo_kp=motors.servo_kp,
        servo_kd=motors.servo_kd,
        watchdog=motors.watchdog,
    )


class _Motor:
    """One motor on an open bus, asked and answering."""

    reply_time = 0.02

    def __init__(self, bus: Bus, codec: MotorCodec, place: MotorPlace, motors: MotorsConfig) -> None:
        self.codec, self.name = codec, f"bus {place[0]} id {place[1]}"
        self._bus, self._place = bus, place
        self._reading: Reading | None = None

    def frame(self, data: bytes) -> tuple[int, int, bytes]:
        """``data``, addressed."""
        return self._place[0] - 1, self.codec.command_ids[0], data

    def receive(self, bus: int, identifier: int, data: bytes) -> bool:
        """Take a reply of this motor; see ``drivers.bus.Receive``."""
        try:
            ours = identifier == self.codec.reply_ids[0] and self.codec.motor_of(data) in (None, self._place[1])
            if bus != self._place[0] - 1 or not ours:
                return False
            self._reading = self.codec.decode(data)
        except CorruptFrame:
            return False
        return True

    async def stop(self) -> None:
        """Take its torque away, whether it answers or not."""
        for _ in range(_STOPS):
            await self._bus.cycle([self.frame(self.codec.stop[0])], self.reply_time)

    async def push(self, torque: float, damping: float) -> float:
        """Torque, N·m, and damping, N·m·s/rad, from now on; the angle, rad. Errors as ``ask``."""
        (frame,) = self.codec.encode(np.array([[0.0, 0.0, torque, 0.0, damping]]))
        return await self.ask(frame)

    async def ask(self, data: bytes) -> float:
        """Send, and the angle, rad, that comes back.

        Raises:
            _SilentError: no answer to some tries.
            CommissionError: a fault.
        """
        for _ in range(_MISSES):
            self._reading = None
            await self._bus.cycle([self.frame(data)], self.reply_time)
            reading: Reading | None = self._reading
            if reading is not None:
                break
        else:
            raise _SilentError(f"{self.name} does not answer any more: supply, cable?")
        (si,) = self.codec.to_si(np.array([reading]))
        mode, code = int(reading[0]), int(reading[6])
        if mode not in (self.codec.running, *self.codec.starting):
            raise CommissionError(f"{self.name}: {self.codec.describe_fault(self.codec.fault(mode, code))}")
        return float(si[1])
