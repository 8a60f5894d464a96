"""Observation models: lidar ranges, the goal, and the robot's own motion, in the order of `task.observed`."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.lidar import Lidar
from brakeline.sim.traffic import Crowd, CrowdSensor, OtherRobots

GOAL_DISTANCE_SCALE = 5.0  # m, the distance to the goal that a robot in the plane observes as 1


class ObservationModel(ABC):
    """The observations of one robot in one episode."""

    LIDAR_X = 0.0  # m, the lidar's position on the robot's x axis, from the position in the state

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        self._robot, self._goal = robot, arena.goal
        self._lidar = Lidar(arena, robot.task.rays, lidar_noise, rng)

    @abstractmethod
    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        """Return the observation after a period, not yet clipped. Call it once a period: a model may have memory.

        Args:
            true: (n,) true state, only to place the lidar.
            measured: (n,) measured state.
            input: (m,) input executed last.
            time: s, to place moving obstacles.
        """

    @abstractmethod
    def speed(self, state: Array) -> float:
        """Return the speed in a state (n,), m/s."""

    def _shares(self, origin: Array, heading: float, time: float) -> Array:
        """Return the lidar's ranges (R,) from a point (d,), as shares of its largest range."""
        self._lidar.move_obstacles(time)
        if self.LIDAR_X:
            origin = origin + self.LIDAR_X * np.array([math.cos(heading), math.sin(heading)])
        return self._lidar.ranges(origin, heading) / self._lidar.max_range


def goal_in_polar(measured: Array, goal: tuple[float, ...]) -> tuple[float, float, float]:
    """Return the scaled distance to the goal, and sine and cosine of its bearing, for a state (x, y, heading, ...)."""
    dx, dy = goal[0] - measured[0], goal[1] - measured[1]
    bearing = math.atan2(dy, dx) - measured[2]
    return math.hypot(dx, dy) / GOAL_DISTANCE_SCALE, math.sin(bearing), math.cos(bearing)


class GroundObservation(ObservationModel):
    """18 lidar ranges ahead, the goal in polar coordinates, speeds, the last input, and the turn memory.

    The turn memory is the measured turn rate after a low-pass filter, and the only memory in an observation. A policy
    without memory dithers in front of an obstacle that it can pass on both sides: once it has turned a little to one
    side, noise makes the other side look better. With the turn memory it knows in which direction it has turned for
    about `MEMORY_TIME` seconds, and can go on turning that way.
    """

    MEMORY_TIME = 2.0  # s
    LIDAR_X = -0.032  # m from the middle of the axle

    _turn_memory = 0.0  # rad/s

    def speed(self, state: Array) -> float:
        return float(state[3])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        largest = self._robot.high()
        _, _, _, speed, turn_rate = measured
        share = 1.0 - math.exp(-self._robot.period / self.MEMORY_TIME)
        self._turn_memory += share * (float(turn_rate) - self._turn_memory)
        own = (
            *goal_in_polar(measured, self._goal),
            speed / largest[0],
            turn_rate / largest[1],
            *(input / largest),
            self._turn_memory / largest[1],
        )
        return np.concatenate((self._shares(true[:2], true[2], time), own))


class TrackingObservation(GroundObservation):
    """`GroundObservation` and the tracks of the `TRACKS` nearest moving obstacles or other robots.

    A tracker measures people; robots report their own positions. A track at p with the velocity v, both in the robot's
    frame, d = |p|, has six coordinates. All are zero beyond `REACH`, and for tracks that do not exist:

        near·p/d (2), v/`SPEED_SCALE` (2), soon, soon·aside      near = 1 - d/`REACH`,  soon = exp(-t/`TIME_SCALE`)

    t: seconds until it is nearest to the robot's present position (soon = 0 if that time has passed).
    aside: m by which it then passes, positive if the robot is on its right, clipped to ±1.

    The rays alone carry less: they are 10° apart and only point ahead, the robot turns by up to 6° in a period, and
    faster obstacles come from behind.
    """

    TRACKS = 4
    REACH = 3.5  # m
    SPEED_SCALE = 1.2  # m/s
    TIME_SCALE = 2.0  # s

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        super().__init__(robot, arena, rng, lidar_noise)
        self._crowd = arena.crowd
        self._sensor = CrowdSensor(arena.crowd, rng) if isinstance(arena.crowd, Crowd) else None

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        positions, velocities = self._measured_motion(time)
        tracks = self.tracks(measured, positions, velocities)
        return np.concatenate((super().observe(true, measured, input, time), tracks))

    def _measured_motion(self, time: float) -> tuple[Array, Array]:
        """Return measured positions and velocities (k, 2) in the world."""
        if self._sensor is not None:
            motions = [(o.position, o.motion.velocity) for o in self._sensor.measure(time) if o.motion is not None]
            positions, velocities = np.array(motions, dtype=float).reshape(-1, 2, 2).swapaxes(0, 1)
            return positions, velocities
        return self._crowd.reported() if isinstance(self._crowd, OtherRobots) else (np.zeros((0, 2)), np.zeros((0, 2)))

    def tracks(self, measured: Array, positions: Array, velocities: Array) -> Array:
        """Return the coordinates (6·`TRACKS`,) of tracks (k, 2) in the world, for a measured state (n,)."""
        cos, sin = math.cos(measured[2]), math.sin(measured[2])
        to_robot = np.array([[cos, -sin], [sin, cos]])
        p, v = (positions - measured[:2]) @ to_robot, velocities @ to_robot
        distance = np.maximum(np.linalg.norm(p, axis=1), 1e-6)
        nearest = np.argsort(distance)[: self.TRACKS]
        nearest = nearest[distance[nearest] < self.REACH]
        p, v, distance = p[nearest], v[nearest], distance[nearest, None]
        square = np.einsum("ki,ki->k", v, v)
        moves = square > 1e-4
        square = np.where(moves, square, 1.0)
        until = -np.einsum("ki,ki->k", p, v) / square
        soon = np.where(moves & (until > 0.0), np.exp(-np.maximum(until, 0.0) / self.TIME_SCALE), 0.0)
        aside = np.clip((p[:, 1] * v[:, 0] - p[:, 0] * v[:, 1]) / np.sqrt(square), -1.0, 1.0)
        tracks = np.zeros((self.TRACKS, 6))
        near = (1.0 - distance / self.REACH) * p / distance
        tracks[: len(p)] = np.column_stack([near, v / self.SPEED_SCALE, soon, soon * aside])
        return tracks.ravel()


class PlanarObservation(ObservationModel):
    """The observation of any robot with a heading.

    It consists of lidar ranges from the robot's position, the goal in polar coordinates, the state entries after the
    pose, and the last input. Each entry is divided by its largest value.
    """

    def __init__(self, robot: RobotWithTask, arena: Arena, rng: np.random.Generator, lidar_noise: float) -> None:
        super().__init__(robot, arena, rng, lidar_noise)
        self._largest = np.maximum(np.abs(robot.low()), robot.high())
        full = robot.state_at_inputs(self._largest)[3:]
        self._scales = np.where(full > 0.0, full, 1.0)

    def speed(self, state: Array) -> float:
        speeds = [i for i in self._robot.follows if i >= 0 and self._robot.state[i].endswith("[m/s]")]
        return math.hypot(*state[speeds])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        own = (*goal_in_polar(measured, self._goal), *(measured[3:] / self._scales), *(input / self._largest))
        return np.concatenate((self._shares(true[:2], float(true[2]), time), own))


class QuadrotorObservation(ObservationModel):
    """180 lidar ranges all around, from a levelled lidar; the offset to the goal, the velocity, and the last input.

    The offset o is observed as o / (|o| + `GOAL_SCALE`): its direction is exact at any distance, and near the goal a
    metre still makes a difference.
    """

    GOAL_SCALE = 5.0  # m

    def speed(self, state: Array) -> float:
        return math.hypot(*state[3:6])

    def observe(self, true: Array, measured: Array, input: Array, time: float = 0.0) -> Array:
        largest = self._robot.high()
        offset = np.asarray(self._goal) - measured[:3]
        goal = offset / (math.hypot(*offset) + self.GOAL_SCALE)
        return np.concatenate((self._shares(true[:3], 0.0, time), goal, measured[3:6] / largest, input / largest))
