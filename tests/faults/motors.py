"""Faults of motors, encoders and the wires to them, on the simulated body."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drivers.errors import BusTimeout
from drivers.motor_faults import RESTARTED, SILENT
from drivers.robot import JointCommand, Measurement
from faults.rig import WATCHDOG, WATCHDOG_DAMPING, Fault, Rig

COASTED = 2
"""Missed replies in a row that the driver bears."""
ALL = tuple(range(12))


def changed(measurement: Measurement, **joints: np.ndarray) -> Measurement:
    return replace(measurement, joints=replace(measurement.joints, **joints))


@dataclass
class FrameLoss(Fault):
    """A share of the frames of some motors is lost, commands and replies alike; what drivers and servos make of it."""

    share: float
    joints: tuple[int, ...] = ALL
    seed: int = 0

    def start(self, rig: Rig) -> None:
        self._random = np.random.default_rng(self.seed)
        self._obeyed, self._known = rig.sent, rig.last.joints
        self._unheard, self._missed = np.zeros(12), np.zeros(12, dtype=int)

    def command(self, rig: Rig, command: JointCommand) -> JointCommand:
        lost = self._lost()
        self._unheard = np.where(lost, self._unheard + rig.period, 0.0)
        given = {}
        for name in ("position", "velocity", "kp", "kd", "torque"):
            kept, new = getattr(self._obeyed, name).ravel(), getattr(command, name).ravel()
            given[name] = np.where(lost, kept, new)
        damped = self._unheard > WATCHDOG
        for name in ("kp", "torque"):
            given[name][damped] = 0.0
        given["kd"][damped] = WATCHDOG_DAMPING
        given["velocity"][damped] = 0.0
        self._obeyed = JointCommand(**{name: value.reshape(4, 3) for name, value in given.items()})
        return self._obeyed

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        lost = self._lost().reshape(4, 3)
        known, new = self._known, measurement.joints
        self._missed = np.where(lost.ravel(), self._missed + 1, 0)
        missed = self._missed.reshape(4, 3)
        if missed.min() > COASTED:
            raise BusTimeout("no motor answered")
        kept = {
            name: np.where(lost, getattr(known, name), getattr(new, name))
            for name in ("position", "velocity", "torque", "temperature")
        }
        fault = np.where(missed > COASTED, SILENT, np.where(lost, known.fault, new.fault)).astype(np.int32)
        self._known = replace(new, **kept, age=missed * rig.period, fault=fault)
        return replace(measurement, joints=self._known)

    def _lost(self) -> np.ndarray:
        lost = np.zeros(12, dtype=bool)
        joints = list(self.joints)
        lost[joints] = self._random.random(len(joints)) < self.share
        return lost


@dataclass
class LateReplies(Fault):
    """Every reply arrives some ticks late; until the first one there is none."""

    ticks: int

    def start(self, rig: Rig) -> None:
        self._waiting: list[Measurement] = []
        self._known = rig.last.joints
        self._count = 0

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        self._waiting.append(measurement)
        self._count += 1
        if len(self._waiting) > self.ticks:
            self._known = self._waiting.pop(0).joints
            return changed(replace(measurement, joints=self._known), age=np.full((4, 3), self.ticks * rig.period))
        if self._count > COASTED:
            raise BusTimeout("no motor answered")
        return changed(replace(measurement, joints=self._known), age=np.full((4, 3), self._count * rig.period))


@dataclass
class MotorFault(Fault):
    """A servo goes into its fault mode: it says its code and exerts nothing."""

    joint: int
    code: int

    def start(self, rig: Rig) -> None:
        rig.world.motors.peak[self.joint] = 0.0

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        fault = measurement.joints.fault.copy()
        fault.flat[self.joint] = self.code
        return changed(measurement, fault=fault)


@dataclass
class StuckEncoder(Fault):
    """The servo reads one angle for ever, at rest."""

    joint: int

    def start(self, rig: Rig) -> None:
        angle = float(rig.world.truth.joint_position.flat[self.joint])
        rig.world.motors.encoders[self.joint] = lambda _q, _v: (angle, 0.0)


@dataclass
class JumpingEncoder(Fault):
    """Now and then the servo reads an angle that is off, for a physics step or for good."""

    joint: int
    size: float
    share: float
    seed: int

    def start(self, rig: Rig) -> None:
        random = np.random.default_rng(self.seed)
        size, share = self.size, self.share
        rig.world.motors.encoders[self.joint] = lambda q, v: (q + size if random.random() < share else q, v)


@dataclass
class NoisyEncoder(Fault):
    joint: int
    angle: float
    speed: float
    seed: int

    def start(self, rig: Rig) -> None:
        draw = np.random.default_rng(self.seed).standard_normal
        angle, speed = self.angle, self.speed
        rig.world.motors.encoders[self.joint] = lambda q, v: (q + angle * draw(), v + speed * draw())


@dataclass
class ReversedSign(Fault):
    """A servo was flashed anew and turns the other way: its reading and its torque have the wrong sign."""

    joint: int

    def start(self, rig: Rig) -> None:
        assert rig.config.motors is not None
        offset = float(np.array(rig.config.motors.offset).flat[self.joint])
        rig.world.motors.encoders[self.joint] = lambda q, v: (-q - 2.0 * offset, -v)
        rig.world.motors.reversed.add(self.joint)


@dataclass
class WeakMotors(Fault):
    """Only a share of the peak torque arrives: 0 for a broken coupling, more for a saturated drive."""

    joints: tuple[int, ...]
    share: float

    def start(self, rig: Rig) -> None:
        for joint in self.joints:
            rig.world.motors.peak[joint] *= self.share


@dataclass
class JammedJoint(Fault):
    joint: int
    torque: float

    def start(self, rig: Rig) -> None:
        rig.world.jam(self.joint, self.torque)


@dataclass
class HotMotor(Fault):
    """A motor heats up, °C/s, from where it is."""

    joint: int
    rate: float
    start_at: float

    def start(self, rig: Rig) -> None:
        self._since = rig.now

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        temperature = measurement.joints.temperature.copy()
        temperature.flat[self.joint] = self.start_at + self.rate * (rig.now - self._since)
        return changed(measurement, temperature=temperature)


@dataclass
class DuplicateId(Fault):
    """Two servos have one id: both obey its commands, either one's reply arrives, the other id is silent."""

    kept: int
    gone: int
    seed: int

    def start(self, rig: Rig) -> None:
        self._random = np.random.default_rng(self.seed)
        self._silence = FrameLoss(1.0, (self.gone,))
        self._silence.start(rig)

    def command(self, rig: Rig, command: JointCommand) -> JointCommand:
        parts = {name: getattr(command, name).copy() for name in ("position", "velocity", "kp", "kd", "torque")}
        for part in parts.values():
            part.flat[self.gone] = part.flat[self.kept]
        return JointCommand(**parts)

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        joints = measurement.joints
        mixed = {name: getattr(joints, name).copy() for name in ("position", "velocity", "torque")}
        if self._random.random() < 0.5:
            for part in mixed.values():
                part.flat[self.kept] = part.flat[self.gone]
        return self._silence.measurement(rig, changed(measurement, **mixed))


@dataclass
class BatterySag(Fault):
    """The supply sinks to a voltage within some seconds; the motors weaken with it."""

    volts: float
    seconds: float

    def start(self, rig: Rig) -> None:
        self._since, self._full = rig.now, rig.last.voltage
        self._peak = list(rig.world.motors.peak)

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        share = min(1.0, (rig.now - self._since) / self.seconds)
        volts = self._full + share * (self.volts - self._full)
        rig.world.motors.peak[:] = [peak * volts / self._full for peak in self._peak]
        return replace(measurement, voltage=volts)


@dataclass
class BrownOut(Fault):
    """The supply of some legs breaks down for a moment: their servos come back limp and say that they restarted."""

    legs: tuple[int, ...]
    volts: float
    ticks: int
    _left: int = field(default=0, repr=False)

    def start(self, rig: Rig) -> None:
        self._left = self.ticks
        for leg in self.legs:
            for joint in range(3):
                rig.world.motors.peak[3 * leg + joint] = 0.0

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        fault = measurement.joints.fault.copy()
        fault[list(self.legs)] = RESTARTED
        self._left -= 1
        volts = self.volts if self._left >= 0 else measurement.voltage
        return replace(changed(measurement, fault=fault), voltage=volts)


@dataclass
class LyingFoot(Fault):
    """A foot feels so much more force than there is, N: always on the ground, or never."""

    leg: int
    force: float

    def start(self, rig: Rig) -> None:
        rig.cycle.controller.parameters["contact_baseline"][0][self.leg] -= self.force
