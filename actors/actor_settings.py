"""Settings of an actor. This module imports nothing heavy, since the launcher reads it too."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class PhysicsChange:
    """A change of each robot's physics during a run, so that the robot differs from the one in the recorded data.

    A value of None changes nothing. A robot kind raises an error for a value that it does not have.
    """

    after: int = -1
    """Change the physics after this many steps of each robot. If it learns, its steps before a restart and those of
    --from-logs count too. -1 never changes them."""
    payload_kg: float | None = None
    """Put this mass on top of the robot [kg]."""
    floor_friction: float | None = None
    """Set the friction coefficient of the wheels on the floor."""
    weak_motor: float | None = None
    """Leave one motor this share of its force, in (0, 1]."""
    wind_speed: float | None = None
    """Blow with this mean wind speed [m/s]."""
    gust: float | None = None
    """Let the wind vary on each axis with this standard deviation [m/s]."""

    def changes(self) -> dict[str, float]:
        """Return the arguments for a vehicle's `alter`."""
        values = {name: value for name, value in asdict(self).items() if name != "after"}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class FlightSettings:
    """The autopilot of a flight, and how to fly it."""

    url: str
    system: int = 1
    """Address the vehicle by this MAVLink system id."""
    truth: int = 0
    """Receive the ground truth of a simulator at this UDP port. 0 expects none."""
    height: float = 3.0
    """Climb to this height above the ground, unless the vehicle flies already [m]."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place the start of the autopilot's local frame here in the world frame [m]."""
    raise_limits: bool = False
    """Raise the autopilot's parameters that are below the robot's bounds."""
    lead: bool = False
    """Send positions ahead of the vehicle instead of velocities."""
    acceleration_age: float = 0.0
    """Report the horizontal acceleration of this long ago instead of the present one [s]. It must be the age with which
    the model set was recorded; `brakeline fly` takes it from the model set."""
