"""Obstacles that move by themselves: people on the ground, other aircraft in the air. They do not see the robot.

Each moves in a random direction at a random speed, turns and stops at random, and never hits a static obstacle. In
every tick it moves on only if it could still stop before every static obstacle afterwards; otherwise it brakes. So it
never exceeds its largest acceleration and speed. Moving obstacles pass through one another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.arena_kinds import MoverKind
from brakeline.messaging.obstacle import CYLINDER, SPHERE, Array, Obstacle, Shapes
from brakeline.messaging.obstacle_motion import Motion, Sighting

TICK = 0.05  # s; the acceleration of a moving obstacle is constant between two ticks
MEAN_WISH_TIME = 2.0  # s, mean time until it chooses another velocity
STAND_SHARE = 0.25  # share of its choices that are to stand
STOP_SAMPLES = 6  # positions at which the way to a stop is checked
STATIC_GAP = 0.02  # m, distance to static obstacles beyond the interpolation error of these samples


class Crowd:
    """The moving obstacles of one arena in one episode; their positions are a function of the time alone."""

    def __init__(self, kind: MoverKind, positions: Array, static: Shapes, seed: int) -> None:
        """Start at positions (n, d) [m], which are free of the `static` obstacles, at time 0."""
        self.kind, self._static = kind, static
        self._rng = np.random.default_rng((seed, 7))
        self._wish = self._draw_wishes(positions)
        self._ticks: list[tuple[Array, Array, Array]] = []  # position, velocity, acceleration at each tick
        self._next = (np.array(positions, dtype=float), np.zeros_like(positions, dtype=float))
        self._advance()

    def __len__(self) -> int:
        return len(self._next[0])

    @property
    def dim(self) -> int:
        return int(self._next[0].shape[1])

    @property
    def pushes(self) -> bool:
        """Whether a moving obstacle pushes a robot that it runs into, instead of stepping over it."""
        return not self.kind.steps_over

    def at(self, time: float) -> tuple[Array, Array]:
        """Return positions and velocities (n, d) at a time [s] >= 0."""
        tick = int(time / TICK + 1e-9)
        while len(self._ticks) <= tick:
            self._advance()
        position, velocity, acceleration = self._ticks[tick]
        t = max(0.0, time - tick * TICK)
        return position + velocity * t + 0.5 * acceleration * t * t, velocity + acceleration * t

    def obstacles(self, time: float) -> tuple[Obstacle, ...]:
        """Return the crowd as obstacles at a time [s], without their motion."""
        return tuple(_mover(position, self.kind.radius) for position in self.at(time)[0].tolist())

    def _draw_wishes(self, positions: Array) -> Array:
        """Draw the desired velocities (n, d) [m/s]."""
        direction = self._rng.normal(size=positions.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        count = len(direction)
        speed = self.kind.speed * self._rng.uniform(0.2, 1.0, count) * (self._rng.random(count) >= STAND_SHARE)
        return np.asarray(direction * speed[:, None])

    def _advance(self) -> None:
        position, velocity = self._next
        most_change = self.kind.acceleration * TICK
        changes = self._rng.random(len(position)) < TICK / MEAN_WISH_TIME
        fresh = self._draw_wishes(position)
        self._wish = np.where(changes[:, None], fresh, self._wish)
        wanted = velocity + _shortened(self._wish - velocity, most_change)
        braked = velocity - _shortened(velocity, most_change)
        able = self._can_stop(position + 0.5 * (velocity + wanted) * TICK, wanted)
        self._wish[~able] = fresh[~able]
        after = np.where(able[:, None], wanted, braked)
        acceleration = (after - velocity) / TICK
        self._ticks.append((position, velocity, acceleration))
        self._next = position + velocity * TICK + 0.5 * acceleration * TICK * TICK, after

    def _can_stop(self, position: Array, velocity: Array) -> NDArray[np.bool_]:
        """Return whether each obstacle of the crowd can stop before every static obstacle, as a mask (n,)."""
        if not len(self._static):
            return np.ones(len(position), dtype=bool)
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        path = velocity * speed / (2.0 * self.kind.acceleration)
        samples = position[:, None] + np.linspace(0.0, 1.0, STOP_SAMPLES)[:, None] * path[:, None]
        clearance = self._static.distance(samples).min(axis=0)  # (n, STOP_SAMPLES)
        half_spacing = 0.5 * np.linalg.norm(path, axis=1, keepdims=True) / (STOP_SAMPLES - 1)
        return np.asarray((clearance >= self.kind.radius + half_spacing + STATIC_GAP).all(axis=1))


class OtherRobots:
    """The other robots of a shared world, which a lidar sees as discs at their present positions."""

    pushes = True

    def __init__(self, now: Callable[[], Array], radius: float, reported: Callable[[], tuple[Array, Array]]) -> None:
        """Connect to the other robots of a shared world.

        Args:
            now: returns their true positions (n, 2) [m].
            reported: returns the positions [m] and velocities [m/s] (n, 2) that they measure and report to each other.
        """
        self._now, self._radius, self.reported = now, radius, reported

    def __len__(self) -> int:
        return len(self._now())

    def at(self, time: float) -> tuple[Array, Array]:
        """Return the present positions (n, 2) whatever the time, and zero velocities."""
        positions = self._now().reshape(-1, 2)
        return positions, np.zeros_like(positions)

    def obstacles(self, time: float) -> tuple[Obstacle, ...]:
        """Return the robots as obstacles at their present positions."""
        return tuple(_mover(position, self._radius) for position in self.at(time)[0].tolist())


class CrowdSensor:
    """Measures the positions and velocities of a crowd with errors, and adds the previous measurement to each."""

    def __init__(self, crowd: Crowd, rng: np.random.Generator) -> None:
        self._crowd, self._rng = crowd, rng
        self._before: list[Sighting | None] = [None] * len(crowd)
        self._last_time = 0.0

    def measure(self, time: float) -> tuple[Obstacle, ...]:
        """Return the crowd with its motion, as measured at a time [s]."""
        kind = self._crowd.kind
        positions, velocities = self._crowd.at(time)
        positions = positions + self._errors(kind.position_error)
        velocities = velocities + self._errors(kind.velocity_error)
        obstacles, age = [], time - self._last_time
        for i, (position, velocity) in enumerate(zip(positions.tolist(), velocities.tolist(), strict=True)):
            before = self._before[i]
            if before is not None:
                before = Sighting(before.position, before.velocity, age)
            self._before[i] = Sighting(tuple(position), tuple(velocity), 0.0)
            motion = Motion(
                tuple(velocity), kind.position_error, kind.velocity_error, acceleration=kind.acceleration, before=before
            )
            obstacles.append(_mover(position, kind.radius, motion))
        self._last_time = time
        return tuple(obstacles)

    def _errors(self, most: float) -> Array:
        """Draw errors (n, d) in random directions, none longer than `most`."""
        error = self._rng.normal(size=(len(self._crowd), self._crowd.dim))
        length = np.maximum(np.linalg.norm(error, axis=1, keepdims=True), 1e-12)
        error *= most * self._rng.random((len(error), 1)) / length
        return np.asarray(error)


def _mover(position: list[float], radius: float, motion: Motion | None = None) -> Obstacle:
    return Obstacle(SPHERE if len(position) == 3 else CYLINDER, tuple(position), (radius,), motion=motion)


def _shortened(vectors: Array, most: float) -> Array:
    """Return vectors (n, d), each shortened to at most `most`."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, most / np.maximum(length, 1e-12)))
