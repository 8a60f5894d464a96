"""The motion of an obstacle: its measured velocity, the measurement errors, and a bound on its future motion.

`t` seconds after the measurement, an obstacle O with velocity c lies in

    O + c t + ball(r(t)),    r(t) = δ_p + δ_v t + a t²/2    with a largest acceleration a
                             r(t) = δ_p + s t, c = 0        with a largest speed s
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

ROUNDING = 1e-9  # when two measurements are compared [m, m/s]


def freeze_vectors(owner: Any, *names: str) -> None:
    """Make tuples of a frozen dataclass's arrays and lists: a tracker overwrites its arrays."""
    for name in names:
        if not isinstance(value := getattr(owner, name), tuple) and hasattr(value, "__len__"):
            object.__setattr__(owner, name, tuple(value))


@dataclass(frozen=True)
class Sighting:
    """The previous measurement of an obstacle."""

    position: tuple[float, ...]  # [m]
    velocity: tuple[float, ...]  # [m/s]
    since: float  # time between the previous measurement and this one [s]

    def __post_init__(self) -> None:
        freeze_vectors(self, "position", "velocity")


@dataclass(frozen=True)
class Motion:
    """The motion of an obstacle. Exactly one of `acceleration` and `speed` bounds it; `speed` ignores the velocity.

    The shape moves without turning. Of an obstacle that also turns, give the disc or ball around the point that you
    track.

    >>> Motion(velocity=(0.5, 0.0), position_error=0.03, velocity_error=0.05, acceleration=2.0).radius(0.0)
    0.03

    Attributes:
        velocity: (d,) measured [m/s].
        position_error: δ_p, largest error of the measured position [m].
        velocity_error: δ_v, largest error of the measured velocity [m/s].
        acceleration: a, largest acceleration [m/s²].
        speed: s, largest speed in any direction [m/s].
        age: time since the measurement [s].
        before: the previous measurement; None: this is the first one.
    """

    velocity: tuple[float, ...]
    position_error: float
    velocity_error: float = 0.0
    acceleration: float | None = None
    speed: float | None = None
    age: float = 0.0
    before: Sighting | None = None

    def __post_init__(self) -> None:
        freeze_vectors(self, "velocity")

    def problem(self, dim: int) -> str:
        """Return the reason why this is no valid motion of an obstacle with `dim` coordinates; empty if it is valid."""
        vectors = [self.velocity, *((self.before.position, self.before.velocity) if self.before else ())]
        if any(len(vector) != dim for vector in vectors):
            return f"a motion's vectors have {dim} coordinates here"
        if not all(math.isfinite(value) for vector in vectors for value in vector):
            return "a motion's velocity and earlier sighting must be finite"
        if (self.acceleration is None) == (self.speed is None):
            return "a motion is bounded by an acceleration or by a speed: one of them"
        bounds = [self.position_error, self.velocity_error, self.age, self.before.since if self.before else 0.0]
        bounds += [bound for bound in (self.acceleration, self.speed) if bound is not None]
        if not all(math.isfinite(value) and value >= 0.0 for value in bounds):
            return "a motion's errors, bounds and times must be finite and not negative"
        return ""

    def growth(self) -> tuple[float, float, float]:
        """Return the coefficients of r(t) = growth · (1, t, t²)."""
        if self.speed is not None:
            return self.position_error, self.speed, 0.0
        return self.position_error, self.velocity_error, 0.5 * (self.acceleration or 0.0)

    def radius(self, t: float) -> float:
        """Return r(t) [m]."""
        constant, linear, quadratic = self.growth()
        return constant + linear * t + quadratic * t * t

    def drift(self) -> tuple[float, ...]:
        """Return c [m/s]."""
        return self.velocity if self.speed is None else (0.0,) * len(self.velocity)

    def is_consistent(self, position: tuple[float, ...]) -> bool:
        """Return whether the measured position and velocity lie within the bounds of the previous measurement."""
        if self.before is None:
            return True
        t = self.before.since
        drift = self.before.velocity if self.speed is None else (0.0,) * len(position)
        expected = [p + c * t for p, c in zip(self.before.position, drift, strict=True)]
        if math.dist(position, expected) > self.radius(t) + self.position_error + ROUNDING:
            return False
        if self.acceleration is None:
            return True
        change = math.dist(self.velocity, self.before.velocity)
        return change <= self.acceleration * t + 2.0 * self.velocity_error + ROUNDING
