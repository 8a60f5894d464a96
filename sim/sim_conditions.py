"""Simulation conditions that can differ between the recorded data and a run: noise, payload, friction, wind.

This module imports nothing slow: every command that starts a run reads it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields

from brakeline.messaging.number_checks import check_numbers


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations of the ground robot's sensor errors: normal, cut off at two standard deviations.

    `scale` = 0 switches all errors off but the encoders' resolution.
    """

    scale: float = 1.0  # multiplies every value below but the ticks
    encoder_ticks: int = 4096  # per turn of the wheel
    wheel_scale: float = 0.003  # relative error of each wheel's radius, constant over an episode
    wheel_slip: float = 0.01  # relative slip of each wheel, drawn for each sample
    gyro: float = 0.005  # rad/s, drawn for each sample
    gyro_bias: float = 0.001  # rad/s, constant over an episode
    fix_position: float = 0.005  # m, x and y each, drawn for each period
    fix_heading: float = 0.01  # rad, drawn for each period
    lidar: float = 0.01  # m, each ray
    drift_position: float = 0.001  # m, odometry's drift in a period as the estimator assumes it
    drift_heading: float = 0.0015  # rad, the same for the heading

    def __post_init__(self) -> None:
        check_numbers(self, "scale", "wheel_scale", "wheel_slip", "gyro", "gyro_bias", "lidar", least=0.0)
        check_numbers(self, "drift_position", "drift_heading", least=0.0)
        check_numbers(self, "fix_position", "fix_heading", above=0.0)
        check_numbers(self, "encoder_ticks", least=1)


@dataclass(frozen=True)
class ProcessNoise:
    """Standard deviations of the disturbances of the ground robot's true motion, each cut off at three of its own.

    The wheels' speeds and the tilts of the floor fluctuate as first-order Gauss-Markov processes, with a value for each
    sample of 20 ms. `scale` = 0 switches all of them off.

    Sources: the motors of a TurtleBot3 Burger (XL430-W250) take speeds in units of 0.229 rev/min, which is 0.3 % of the
    fastest speed of a wheel and 1.6 % of a fifth of it. A finished floor may deviate by 4 mm within 1 m (DIN 18202,
    table 3, line 3). The ROBOTIS navigation files assume errors of motion of 20 % (alpha1 to alpha4 of AMCL), so these
    values are small.
    """

    scale: float = 1.0  # multiplies every standard deviation below
    motor_gain: float = 0.01  # relative error of each motor's speed, constant over an episode
    wheel_speed: float = 0.015  # relative fluctuation of each wheel's speed: load, battery, dirt
    wheel_correlation: float = 0.3  # s
    floor_tilt: float = 0.004  # rad, about each axis: 4 mm within 1 m
    floor_correlation: float = 0.5  # s

    def __post_init__(self) -> None:
        levels = (self.scale, self.motor_gain, self.wheel_speed, self.floor_tilt)
        if not all(0.0 <= level < math.inf for level in levels):
            raise ValueError("process noise: the scale and all standard deviations are finite, and 0 or more")
        if not (self.wheel_correlation > 0.0 and self.floor_correlation > 0.0):
            raise ValueError("process noise: a correlation time is more than 0 s")


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the errors of a real autopilot's sensors: normal, of each axis at each reading.

    A bias is drawn once. The defaults are those of a small IMU and an RTK receiver. The map is exact to centimetres,
    and a filter cannot use it behind a position that is wrong by metres. An ordinary receiver has `gps_position` 0.5
    and `gps_velocity` 0.1.
    """

    scale: float = 1.0  # multiplies every value below; 0 switches errors off
    accelerometer: float = 0.05  # m/s²
    accelerometer_bias: float = 0.05  # m/s²
    gyro: float = 0.003  # rad/s
    gyro_bias: float = 0.002  # rad/s
    magnetometer: float = 0.003  # gauss
    magnetometer_bias: float = 0.005  # gauss
    barometer: float = 0.15  # m
    barometer_bias: float = 1.0  # m, from the weather
    gps_position: float = 0.015  # m
    gps_velocity: float = 0.02  # m/s


@dataclass(frozen=True)
class QuadrotorNoise:
    """Standard deviations of the quadrotor's errors: normal, cut off at two standard deviations (`CUT`).

    `scale` = 0 switches them off. With scale 1 the errors stay within the robot's `measurement_bound`: position and
    velocity because of the cut-off. The acceleration has the accelerometer's error and, by an error of the attitude, a
    share of up to 30 m/s²: together at most √3·`CUT`·(0.04 + 0.001·30), less than 0.25 m/s².
    """

    scale: float = 1.0  # multiplies every value below
    position: float = 0.0145  # m, each axis
    velocity: float = 0.0145  # m/s, each axis
    attitude: float = 0.001  # rad, about each axis
    accelerometer: float = 0.04  # m/s², each axis, drawn for each reading
    gyro: float = 0.005  # rad/s, each axis, drawn for each reading
    lidar: float = 0.02  # m, each ray

    def __post_init__(self) -> None:
        check_numbers(self, *(level.name for level in fields(self)), least=0.0)


@dataclass(frozen=True)
class Wind:
    """Wind. Gusts are a first-order Gauss-Markov process on each axis (as Dryden's along the wind)."""

    speed: float = 0.0  # m/s, mean, horizontal
    direction: float | None = None  # rad from east, where the wind blows to; None: drawn for each vehicle
    gust: float = 0.0  # m/s, standard deviation on each axis, cut off at `GUST_LIMIT` of them
    correlation: float = 1.5  # s, correlation time of the gusts

    def __post_init__(self) -> None:
        check_numbers(self, "speed", "gust", least=0.0)
        check_numbers(self, "direction")
        check_numbers(self, "correlation", above=0.0)

    @property
    def calm(self) -> bool:
        return self.speed == 0.0 and self.gust == 0.0


@dataclass(frozen=True)
class SensorFaults:
    """Faults of a range sensor. Shares are shares of the beams, drawn for each scan."""

    dropped: float = 0.0  # share without a return
    far: float = 0.0  # share that passes through obstacles
    ghosts: float = 0.0  # share that returns from free space
    blind: float = 0.0  # rad, a hidden sector behind the robot
    late: int = 0  # periods until a scan arrives

    def __post_init__(self) -> None:
        if not all(0.0 <= share <= 1.0 for share in (self.dropped, self.far, self.ghosts)):
            raise ValueError("the shares of dropped, far and ghost beams are between 0 and 1")
        if not 0.0 <= self.blind <= 2.0 * math.pi or self.late < 0:
            raise ValueError("a blind sector has 0 to 2π rad, and scans are late by 0 periods or more")


@dataclass(frozen=True)
class Perception:
    """The source of free space: `map`, the true obstacles of the arena, or `scan`, a range sensor."""

    kind: str = "map"
    faults: SensorFaults = SensorFaults()
    tracks: bool = False  # the acceleration of moving obstacles is known, so the filter tracks them

    def __post_init__(self) -> None:
        if self.kind not in ("map", "scan"):
            raise ValueError(f"perception is 'map' or 'scan', not {self.kind!r}")
        if self.faults != SensorFaults() and self.kind != "scan":
            raise ValueError("sensor faults need scans: add --perception scan")
        if self.tracks and self.kind != "scan":
            raise ValueError("tracks need scans: add --perception scan")


# What not every simulator has, in the words of a message.
OPTIONAL = {
    "payload_kg": "payload",
    "floor_friction": "friction of a floor",
    "weak_motor": "weak motor",
    "wind": "wind",
    "process_noise": "disturbances of the motion",
    "learned": "motion by a model set",
}


@dataclass(frozen=True)
class Conditions:
    """All conditions, of every kind of robot.

    `noise` counts for robots on the floor and `flight_noise` for those in the air, which ignore the other one.
    weak_motor: share of its force that one motor keeps.
    learned: the robot's model set simulates it, in place of the simulator of its task.
    """

    noise: NoiseLevels = field(default_factory=NoiseLevels)
    payload_kg: float = 0.0
    floor_friction: float = 1.0
    flight_noise: QuadrotorNoise = field(default_factory=QuadrotorNoise)
    wind: Wind = field(default_factory=Wind)
    perception: Perception = field(default_factory=Perception)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    weak_motor: float = 1.0
    learned: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.payload_kg) and self.payload_kg >= 0.0):
            raise ValueError(f"a payload has 0 kg or more, not {self.payload_kg:g}")
        if not (math.isfinite(self.floor_friction) and self.floor_friction > 0.0):
            raise ValueError(f"the friction of a floor is above 0, not {self.floor_friction:g}")
        if not 0.0 < self.weak_motor <= 1.0:
            raise ValueError(f"a weak motor keeps more than 0 and at most 1 of its force, not {self.weak_motor:g}")

    @property
    def unusual(self) -> tuple[str, ...]:
        """The names of the optional conditions that differ from their defaults."""
        usual = Conditions()
        return tuple(name for name in OPTIONAL if getattr(self, name) != getattr(usual, name))

    def check(self, *simulated: str) -> None:
        """Refuse what a simulator would ignore, so that nobody takes a calm flight for one in wind.

        Args:
            simulated: names of the optional conditions (`OPTIONAL`) that the simulator has.

        Raises:
            ValueError: another one differs from its default.
        """
        if ignored := [OPTIONAL[name] for name in self.unusual if name not in simulated]:
            raise ValueError(f"the simulator of this robot has no {' and no '.join(ignored)}")

    def describe(self) -> dict[str, str]:
        """Return every condition with its value, for metadata and printed results."""
        values = asdict(self.noise) | {"payload_kg": self.payload_kg, "floor_friction": self.floor_friction}
        values["weak_motor"] = self.weak_motor
        values |= {f"process_{name}": value for name, value in asdict(self.process_noise).items()}
        values |= {f"flight_{name}": value for name, value in asdict(self.flight_noise).items()}
        values |= {f"wind_{name}": value for name, value in asdict(self.wind).items()}
        texts = {name: "drawn" if value is None else f"{value:g}" for name, value in values.items()}
        if self.learned:
            texts["learned"] = "True"
        if self.perception.kind == "map":
            return texts
        faults = {f"scan_{name}": f"{value:g}" for name, value in asdict(self.perception.faults).items()}
        return texts | {"perception": self.perception.kind, "tracks": str(self.perception.tracks)} | faults

    def lidar_noise(self, flies: bool) -> float:
        """Return the standard deviation of a range [m] for a robot that flies or not."""
        noise = self.flight_noise if flies else self.noise
        return noise.scale * noise.lidar
