"""What each robot kind observes: its lidar, its goal, itself; in the order of `task.observed`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.lidar import Lidar
from brakeline.sim.traffic import Crowd, CrowdSensor, OtherRobots

Array = NDArray[np.float64]

LIDAR_NOISE = 0.01  # m, sigma of a range


class ObservationModel(Protocol):
    """One robot's observations in one episode."""

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        """The observation after a period, unclipped. To be called once a period: it may remember.

        true: (n,) state, for the lidar's place alone; measured: (n,) state; input: (m,) executed last;
        time: s, of what moves.
        """

    def speed(self, state: Array) -> float:
        """Speed in a state (n,), m/s."""


@dataclass
class TurnMemory:
    """Measured turn rate through a first-order low pass, rad/s: the observation's one coordinate of memory.

    A policy without memory dithers in front of an obstacle that can be passed on both sides: as soon as it has turned
    a little to one side, noise makes the other look better. Seeing which way it has been turning for about
    `TIME` seconds it can go on turning that way.
    """

    TIME = 2.0  # s
    value: float = 0.0

    def update(self, turn_rate: float, period: float) -> None:
        self.value += (1.0 - math.exp(-period / self.TIME)) * (turn_rate - self.value)


class GroundObservation:
    """18 beams ahead; the goal by distance and bearing."""

    MOUNT = -0.032  # m, the lidar's place along the robot's x axis from the axle's midpoint
    DISTANCE_SCALE = 5.0  # m, the goal distance that is observed as 1

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        self._robot, self._goal = robot, arena.goal
        self._lidar = Lidar(arena, robot.task.rays, lidar_noise, rng)
        self._memory = TurnMemory()

    def speed(self, state: Array) -> float:
        return float(state[3])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        top = self._robot.high()
        x, y, heading, speed, turn_rate = measured
        self._memory.update(float(turn_rate), self._robot.period)
        bearing = math.atan2(self._goal[1] - y, self._goal[0] - x) - heading
        own = (
            math.hypot(self._goal[0] - x, self._goal[1] - y) / self.DISTANCE_SCALE,
            math.sin(bearing),
            math.cos(bearing),
            speed / top[0],
            turn_rate / top[1],
            *(input / top),
            self._memory.value / top[1],
        )
        self._lidar.at(time)
        mount = true[:2] + self.MOUNT * np.array([math.cos(true[2]), math.sin(true[2])])
        return np.concatenate((self._lidar.ranges(mount, true[2]) / self._lidar.max_range, own))


class TrackingObservation(GroundObservation):
    """The same, and the `MOST` nearest of what moves: people as a tracker has them, robots as they say themselves.

    A track with p its place and v its velocity in the robot's frame, d = |p|, is six coordinates, all zero beyond
    `REACH` and where there is none:

        near·p/d (2), v/`PACE` (2), soon, soon·aside     near = 1 - d/`REACH`,  soon = exp(-t/`SOON`)

    t: seconds until it is nearest to where the robot is now (soon = 0 if that is past); aside: m by which it leaves
    that place on its right, clipped to ± 1. Differences of the rays would tell less: beams are 10° apart and see what
    is ahead, the robot itself turns by up to 6° a period, and who is faster than it comes from behind.
    """

    MOST = 4
    REACH = 3.5  # m
    PACE = 1.2  # m/s
    SOON = 2.0  # s

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        super().__init__(robot, arena, rng, lidar_noise)
        self._crowd = arena.crowd
        self._watch = CrowdSensor(arena.crowd, rng) if isinstance(arena.crowd, Crowd) else None

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        places, paces = self._seen(time)
        return np.concatenate((super().observe(true, measured, input, time), self.tracks(measured, places, paces)))

    def _seen(self, time: float) -> tuple[Array, Array]:
        """Positions and velocities (k, 2) in the world."""
        if self._watch is not None:
            seen = [(o.position, o.motion.velocity) for o in self._watch.look(time) if o.motion is not None]
            places, paces = np.array(seen, dtype=float).reshape(-1, 2, 2).swapaxes(0, 1)
            return places, paces
        return self._crowd.told() if isinstance(self._crowd, OtherRobots) else (np.zeros((0, 2)), np.zeros((0, 2)))

    def tracks(self, measured: Array, places: Array, paces: Array) -> Array:
        """The coordinates of what is at these places (k, 2) with these velocities, seen from a measured state."""
        cos, sin = math.cos(measured[2]), math.sin(measured[2])
        own = np.array([[cos, -sin], [sin, cos]])
        p, v = (places - measured[:2]) @ own, paces @ own
        distance = np.maximum(np.linalg.norm(p, axis=1), 1e-6)
        nearest = np.argsort(distance)[: self.MOST]
        nearest = nearest[distance[nearest] < self.REACH]
        p, v, distance = p[nearest], v[nearest], distance[nearest, None]
        square = np.einsum("ki,ki->k", v, v)
        moves = square > 1e-4
        square = np.where(moves, square, 1.0)
        until = -np.einsum("ki,ki->k", p, v) / square
        soon = np.where(moves & (until > 0.0), np.exp(-np.maximum(until, 0.0) / self.SOON), 0.0)
        aside = np.clip((p[:, 1] * v[:, 0] - p[:, 0] * v[:, 1]) / np.sqrt(square), -1.0, 1.0)
        told = np.zeros((self.MOST, 6))
        near = (1.0 - distance / self.REACH) * p / distance
        told[: len(p)] = np.column_stack([near, v / self.PACE, soon, soon * aside])
        return told.ravel()


class PlanarObservation:
    """Of any robot with a heading: beams at its position; the goal by distance and bearing; all that is no pose, and
    the last input, each as a share of the most there can be of it."""

    DISTANCE_SCALE = 5.0  # m, the goal distance that is observed as 1

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        self._robot, self._goal = robot, arena.goal
        self._lidar = Lidar(arena, robot.task.rays, lidar_noise, rng)
        self._most = np.maximum(np.abs(robot.low()), robot.high())
        full = robot.state_at_inputs(self._most)[3:]
        self._scales = np.where(full > 0.0, full, 1.0)

    def speed(self, state: Array) -> float:
        speeds = [i for i in self._robot.follows if i >= 0 and self._robot.state[i].endswith("[m/s]")]
        return math.hypot(*state[speeds])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        x, y, heading = measured[:3]
        bearing = math.atan2(self._goal[1] - y, self._goal[0] - x) - heading
        goal = math.hypot(self._goal[0] - x, self._goal[1] - y) / self.DISTANCE_SCALE
        own = (goal, math.sin(bearing), math.cos(bearing), *(measured[3:] / self._scales), *(input / self._most))
        self._lidar.at(time)
        return np.concatenate((self._lidar.ranges(true[:2], float(true[2])) / self._lidar.max_range, own))


class QuadrotorObservation:
    """180 beams all round from a lidar that is kept level; the goal by its offset.

    The offset o is observed as o / (|o| + `NEAR`): its direction stays exact however far the goal is, and near the
    goal a metre still counts.
    """

    NEAR = 5.0  # m

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        self._robot, self._goal = robot, np.asarray(arena.goal)
        self._lidar = Lidar(arena, robot.task.rays, lidar_noise, rng)

    def speed(self, state: Array) -> float:
        return math.hypot(*state[3:6])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        top = self._robot.high()
        offset = self._goal - measured[:3]
        near = offset / (math.hypot(*offset) + self.NEAR)
        self._lidar.at(time)
        ranges = self._lidar.ranges(true[:3])
        return np.concatenate((ranges / self._lidar.max_range, near, measured[3:6] / top, input / top))
