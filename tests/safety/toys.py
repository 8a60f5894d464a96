"""Small robots of other kinds in Gymnasium environments, which judge themselves whether they hit anything."""

from __future__ import annotations

import math

import gymnasium
import numpy as np

from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot_description import robot_from_description

SUBSTEPS = 20


def car(name, stop=("ramp", "hold"), body=(((0.0, 0.0), 0.1),), limit=()):
    """Speed and curvature are given; the speed follows with a lag, the curvature at once."""
    return robot_from_description(
        {
            "name": name,
            "period": 0.1,
            "sight": 3.0,
            "state": {
                "x": {"unit": "m", "role": "position", "error": 0.0},
                "y": {"unit": "m", "role": "position", "error": 0.0},
                "heading": {"unit": "rad", "role": "heading", "error": 0.0},
                "speed": {"unit": "m/s", "error": 0.0, "follows": "speed"},
            },
            "input": {
                "speed": {"unit": "m/s", "low": 0.0, "high": 0.6, "stop": stop[0]},
                "curvature": {"unit": "1", "low": -1.0, "high": 1.0, "stop": stop[1]},
            },
            "plan": {"horizon": 6, "free": 1, "brake": 2},
            "body": [{"at": list(at), "radius": radius} for at, radius in body],
            "limit": list(limit),
        }
    )


def puck(name, limit=()):
    """A mass with drag on a plane; a force is given, and it stops by the force that its velocity asks for."""
    return robot_from_description(
        {
            "name": name,
            "period": 0.1,
            "sight": 4.0,
            "state": {
                "x": {"unit": "m", "role": "position", "error": 0.0},
                "y": {"unit": "m", "role": "position", "error": 0.0},
                "vx": {"unit": "m/s", "error": 0.0},
                "vy": {"unit": "m/s", "error": 0.0},
            },
            "input": {
                "fx": {"unit": "N", "low": -1.0, "high": 1.0, "stop": {"vx": -2.0}},
                "fy": {"unit": "N", "low": -1.0, "high": 1.0, "stop": {"vy": -2.0}},
            },
            "stopped": 0.03,
            "plan": {"horizon": 12, "free": 1, "brake": 1},
            "body": [{"at": [0.0, 0.0], "radius": 0.1}],
            "limit": list(limit),
        }
    )


class Toy(gymnasium.Env):
    """One of them among obstacles, or anywhere. Actions are in [-1, 1]; it ends where `hits` says so.

    `worst` [m] is how near the body ever came to an obstacle, its true shape (`capsule`: ends of its middle line in its
    frame, and a radius) and every substep looked at.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, robot, obstacles=(), capsule=((0.0, 0.0), (0.0, 0.0), 0.1), steps=60):
        self.robot, self.obstacles, self.capsule, self.steps = robot, list(obstacles), capsule, steps
        self.low, self.width = robot.low(), robot.high() - robot.low()
        self.worst, self.trace = np.inf, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.count = np.zeros(4), 0
        if self.robot.heading is not None:
            self.state[2] = self.np_random.uniform(-np.pi, np.pi)
        return self.state.copy(), {}

    def step(self, action):
        assert action.dtype == np.float32, "cast to the environment's type"
        u = self.low + 0.5 * self.width * (np.clip(action.astype(float), -1.0, 1.0) + 1.0)
        h = self.robot.period / SUBSTEPS
        between = []
        for _ in range(SUBSTEPS):
            x, y, a, b = self.state.tolist()
            if self.robot.heading is not None:
                b += (u[0] - b) * (1.0 - math.exp(-h / 0.05))
                self.state = np.array([x + h * b * math.cos(a), y + h * b * math.sin(a), a + h * b * u[1], b])
            else:
                vx, vy = a + h * (u[0] - a), b + h * (u[1] - b)
                self.state = np.array([x + h * vx, y + h * vy, vx, vy])
            between.append(self.state)
        self.trace += between
        least = self.clearance(np.array(between))
        self.count, self.worst = self.count + 1, min(self.worst, least)
        return self.state.copy(), 0.0, bool(least < 0.0), self.count >= self.steps, {}

    def clearance(self, states):
        """m between the body in states (n, 4) and the nearest disc, signed."""
        *ends, radius = self.capsule
        heading = states[:, 2] if self.robot.heading is not None else 0.0
        cos, sin = np.cos(heading), np.sin(heading)
        a, b = (states[:, :2] + np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1) for x, y in ends)
        axis, gaps = b - a, [np.inf]
        for disc in self.obstacles:
            away = np.array(disc.position) - a
            along = np.clip((away * axis).sum(axis=1) / np.maximum((axis * axis).sum(axis=1), 1e-12), 0.0, 1.0)
            gaps.append((np.linalg.norm(away - along[:, None] * axis, axis=1) - radius - disc.size[0]).min())
        return min(gaps)


def seen(env, observation, info):
    return observation


def near(env, observation, info):
    return env.unwrapped.obstacles


def hostile(robot, target, state):
    """The action in [-1, 1] that drives at a point."""
    away = np.asarray(target) - state[:2]
    if robot.heading is None:
        return away / max(np.abs(away).max(), 1e-9)
    bearing = np.arctan2(away[1], away[0]) - state[2]
    return np.array([1.0, np.clip(3.0 * np.sin(bearing), -1.0, 1.0)])


def discs(margin=0.0, radius=0.2, away=1.0, count=5):
    """Round the origin."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return [Obstacle("cylinder", (away * np.cos(a), away * np.sin(a)), (radius,), margin=margin) for a in angles]
