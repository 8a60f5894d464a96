"""What an actor can be told of its robots. Nothing heavy here: whoever starts a run reads it."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class PhysicsChange:
    """What becomes of each robot after so many steps: the robot that was recorded is not the one that drives on.

    What is None stays as it is; a robot kind refuses what it does not have.
    """

    after: int = -1  # -1: never
    payload_kg: float | None = None
    floor_friction: float | None = None
    wind_speed: float | None = None  # m/s
    gust: float | None = None  # m/s

    def changes(self) -> dict[str, float]:
        """What a vehicle's `alter` takes."""
        values = {name: value for name, value in asdict(self).items() if name != "after"}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class FlightSettings:
    """Which autopilot, and where it is."""

    url: str
    system: int = 1  # MAVLink system id
    truth: int = 0  # UDP port at which a simulator tells collisions; 0: none does
    height: float = 3.0  # m above the ground that it climbs to, unless it flies already
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m: where the autopilot's local frame begins
    raise_limits: bool = False  # set the parameters that hold the vehicle below what the filter may ask for
    lead: bool = False  # tell it places to go to in place of velocities
