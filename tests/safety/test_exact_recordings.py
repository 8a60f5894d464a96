"""A simulator without noise: nothing but rounding separates its steps from the sets."""

from functools import cache

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import RECOVERING
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, RECURSION, ModelConfig
from brakeline.safety.model.one_step_fitting import fit_one_step
from brakeline.safety.service.in_process import InProcess

SUBSTEPS = 10
ROBOT = robot_from_description(
    {
        "name": "kinematic",
        "period": 0.1,
        "sight": 3.0,
        "state": {
            "x": {"unit": "m", "role": "position", "error": 0.0},
            "y": {"unit": "m", "role": "position", "error": 0.0},
            "heading": {"unit": "rad", "role": "heading", "error": 0.0},
            "speed": {"unit": "m/s", "error": 0.0, "follows": "to speed"},
            "turn rate": {"unit": "rad/s", "error": 0.0, "follows": "to turn rate"},
        },
        "input": {
            "to speed": {"unit": "m/s", "low": 0.0, "high": 0.5},
            "to turn rate": {"unit": "rad/s", "low": -1.0, "high": 1.0, "moves": False},
        },
        "plan": {"horizon": 4, "brake": 1},
        "body": [{"at": [0.0, 0.0], "radius": 0.2}],
    }
)


def period_from(state, u):
    """Return the positions (S, 2) in the frame of the start, and the state after a period with both speeds as u."""
    (x, y, heading), path = state[:3], np.zeros((SUBSTEPS, 2))
    ahead = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    for i in range(SUBSTEPS):
        length = u[0] * ROBOT.period / SUBSTEPS
        x, y = x + length * np.cos(heading), y + length * np.sin(heading)
        heading += u[1] * ROBOT.period / SUBSTEPS
        path[i] = ahead @ (x - state[0], y - state[1])
    return path, np.array([x, y, heading, *u])


@cache
def ready():
    """The filter from six minutes of driving with inputs that stay for a second, a fifth of them standing."""
    rng, states, inputs, paths = np.random.default_rng(0), [np.zeros(5)], [], []
    for _ in range(360):
        u = rng.uniform(ROBOT.low(), ROBOT.high()) if rng.random() < 0.8 else np.zeros(2)
        for _ in range(10):
            path, state = period_from(states[-1], u)
            inputs.append(u)
            states.append(state)
            paths.append(path)
    turned = np.diff(np.array(states)[:, 2])
    trajectory = Trajectory(np.array(states), np.array(inputs), np.array(paths), turned)
    return Filter(fit_one_step(Dataset(ROBOT, (trajectory,), {"origin": "kinematic"}), ModelConfig(mode=ONE_STEP))[0])


def test_rounded_inputs_leave_no_set_of_a_simulator_without_noise():
    """A learner's actions have single precision. The sets were narrower than that, so they widened a thousandfold."""
    client, state = InProcess(ready(), accept_bound=1.0), np.zeros(5)
    posts = [Obstacle("cylinder", (1.5, 0.3), (0.3,))]
    for _ in range(150):
        answer = client.decide(state, [0.5, -2.0 * state[2]], posts)
        assert answer.kind != RECOVERING
        assert answer.contained
        _, state = period_from(state, np.float32(answer.action).astype(float))
    assert client.backup_plan.widening.factors == (1.0, 1.0)
    assert 0.5 < np.hypot(1.5 - state[0], 0.3 - state[1]) < 0.55, "it stands before the post"


GANTRY = robot_from_description(
    {
        "name": "gantry",
        "period": 0.1,
        "sight": 3.0,
        "state": {
            "x": {"unit": "m", "role": "position", "error": 0.0},
            "y": {"unit": "m", "role": "position", "error": 0.0},
            "vx": {"unit": "m/s", "error": 0.0, "follows": "to vx"},
            "vy": {"unit": "m/s", "error": 0.0, "follows": "to vy"},
        },
        "input": {f"to v{axis}": {"unit": "m/s", "low": -0.5, "high": 0.5} for axis in "xy"},
        "plan": {"horizon": 8, "brake": 1},
        "body": [{"at": [0.0, 0.0], "radius": 0.2}],
    }
)


def linear_period_from(state, u):
    """Return the positions (S, 2) from the start, and the state after a period in which both speeds follow u."""
    moved, speed, path = np.zeros(2), state[2:].copy(), np.zeros((SUBSTEPS, 2))
    for i in range(SUBSTEPS):
        speed += 0.15 * (u - speed)
        moved += speed * GANTRY.period / SUBSTEPS
        path[i] = moved
    return path, np.concatenate([state[:2] + moved, speed])


def linear_recording():
    """Two chosen inputs, then a stop, 600 times: ten plans in each trajectory."""
    rng, trajectories = np.random.default_rng(0), []
    for _ in range(60):
        states, paths = [np.zeros(4)], []
        plans = [np.vstack([rng.uniform(GANTRY.low(), GANTRY.high(), (2, 2)), np.zeros((16, 2))]) for _ in range(10)]
        inputs = np.concatenate(plans)
        for u in inputs:
            path, state = linear_period_from(states[-1], u)
            states.append(state)
            paths.append(path)
        trajectories.append(Trajectory(np.array(states), inputs, np.array(paths), np.zeros(len(inputs))))
    return Dataset(GANTRY, tuple(trajectories), {"origin": "gantry"})


@pytest.mark.parametrize("mode", [DIRECT, RECURSION])
def test_rounded_inputs_leave_no_set_of_a_linear_predictor_either(mode):
    """A linear robot is predicted exactly: its sets were rounding errors of 1e-16 m."""
    client = InProcess(Filter(fit_model_set(linear_recording(), ModelConfig(mode=mode))), accept_bound=1.0)
    posts, state = [Obstacle("cylinder", (1.5, 0.3), (0.3,))], np.zeros(4)
    for _ in range(40):
        answer = client.decide(state, [0.5, -2.0 * state[1]], posts)
        assert answer.contained
        _, state = linear_period_from(state, np.float32(answer.action).astype(float))
    assert state[0] > 0.5
