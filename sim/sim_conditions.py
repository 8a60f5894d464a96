"""What may differ between the robot that was recorded and the one that drives. Nothing heavy here: whoever starts a run
reads it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class NoiseLevels:
    """Sensor errors of the ground robot. All are normal, cut off at `CUT` sigma; `scale` = 0 switches them off.

    The encoders' ticks stay: they are the sensor's grid, not noise.
    """

    scale: float = 1.0  # multiplies every sigma below
    encoder_ticks: int = 4096  # a turn of the wheel
    wheel_scale: float = 0.003  # 1, error of each wheel's radius, constant over an episode
    wheel_slip: float = 0.01  # 1, share of the way that a wheel slips, anew each sample
    gyro: float = 0.005  # rad/s, anew each sample
    gyro_bias: float = 0.001  # rad/s, constant over an episode
    fix_position: float = 0.005  # m, x and y each, anew each period
    fix_heading: float = 0.01  # rad, anew each period
    lidar: float = 0.01  # m, each ray
    drift_position: float = 0.001  # m, what the filter takes odometry to lose in a period
    drift_heading: float = 0.0015  # rad, likewise


@dataclass(frozen=True)
class QuadrotorNoise:
    """Errors of the quadrotor's estimate and sensors. All are normal, cut off at `CUT` sigma; `scale` = 0: none.

    With scale 1 they stay within QUADROTOR.measurement_bound: position and velocity by their cut; acceleration, in
    which the accelerometer's error adds to a wrong attitude's share of up to 30 m/s², by √3·CUT·(0.04 + 0.001·30),
    less than 0.25 m/s².
    """

    scale: float = 1.0  # multiplies every sigma below
    position: float = 0.0145  # m, each axis
    velocity: float = 0.0145  # m/s, each axis
    attitude: float = 0.001  # rad, about each axis
    accelerometer: float = 0.04  # m/s², each axis, anew at each reading
    gyro: float = 0.005  # rad/s, each axis, anew at each reading
    lidar: float = 0.02  # m, each ray


@dataclass(frozen=True)
class Wind:
    """The air about a vehicle. Gusts are a first-order Gauss-Markov process on each axis (Dryden's along the wind)."""

    speed: float = 0.0  # m/s, mean, horizontal
    direction: float | None = None  # rad from east, where it blows to; None: drawn anew for each vehicle
    gust: float = 0.0  # m/s, standard deviation on each axis, cut off at `GUST_CUT` of it
    correlation: float = 1.5  # s

    @property
    def calm(self) -> bool:
        return self.speed == 0.0 and self.gust == 0.0


@dataclass(frozen=True)
class SensorFaults:
    """What ails the beams. Shares are of beams, anew each scan."""

    dropped: float = 0.0  # share that says nothing
    far: float = 0.0  # share that sees through what is there
    ghosts: float = 0.0  # share that returns from where nothing is
    blind: float = 0.0  # rad about straight behind that is hidden
    late: int = 0  # periods until a scan is there

    def __post_init__(self) -> None:
        if not all(0.0 <= share <= 1.0 for share in (self.dropped, self.far, self.ghosts)):
            raise ValueError("the shares of dropped, false and ghost beams are between 0 and 1")
        if not 0.0 <= self.blind <= 2.0 * math.pi or self.late < 0:
            raise ValueError("a blind sector is between 0 and a turn, scans are late by 0 periods or more")


@dataclass(frozen=True)
class Perception:
    """Where free space comes from: `map`, the arena's obstacles as they are, or `scan`, what the sensor shows."""

    kind: str = "map"
    faults: SensorFaults = SensorFaults()
    tracks: bool = False  # among things that move: how fast they may speed up is known, and so they are followed

    def __post_init__(self) -> None:
        if self.kind not in ("map", "scan"):
            raise ValueError(f"free space comes from a map or from scans, not from {self.kind!r}")
        if self.faults != SensorFaults() and self.kind != "scan":
            raise ValueError(
                "dropped, false, ghost, blind and late beams are a scan's: ask for it, too (--perception scan)"
            )
        if self.tracks and self.kind != "scan":
            raise ValueError("tracks are made of scans: ask for these, too (--perception scan)")


@dataclass(frozen=True)
class Conditions:
    """Of every robot kind."""

    noise: NoiseLevels = field(default_factory=NoiseLevels)
    payload_kg: float = 0.0
    floor_friction: float = 1.0
    flight_noise: QuadrotorNoise = field(default_factory=QuadrotorNoise)
    wind: Wind = field(default_factory=Wind)
    perception: Perception = field(default_factory=Perception)

    def describe(self) -> dict[str, str]:
        """For metadata and printed results: every level with its value."""
        values = asdict(self.noise) | {"payload_kg": self.payload_kg, "floor_friction": self.floor_friction}
        values |= {f"flight_{name}": value for name, value in asdict(self.flight_noise).items()}
        values |= {f"wind_{name}": value for name, value in asdict(self.wind).items()}
        said = {name: "drawn" if value is None else f"{value:g}" for name, value in values.items()}
        if self.perception.kind == "map":
            return said
        faults = {f"scan_{name}": f"{value:g}" for name, value in asdict(self.perception.faults).items()}
        return said | {"perception": self.perception.kind, "tracks": str(self.perception.tracks)} | faults

    def lidar_noise(self, flies: bool) -> float:
        """Sigma of a range, m."""
        noise = self.flight_noise if flies else self.noise
        return noise.scale * noise.lidar
