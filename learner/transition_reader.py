"""Check the sizes and values of a step from the bus, and normalise its actions."""

from __future__ import annotations

from typing import Any

import numpy as np

from brakeline.errors import BadStep
from brakeline.learner.n_step import ActorStep
from brakeline.learner.replay import Vector
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask

# Bounds of plausible steps: beyond what tasks and sensors give, and below what would ruin the networks.
MOST_OBSERVED = 10.0  # observations are clipped at 1.5
MOST_PROPOSED = 1e2  # distance from the center of the bounds, in half ranges; proposals are clipped
ROUNDING = 1e-3  # rounding of an executed action at its bounds, in half ranges
LATEST = 2**31  # number of an episode or a step


class StepReader:
    """Reads the steps of one kind of robot."""

    def __init__(self, robot: RobotWithTask) -> None:
        self.robot = robot
        self.most_reward = robot.task.reward.most
        self._observed_size = robot.task.observation_dim
        self._centre, self._half = (robot.high() + robot.low()) / 2.0, (robot.high() - robot.low()) / 2.0

    def move(self, step: pb.Step) -> ActorStep:
        """Return the step in a message. Raises BadStep: the learner cannot learn from the step."""
        if step.robot != self.robot.name:
            raise BadStep("robot", f"{step.robot!r}, not {self.robot.name!r}")
        if not step.actor:
            raise BadStep("actor", "empty")
        if step.lost:
            raise BadStep("lost", "true: the vehicle did not follow the action, or its state is not known")
        if step.index == 0:
            raise BadStep("index", "counts from 1")
        if max(step.episode, step.step) >= LATEST:
            raise BadStep("episode", f"{step.episode}, step {step.step}")
        if not (abs(step.reward) <= self.most_reward and 0.0 <= step.penalty <= self.most_reward):  # NaN fails too
            raise BadStep("reward", f"{step.reward} - {step.penalty}")
        action = self._normalised("action", step.action, 1.0 + ROUNDING)
        proposed = self._normalised("proposed", step.proposed, MOST_PROPOSED)
        observation = self._observed("observation", step.observation)
        after = self._observed("next_observation", step.next_observation)
        values = action, proposed, step.reward, step.penalty
        touched = step.collision or step.contact_moving or step.contact_robot
        ends = step.terminated, step.truncated, step.cut, touched
        return ActorStep(step.episode, step.step, observation, *values, after, *ends)

    def _normalised(self, name: str, values: Any, most: float) -> Vector:
        """Return an action in [−1, 1], clipped if it is out of bounds by at most `most`."""
        vector = _vector(name, values, len(self._half))
        normalised = (vector - self._centre) / self._half
        if not np.abs(normalised).max() <= most:  # NaN fails too
            _check_finite(name, vector)
            raise BadStep(name, f"{list(values)}, out of the robot's bounds")
        clipped: Vector = np.minimum(np.maximum(normalised, -1.0), 1.0).astype(np.float32)
        return clipped

    def _observed(self, name: str, values: Any) -> Vector:
        vector = _vector(name, values, self._observed_size)
        if not np.abs(vector).max() <= MOST_OBSERVED:  # NaN fails too
            _check_finite(name, vector)
            raise BadStep(name, f"{float(np.abs(vector).max())} is not plausible")
        return vector


def _vector(name: str, values: Any, size: int) -> Vector:
    if len(values) != size:
        raise BadStep(name, f"{len(values)} values, not {size}")
    return np.fromiter(values, np.float32, size)  # `np.array` would take five times as long


def _check_finite(name: str, vector: Vector) -> None:
    if not np.isfinite(vector).all():
        raise BadStep(name, "not finite")
