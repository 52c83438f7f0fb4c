"""The core's configuration: what a robot's TOML says under ``[control]``, every number with its unit and bound."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from drivers.description import NonNegative, Positive, Positive3, Record

GaitName = Literal["trot", "walk", "pace", "bound", "pronk", "stand"]
Fraction = Annotated[float, Meta(ge=0, le=1)]
PositiveFraction = Annotated[float, Meta(gt=0, le=1)]


class GaitConfig(Record, frozen=True, kw_only=True):
    """Timing and heights of the steps."""

    name: GaitName = "trot"
    swing_time: Annotated[float, Meta(ge=0.05, le=1.0)]
    """T_sw, s."""
    stance_time: Annotated[float, Meta(ge=0.05, le=2.0)]
    """T_st of the trot, s; the other gaits keep their own duty factor at this swing time."""
    swing_height: Annotated[float, Meta(ge=0.0, le=0.3)]
    """h_sw, m."""
    walking_height: Annotated[float, Meta(gt=0.05, le=1.5)]
    """Body origin above the ground, m."""
    early_contact: bool = True
    """A leg that feels the ground after mid-swing carries at once."""
    search_speed: NonNegative = 0.2
    """How fast a leg that found no ground at its swing's end searches down, m/s."""
    search_depth: NonNegative = 0.06
    """How far it searches, m."""


class GainsConfig(Record, frozen=True, kw_only=True):
    """Joint stiffness and damping of the motors' own loop (paper Eq. 5-6), for abduction, hip, knee."""

    kp: tuple[NonNegative, NonNegative, NonNegative]
    """N·m/rad."""
    kd: tuple[NonNegative, NonNegative, NonNegative]
    """N·m·s/rad."""
    stance_scale: Fraction = 0.1
    """The paper's 0.1: share of the gains that a stance leg keeps."""
    standing_scale: Fraction = 0.5
    """Share of the gains while the robot stands on four feet."""
    max_joint_speed: Positive = 15.0
    """Bound on the differentiated joint targets, rad/s."""


class ContactConfig(Record, frozen=True, kw_only=True):
    """From foot force to contact."""

    threshold: Positive
    """Vertical force that means contact, N."""
    release: PositiveFraction = 0.5
    """Contact is lost below this share of the threshold."""
    blanking: Fraction = 0.5
    """Share of the swing, from liftoff, in which no contact is believed."""
    force_time_constant: NonNegative = 0.005
    """Low-pass of the force that begins a contact, s."""
    lift_speed: Positive = 1.5
    """A foot that moves faster over the ground, while another one rests, is in the air, m/s."""
    baseline: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Vertical force that each leg's torque feigns, N; the calibration has the last word."""
    lie_rise: Positive = 0.03
    """A foot that has risen so far from where it stood, m, and still bears, lies ..."""
    lie_time: tuple[Positive, Positive] = (0.05, 0.015)
    """... and so does one that presses down and feels nothing: told by so much at least of a stance, a swing, s."""
    lie_strides: Annotated[int, Meta(ge=1, le=20)] = 3
    """A foot is doubted that lied in so many stances, or swings, one after the other."""
    doubt_time: NonNegative = 2.0
    """From the last of them on the schedule says for so long whether the foot is down, s; 0: what it feels does."""


class GrfConfig(Record, frozen=True, kw_only=True):
    """The quadratic programme of Eq. 3-4."""

    solver: str = "daqp"
    """``daqp``, ``proxqp`` or any name that qpsolvers knows."""
    second_solver: str = "proxqp"
    """Asked when the first one's result is not accepted."""
    friction: Annotated[float, Meta(gt=0, le=2)] = 0.6
    """Half-slope of the friction pyramid."""
    min_force: NonNegative = 5.0
    """f_min of a stance leg, N."""
    max_force: Positive
    """f_max of a stance leg, N."""
    wrench_weight: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 10.0, 10.0, 10.0)
    """H: force, then moment."""
    force_weight: Positive = 1e-3
    """P."""


class EstimatorConfig(Record, frozen=True, kw_only=True):
    """Noise of the Kalman filter that fuses accelerometer and leg odometry."""

    acceleration_noise: Positive = 1.0
    """m/s² as white noise over a tick."""
    foot_position_noise: Positive = 0.005
    """Of the kinematic foot position, m."""
    foot_velocity_noise: Positive = 0.1
    """Of the velocity that a stance leg tells, m/s."""
    slip_noise: Positive = 0.01
    """Random walk of a foot in contact, m/√s."""
    settling_time: NonNegative = 0.01
    """How long a foot that has just landed is not believed to rest, s."""
    slope_time_constant: NonNegative = 0.2
    """Low-pass of the ground's slope, s."""
    height_time_constant: NonNegative = 0.02
    """Low-pass of the height, s."""


class BoundsConfig(Record, frozen=True, kw_only=True):
    """Bounds on what the policy may ask and the operator may command."""

    shift: Positive = 0.15
    """Each foot shift, m."""
    force: Positive3 = (250.0, 250.0, 250.0)
    """Wanted force about gravity's, N."""
    moment: Positive3 = (100.0, 100.0, 100.0)
    """Wanted moment, N·m."""
    linear_velocity: tuple[Positive, Positive]
    """Commanded speed forward/backward and sideways, m/s."""
    yaw_rate: Positive
    """Commanded turn, rad/s."""
    linear_acceleration: Positive = 2.0
    """How fast the followed command may change, m/s²."""
    yaw_acceleration: Positive = 4.0
    """rad/s²."""


class ControlConfig(Record, frozen=True, kw_only=True):
    """All of ``[control]``."""

    rate_hz: Annotated[float, Meta(ge=50, le=1000)]
    """Ticks a second."""
    policy: str
    """File name of the policy: absolute, beside the robot's TOML or among the shipped ones."""
    gait: GaitConfig
    gains: GainsConfig
    contact: ContactConfig
    grf: GrfConfig
    estimator: EstimatorConfig = EstimatorConfig()
    bounds: BoundsConfig
