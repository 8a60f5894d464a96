"""What moves in an arena by itself: people on the ground, other aircraft in the air. They do not see the robot.

Each walks at a random speed in a random direction, turns, and stops, at random, and never into what stands still: in
every tick it does as it wants only if it could still stop in front of everything after that; else it brakes, as it then
can. So it keeps to its acceleration and speed at all times, whatever it wants. They pass through one another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import CYLINDER, SPHERE, Obstacle, Shapes
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.messaging.task import MoverKind

Array = NDArray[np.float64]

TICK = 0.05  # s; between two ticks a mover's acceleration is constant
CHANGE = 2.0  # s until it wants something else, on average
STANDS = 0.25  # of these times it wants to stand
CHECKED = 6  # places at which a way to a stop is looked at
AIR = 0.02  # m kept to what stands, between these


class Crowd:
    """The movers of one arena in one episode: where they are is a function of the time alone."""

    def __init__(self, kind: MoverKind, positions: Array, still: Shapes, seed: int) -> None:
        """positions (n, d): at time 0, free; still: what they keep off; seed: of everything that they do."""
        self.kind, self._still = kind, still
        self._rng = np.random.default_rng((seed, 7))
        self._wish = self._wishes(positions)
        self._ticks: list[tuple[Array, Array, Array]] = []  # position, velocity, acceleration from each tick on
        self._next = (np.array(positions, dtype=float), np.zeros_like(positions, dtype=float))
        self._advance()

    def __len__(self) -> int:
        return len(self._next[0])

    @property
    def dim(self) -> int:
        return int(self._next[0].shape[1])

    @property
    def pushes(self) -> bool:
        """Whoever it runs into, or does it step over it?"""
        return not self.kind.steps_over

    def at(self, time: float) -> tuple[Array, Array]:
        """Positions and velocities (n, d) at a time [s] ≥ 0."""
        tick = int(time / TICK + 1e-9)
        while len(self._ticks) <= tick:
            self._advance()
        position, velocity, push = self._ticks[tick]
        t = max(0.0, time - tick * TICK)
        return position + velocity * t + 0.5 * push * t * t, velocity + push * t

    def obstacles(self, time: float) -> tuple[Obstacle, ...]:
        """As they are at that time, without a motion."""
        kind = SPHERE if self.dim == 3 else CYLINDER
        return tuple(Obstacle(kind, tuple(place), (self.kind.radius,)) for place in self.at(time)[0].tolist())

    def _wishes(self, positions: Array) -> Array:
        """Velocities (n, d) that they would like to have."""
        draw = self._rng.normal(size=positions.shape)
        draw /= np.linalg.norm(draw, axis=1, keepdims=True)
        speed = self.kind.speed * self._rng.uniform(0.2, 1.0, len(draw)) * (self._rng.random(len(draw)) >= STANDS)
        return np.asarray(draw * speed[:, None])

    def _advance(self) -> None:
        """One tick."""
        position, velocity = self._next
        most = self.kind.acceleration * TICK
        changes = self._rng.random(len(position)) < TICK / CHANGE
        fresh = self._wishes(position)
        self._wish = np.where(changes[:, None], fresh, self._wish)
        wanted = velocity + _shortened(self._wish - velocity, most)
        braked = velocity - _shortened(velocity, most)
        able = self._stops(position + 0.5 * (velocity + wanted) * TICK, wanted)
        self._wish[~able] = fresh[~able]
        after = np.where(able[:, None], wanted, braked)
        push = (after - velocity) / TICK
        self._ticks.append((position, velocity, push))
        self._next = position + velocity * TICK + 0.5 * push * TICK * TICK, after

    def _stops(self, position: Array, velocity: Array) -> NDArray[np.bool_]:
        """Can they stop in front of everything? (n,)"""
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        way = velocity * speed / (2.0 * self.kind.acceleration)
        places = position[:, None] + np.linspace(0.0, 1.0, CHECKED)[:, None] * way[:, None]
        if not len(self._still):
            return np.ones(len(position), dtype=bool)
        clear = self._still.distance(places).min(axis=0)  # (n, CHECKED)
        between = 0.5 * np.linalg.norm(way, axis=1, keepdims=True) / (CHECKED - 1)
        return np.asarray((clear >= self.kind.radius + between + AIR).all(axis=1))


class OtherRobots:
    """The other robots of a world, where a lidar sees them: as discs about where they are now."""

    pushes = True

    def __init__(self, now: Callable[[], Array], radius: float, told: Callable[[], tuple[Array, Array]]) -> None:
        """now: their true positions (n, 2), none for n = 0; radius [m]; told: positions and velocities (n, 2) as they
        measure them themselves, and say to each other."""
        self._now, self._radius, self.told = now, radius, told

    def __len__(self) -> int:
        return len(self._now())

    def at(self, time: float) -> tuple[Array, Array]:
        """Positions (n, 2), whatever the time is; velocities are not known."""
        places = self._now().reshape(-1, 2)
        return places, np.zeros_like(places)

    def obstacles(self, time: float) -> tuple[Obstacle, ...]:
        """As they are."""
        return tuple(Obstacle(CYLINDER, tuple(place), (self._radius,)) for place in self.at(time)[0].tolist())


class CrowdSensor:
    """What a robot's sensors tell of a crowd: places and velocities with errors, each beside the one before."""

    def __init__(self, crowd: Crowd, rng: np.random.Generator) -> None:
        self._crowd, self._rng = crowd, rng
        self._before: list[Sighting | None] = [None] * len(crowd)
        self._at = 0.0

    def look(self, time: float) -> tuple[Obstacle, ...]:
        """All of them, measured at this time [s]."""
        kind, form = self._crowd.kind, SPHERE if self._crowd.dim == 3 else CYLINDER
        positions, velocities = self._crowd.at(time)
        positions = positions + self._errors(kind.position_error)
        velocities = velocities + self._errors(kind.velocity_error)
        seen, since = [], time - self._at
        for i, (place, pace) in enumerate(zip(positions.tolist(), velocities.tolist(), strict=True)):
            before = self._before[i]
            if before is not None:
                before = Sighting(before.position, before.velocity, since)
            self._before[i] = Sighting(tuple(place), tuple(pace), 0.0)
            motion = Motion(
                tuple(pace), kind.position_error, kind.velocity_error, acceleration=kind.acceleration, before=before
            )
            seen.append(Obstacle(form, tuple(place), (kind.radius,), motion=motion))
        self._at = time
        return tuple(seen)

    def _errors(self, most: float) -> Array:
        draw = self._rng.normal(size=(len(self._crowd), self._crowd.dim))
        draw *= most * self._rng.random((len(draw), 1)) / np.maximum(np.linalg.norm(draw, axis=1, keepdims=True), 1e-12)
        return np.asarray(draw)


def _shortened(vectors: Array, most: float) -> Array:
    """Vectors (n, d), none longer than that."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, most / np.maximum(length, 1e-12)))
