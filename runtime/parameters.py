"""The shell's configuration: what a robot's TOML says outside ``[robot]`` and ``[control]``, numbers with units.

Every table may be left out: the defaults are those of a robot of Stoch3's size on one host.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from drivers.description import NonNegative, Positive, Record

Angle = Annotated[float, Meta(gt=0, le=3.2)]
Endpoint = Annotated[str, Meta(pattern=r"^[a-z]+/[^\s/]+$")]
Share = Annotated[float, Meta(ge=0, le=1)]
Celsius = Annotated[float, Meta(ge=0, le=200)]


class LimitsConfig(Record, frozen=True, kw_only=True):
    """When the guard takes the robot to damp, and what it asks for before it arms."""

    max_tilt: Angle = 0.9
    """Between the body's z and gravity's, rad."""
    arming_tilt: Angle = 0.35
    """The same, for arming, rad."""
    max_age: Positive = 0.03
    """Of the oldest motor reply and of the IMU sample, s."""
    max_temperature: Celsius = 80.0
    """Of the hottest motor, °C."""
    arming_temperature: Celsius = 65.0
    """The same, for arming, °C."""
    min_voltage: NonNegative = 0.0
    """Supply below which the robot damps, V; 0 where the body has no supply to tell of."""
    arming_voltage: NonNegative = 0.0
    """The same, for arming, V."""
    max_angular_velocity: Positive = 20.0
    """An IMU that tells more is not believed, rad/s."""
    max_acceleration: Positive = 400.0
    """An IMU that tells more is not believed, m/s²."""
    thermal_time: Positive = 30.0
    """Time constant of the rms torque that is held against the continuous rating, s."""
    joint_margin: NonNegative = 0.1
    """How far outside its range a joint may be found at arming, and how near its end a stop may hold it, rad."""
    stuck_time: Positive = 0.05
    """An encoder is not suspected before not one bit of it changed for so long, s."""
    stuck_torque: Annotated[float, Meta(gt=0, le=2)] = 0.2
    """It is stuck when its motor's torque changed by so much meanwhile, as a share of the peak torque ..."""
    clamped_torque: Annotated[float, Meta(gt=0, le=2)] = 0.7
    """... (the same, where the ground or an end stop may clamp the joint) ..."""
    stuck_motion: Angle = 0.3
    """... or another joint of its leg by so much, rad ..."""
    stuck_tilt: Angle = 0.03
    """... or a standing robot leant by so much about the joint's axis, rad; ..."""
    stuck_told: Angle = 0.08
    """... or, in a walk and at once, when the joint's target went so far while the reading kept still, rad."""
    imu_extrapolation: Annotated[int, Meta(ge=0, le=10)] = 2
    """Ticks for which a missing or unbelievable IMU sample is replaced by the last one, turned on by its own rate."""
    frozen_time: Positive = 0.05
    """An IMU whose bits stay the same for so long while joints move is not believed, s."""
    max_attitude_jump: Angle = 0.3
    """Turn between two samples beyond what the rates of turn explain, rad."""
    max_turn_error: Positive = 0.4
    """Between rate of turn and change of attitude, rad/s."""
    turn_error_time: Positive = 0.2
    """Time constant of that difference, s."""
    max_gravity_error: Positive = 4.0
    """Of the mean specific force from gravity's, m/s²."""
    gravity_error_time: Positive = 1.0
    """Time constant of that mean, s."""
    max_position_jump: Positive = 0.3
    """Way of a joint between two ticks beyond what its speed explains, rad."""
    max_position_noise: Positive = 0.01
    """The same, on the mean over 0.1 s, rad."""
    max_roughness: Positive = 0.004
    """A joint whose torque does not fit its command has a noisy encoder, not a weak motor, when its way from tick to
    tick differs so much from the mean of its speeds, on the mean over 0.1 s, rad."""
    max_tracking_error: Positive = 0.8
    """Between a joint and its target, rad."""
    tracking_time: Positive = 0.15
    """For so long, s."""
    max_overspeed: Annotated[float, Meta(ge=1)] = 2.0
    """A walking robot's joint may for a moment be so many times as fast as its ``max_velocity``: a foot that slips off
    an edge spins its knee until it is unloaded ..."""
    overspeed_time: Positive = 0.025
    """... but not for so long, s."""
    min_torque_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25
    """A motor that gives less of its commanded torque, on the mean, has lost it; one that gives so much of the
    opposite turns the wrong way."""
    torque_share_time: Positive = 0.1
    """Time constant of that mean, s."""
    policy_bound: Annotated[float, Meta(ge=1)] = 10.0
    """A policy that asks for more than so many times its own bounds is broken."""
    max_overreach: tuple[Positive, Positive] = (0.35, 0.9)
    """A standing, a walking robot falls for good once its capture point, with half a metre for each radian of lean, is
    this far beyond its feet, m."""
    stall_stand: Positive = 0.05
    """A tick that comes later than this after the one before stops the walk, s."""
    stall_damp: Positive = 0.1
    """One that comes later than this damps: the motors' own watchdogs have let go, s."""
    sit_down: bool = True
    """Faults that leave the legs answering end in a controlled sit-down; false: in damp like all others."""


class ArmingConfig(Record, frozen=True, kw_only=True):
    """What must hold, beside the guard's verdict, before any motor gets torque."""

    pose_tolerance: Angle = 1.2
    """Largest distance of any joint from the nearer one of the folded and the standing pose, rad."""
    gravity_tolerance: Positive = 2.0
    """Of the specific force that a robot at rest feels, m/s²."""
    contact_share: Positive = 1.5
    """Largest foot force that limp legs may feign, as a share of the weight."""
    soak_time: NonNegative = 0.5
    """The loop must have run for so long, s; also what its punctuality is judged on."""
    max_missed: Annotated[float, Meta(ge=0, le=1)] = 0.2
    """Share of missed ticks lately."""
    max_lateness: Positive = 0.05
    """Latest tick lately, s."""
    require_driver: bool = False
    """A driver's liveliness token (``trotd joystick`` holds one) must be there; otherwise asking is enough."""


class DegradeConfig(Record, frozen=True, kw_only=True):
    """What is taken back before anything is given up."""

    thermal_start: Celsius = 70.0
    """From this motor temperature on its torque bound falls, °C."""
    thermal_floor: Annotated[float, Meta(gt=0, le=1)] = 0.6
    """Share of the peak torque that is left at ``limits.max_temperature``; 1: no derating."""
    current_start: Annotated[float, Meta(gt=0, le=1)] = 0.85
    """From this share of the continuous rating on, rms, a motor's torque bound falls towards 0.9 of that rating;
    1: no derating."""
    speed_floor: Annotated[float, Meta(gt=0, le=1)] = 0.5
    """Share of the commanded speed that is left at ``limits.max_temperature`` or ``limits.min_voltage``."""
    voltage_start: NonNegative = 0.0
    """From this supply on down the speed falls, V; 0: never."""


class PostureConfig(Record, frozen=True, kw_only=True):
    """Standing up and sitting down."""

    soft_start: Positive = 1.0
    """Gains and torque bound grow from none to whole over this time, from the pose that was measured, s."""
    fold_time: Positive = 1.0
    """Feet to under the hips, s."""
    rise_time: Positive = 1.5
    """From folded to the walking height, or back, s."""
    settle_time: NonNegative = 0.2
    """Rest between the acts, s."""
    blend_time: Positive = 0.3
    """Hand-over from one source of commands to the next, s."""
    brace_time: Positive = 0.6
    """What a walking robot that has lost attitude, policy or forces takes to fold its legs below it, s."""
    brace_gain: Annotated[float, Meta(gt=0, le=1)] = 0.3
    """Share of the stiffness meanwhile."""
    brace_damping: Annotated[float, Meta(gt=0, le=2)] = 0.75
    """Share of the damping meanwhile."""
    tuck_time: Positive = 0.15
    """What one that falls takes to fold them, s."""
    tuck_gain: Annotated[float, Meta(gt=0, le=1)] = 1.0
    """Share of stiffness and damping meanwhile."""
    fold_height: Annotated[float, Meta(gt=0, lt=1)] = 0.3
    """Foot to hip when folded, as a share of thigh + shank."""


class CommandConfig(Record, frozen=True, kw_only=True):
    """How long a velocity command is believed."""

    expiry: Positive = 0.2
    """Older ones are ramped to zero, s."""
    stand_after: Positive = 2.0
    """Without any for so long, WALK becomes STAND, s."""
    stand_speed: Positive = 0.3
    """A walking robot that is faster slows down before it stands, m/s."""


class DampConfig(Record, frozen=True, kw_only=True):
    """The safe end of everything."""

    kd: Positive = 3.0
    """Damping of every joint, N·m·s/rad."""
    deadline: Positive = 1.0
    """How long a stopping daemon goes on asking a silent body to damp, s."""
    fall_kd: Positive = 8.0
    """Damping for ``fall_time`` after a fault took a robot that did not walk to damp, N·m·s/rad: it sinks."""
    fall_time: NonNegative = 1.5
    """s."""


class LinkConfig(Record, frozen=True, kw_only=True):
    """The zenoh session."""

    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    """Where clients find the daemon."""
    connect: tuple[Endpoint, ...] = ()
    """Routers or peers that the daemon itself looks for."""
    allow_unprotected: bool = False
    """An endpoint off the loopback interface without mutual TLS is refused unless this says otherwise."""
    certificates: str = ""
    """Folder of the daemon's ``ca.pem``, ``cert.pem`` and ``key.pem``; with it, ``tls/`` endpoints serve by role."""
    batch: Annotated[int, Meta(ge=1, le=100)] = 5
    """Tick records in one message."""
    status_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0


class AuditionConfig(Record, frozen=True, kw_only=True):
    """How a policy that is sent while the daemon runs becomes the active one, and when it does not."""

    shadow: NonNegative = 2.0
    """It runs beside the active one for so long, s."""
    wait: Positive = 2.0
    """How long it then waits for a moment with enough legs on the ground, s."""
    blend: Positive = 0.5
    """Its share grows from none to all over this time, s."""
    trial: Positive = 3.0
    """It is watched for so long while it stands, and for so long while it walks; after that it is kept, s."""
    return_time: Positive = 0.05
    """The policy before gets its share back over this time, s."""
    window: Positive = 0.2
    """Low-pass of the two shares of ticks that are watched, s."""
    max_norm: Positive = 10.0
    """An action with every scaled observation at one, as a multiple of the action's bound."""
    tilt_ahead: NonNegative = 0.1
    """The tilt that is watched is the one foreseen for so much later, from the body's rates, s."""
    tilt_rise: Angle = 0.08
    """Beyond the largest such tilt under the policy before, rad."""
    height_rise: Positive = 0.06
    """Beyond the largest error of the height under the policy before, m."""
    clamp_rise: Share = 0.3
    """Share of ticks with a clamp, beyond the policy before; in shadow and on trial."""
    fallback_rise: Share = 0.2
    """Share of ticks that the first solver did not solve, beyond the policy before."""
    min_agreement: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    """Cosine of the two wrenches in shadow; below it, the candidate asks for the opposite of the active policy."""


Bounds = tuple[float, float]


class TuningConfig(Record, frozen=True, kw_only=True):
    """Between which bounds an operator may change what while the robot lives, and how fast it follows."""

    swing_time: Bounds = (0.1, 0.5)
    """s."""
    stance_time: Bounds = (0.1, 1.0)
    """s."""
    swing_height: Bounds = (0.02, 0.15)
    """m."""
    walking_height: Bounds = (0.75, 1.08)
    """As a share of the robot's own; the legs' reach is looked at besides."""
    kp: Bounds = (0.25, 1.5)
    """As a share of the robot's own."""
    kd: Bounds = (0.25, 2.0)
    """The same."""
    gain_scale: Bounds = (0.05, 1.0)
    """Of both scales of the gains in stance."""
    roll: Angle = 0.3
    """Body pose while standing, to either side, rad."""
    pitch: Angle = 0.25
    """rad."""
    yaw: Angle = 0.35
    """rad."""
    height: Bounds = (-0.25, 0.06)
    """As a share of the robot's walking height."""
    ramp_time: Positive = 1.0
    """From one bound to the other, s."""


class RecorderConfig(Record, frozen=True, kw_only=True):
    """The flight recorder."""

    seconds: Annotated[float, Meta(ge=1, le=3600)] = 60.0
    """What the ring holds, s."""
    after_fault: NonNegative = 1.0
    """How long the ring runs on after a fault before it is written, s."""
    max_files: Annotated[int, Meta(ge=1)] = 20
    """More are removed, oldest first."""
    max_bytes: Annotated[int, Meta(ge=1_000_000)] = 2_000_000_000


class RealtimeConfig(Record, frozen=True, kw_only=True):
    """What is asked of the kernel; each is tried and reported, and fatal only when ``required``."""

    priority: Annotated[int, Meta(ge=0, le=98)] = 0
    """SCHED_FIFO priority of the loop's thread; 0 leaves normal scheduling."""
    cpus: tuple[Annotated[int, Meta(ge=0, le=1023)], ...] = ()
    """Processors that the loop's thread may use; none named, all."""
    early_wake: Annotated[float, Meta(ge=0, le=2.5e-4)] = 1e-4
    """The loop is woken this much before its deadline and stays awake until it, s: the kernel's own delay in waking
    a thread then does not show. Costs this share of one processor; 0 sleeps up to the deadline."""
    lock_memory: bool = False
    """mlockall: no page of the daemon is ever swapped."""
    freeze_garbage: bool = True
    """No garbage collection while armed."""
    required: bool = False


class TourConfig(Record, frozen=True, kw_only=True):
    """``trotd tour`` on this robot."""

    speed_scale: Annotated[float, Meta(gt=0, le=3)] = 1.0
    """Stretches every commanded linear speed of the tour."""
    push_speed: NonNegative = 0.5
    """Impulse of each of the two pushes per mass of the robot, m/s."""
    push_time: Annotated[float, Meta(gt=0, le=1)] = 0.1
    """s."""
    velocity_bound: Positive = 0.10
    """Largest RMSE of the velocity that passes, m/s."""
    yaw_rate_bound: Positive = 0.15
    """Largest error of the mean yaw rate that passes, rad/s."""
    tilt_bound: Angle = 0.35
    """Largest roll or pitch that passes, rad."""
