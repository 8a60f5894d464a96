"""Robots in joint space: n joints that follow commanded velocities with a lag, and their recordings."""

from __future__ import annotations

import gymnasium
import numpy as np

from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.model.dataset import Dataset, Trajectory

SAMPLES = 5  # states in each period
LAG = 0.08  # s
MOST = 1.0  # rad, limit of every joint, to both sides
BEYOND = 1.2  # rad; a recording goes a little beyond the limits


def description(n=2, **changes):
    return {
        "name": f"{n}-joints",
        "period": 0.1,
        "state": {f"q{i}": {"unit": "rad", "error": 0.002} for i in range(n)}
        | {f"dq{i}": {"unit": "rad/s", "error": 0.01, "follows": f"w{i}"} for i in range(n)},
        "input": {f"w{i}": {"unit": "rad/s", "low": -1.0, "high": 1.0} for i in range(n)},
        "plan": {"horizon": 6, "free": 1, "brake": 2},
        "limit": [
            {"name": f"q{i} {way}", "weights": {f"q{i}": sign}, "most": MOST}
            for i in range(n)
            for way, sign in (("up", 1.0), ("down", -1.0))
        ],
    } | changes


def joints(n=2, **changes):
    return robot_from_description(description(n, **changes))


class Joints:
    """The true joints. `true` (SAMPLES, 2n) holds the states of the last period."""

    def __init__(self, robot, generator, weak=1.0):
        self.robot, self.generator, self.weak = robot, generator, weak
        self.reset(np.zeros(robot.action_dim))

    def reset(self, angles):
        self.true = np.concatenate([angles, np.zeros(len(angles))])[None]

    def measured(self, true=None):
        errors = self.generator.uniform(-1.0, 1.0, self.robot.state_dim) * self.robot.measurement_bound
        return (self.true[-1] if true is None else true) + errors

    def drive(self, u):
        states, (q, dq) = [], np.split(self.true[-1], 2)
        step = self.robot.period / SAMPLES
        for _ in range(SAMPLES):
            faster = u * self.weak + (dq - u * self.weak) * np.exp(-step / LAG)
            q, dq = q + 0.5 * step * (dq + faster), faster
            states.append(np.concatenate([q, dq]))
        self.true = np.array(states)


class JointEnvironment(gymnasium.Env):
    """The joints as an environment that tells its measured state and nothing about space."""

    def __init__(self, robot):
        self.robot = robot
        self.action_space = gymnasium.spaces.Box(robot.low().astype(np.float32), robot.high().astype(np.float32))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (robot.state_dim,))

    def _seen(self):
        state = self.arm.measured()
        return state.astype(np.float32), {"state": state}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.arm = Joints(self.robot, self.np_random)
        return self._seen()

    def step(self, action):
        self.arm.drive(np.asarray(action, float))
        observation, info = self._seen()
        return observation, 0.0, False, False, info


def record(robot, seed=0, trajectories=6, periods=400):
    """Drive at random, with stops, up to a little beyond the limits."""
    generator, m = np.random.default_rng(seed), robot.action_dim
    parts = []
    for _ in range(trajectories):
        arm, left, held = Joints(robot, generator), 0, np.zeros(m)
        states, inputs, paths = [arm.measured()], [], []
        for _ in range(periods):
            if left == 0:
                kind, left = generator.random(), int(generator.integers(1, 8))
                held = generator.uniform(-1.0, 1.0, m) if kind < 0.6 else generator.choice([-1.0, 1.0], m)
                if kind < 0.15:
                    held, left = np.zeros(m), 8
            left -= 1
            q = states[-1][:m]
            u = np.clip(held, 3.0 * (-BEYOND - q), 3.0 * (BEYOND - q)) if held.any() else held
            inputs.append(np.clip(u, robot.low(), robot.high()))
            arm.drive(inputs[-1])
            path = np.array([arm.measured(true) for true in arm.true])
            paths.append(path - states[-1])
            states.append(path[-1])
        parts.append(Trajectory(np.array(states), np.array(inputs), np.array(paths), np.zeros(periods), np.zeros(m)))
    return Dataset(robot, tuple(parts), {})
