"""What may differ between the robot that was recorded and the one that drives."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from sim.estimator import NoiseLevels
from sim.flight_estimator import QuadrotorNoise
from sim.scanner import Perception
from sim.wind import Wind


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
        return said | {"perception": self.perception.kind} | faults

    def lidar_noise(self, flies: bool) -> float:
        """Sigma of a range, m."""
        noise = self.flight_noise if flies else self.noise
        return noise.scale * noise.lidar
