"""From a step on the wire to a move to learn from: sizes and values are checked, the action is normalised."""

from __future__ import annotations

from typing import Any

import numpy as np

from learner.replay import Vector
from learner.windows import Move
from messaging import brakeline_pb2 as pb
from messaging.robots import Robot
from messaging.tasks import task_of


class BadStep(ValueError):
    """A step that cannot be learned from; `field` names what is wrong with it."""

    def __init__(self, field: str, why: str) -> None:
        super().__init__(f"{field}: {why}")
        self.field = field


class Intake:
    """Reads the steps of one kind of robot. The reward learned is `reward − penalty`."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._centre, self._half = (robot.high() + robot.low()) / 2.0, (robot.high() - robot.low()) / 2.0

    def move(self, step: pb.Step) -> Move:
        """
        Raises:
            BadStep: it cannot be learned from.
        """
        if step.robot != self.robot.name:
            raise BadStep("robot", f"{step.robot!r} where {self.robot.name!r} is learned")
        if not step.actor:
            raise BadStep("actor", "empty")
        if step.index == 0:
            raise BadStep("index", "counts from 1")
        if not np.isfinite(step.reward - step.penalty):
            raise BadStep("reward", f"{step.reward} - {step.penalty}")
        action, proposed = self._normalised("action", step.action), self._normalised("proposed", step.proposed)
        observation = _vector("observation", step.observation, task_of(self.robot).observation_dim)
        after = _vector("next_observation", step.next_observation, task_of(self.robot).observation_dim)
        values = action, proposed, step.reward, step.penalty
        return Move(step.episode, step.step, observation, *values, after, step.terminated, step.truncated, step.cut)

    def _normalised(self, name: str, values: Any) -> Vector:
        """An action in [-1, 1]: what is out of bounds would have been clipped."""
        action = _vector(name, values, self.robot.action_dim)
        normalised: Vector = np.clip((action - self._centre) / self._half, -1.0, 1.0).astype(np.float32)
        return normalised


def _vector(name: str, values: Any, size: int) -> Vector:
    vector = np.array(values, np.float32)
    if vector.shape != (size,):
        raise BadStep(name, f"{len(values)} values where {size} belong")
    if not np.isfinite(vector).all():
        raise BadStep(name, "not finite")
    return vector
