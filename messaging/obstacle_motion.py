"""How an obstacle moves: what was measured of it, how wrong that may be, and a bound on what it does from then on.

`t` seconds after the measurement an obstacle O with velocity c lies in

    O + c t + ball(r(t)),    r(t) = δ_p + δ_v t + a t²/2    (a: its largest acceleration)
                             r(t) = δ_p + s t, c = 0        (s: its largest speed; nothing else is known)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

SAME = 1e-9  # m, m/s: rounding allowed when a measurement is compared with an earlier one


@dataclass(frozen=True)
class Sighting:
    """The measurement before: where it was, how fast, and how many seconds earlier."""

    position: tuple[float, ...]  # m
    velocity: tuple[float, ...]  # m/s
    since: float  # s


@dataclass(frozen=True)
class Motion:
    """Of one obstacle. Either `acceleration` [m/s²] or `speed` [m/s] bounds it; with `speed` no velocity is used."""

    velocity: tuple[float, ...]  # m/s, measured
    position_error: float  # m, δ_p: how far its true place may be from the measured one
    velocity_error: float = 0.0  # m/s, δ_v
    acceleration: float | None = None
    speed: float | None = None
    age: float = 0.0  # s since it was measured
    before: Sighting | None = None  # to be compared with; None: seen for the first time

    def wrong(self, dim: int) -> str:
        """What is wrong with it as the motion of a `dim`-dimensional obstacle; empty: nothing."""
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

    def radius(self, t: float) -> float:
        """r(t) [m]."""
        if self.speed is not None:
            return self.position_error + self.speed * t
        return self.position_error + self.velocity_error * t + 0.5 * (self.acceleration or 0.0) * t * t

    def drift(self) -> tuple[float, ...]:
        """c [m/s]."""
        return self.velocity if self.speed is None else (0.0,) * len(self.velocity)

    def kept(self, position: tuple[float, ...]) -> bool:
        """Is what is measured now where the measurement before, with these bounds, says that it can be?"""
        if self.before is None:
            return True
        then, t = self.before, self.before.since
        moves = then.velocity if self.speed is None else (0.0,) * len(position)
        away = math.dist(position, [p + c * t for p, c in zip(then.position, moves, strict=True)])
        if away > self.radius(t) + self.position_error + SAME:
            return False
        if self.acceleration is None:
            return True
        turned = math.dist(self.velocity, then.velocity)
        return turned <= self.acceleration * t + 2.0 * self.velocity_error + SAME
