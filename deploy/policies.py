"""A policy by its name or file: scripted, trained and stored with the program, untrained, or a person's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from messaging.robots import Robot
from messaging.tasks import task_of
from messaging.weights import MLP
from sim.policies import Policy, scripted

UNTRAINED, TRAINED = "untrained", "trained"
POLICY_FOLDER = Path(__file__).parents[1] / "policies"


def policy_named(name: str, robot: Robot, seed: int) -> Policy:
    """A scripted policy, the trained one (in policies/, or beside the robot's own task), an untrained one, or a file's.

    Raises:
        ValueError: neither a name nor a file; BadWeights: a file that is no policy of this robot.
    """
    policies = task_of(robot).policies
    if name in policies:
        return scripted(name, robot, np.random.default_rng(seed))
    if name == UNTRAINED:
        return driving(MLP.untrained(robot, seed))
    path = _trained(robot) if name == TRAINED else Path(name)
    if not path.is_file():
        names = ", ".join([TRAINED, UNTRAINED, *policies])
        raise ValueError(f"no policy is called {name!r} and no such file exists; there are: {names}, or a file's path")
    if robot.late and MLP.load(path).robot.kind == robot.kind:
        return driving(MLP.load(path))  # it may have been trained in lockstep: it proposes in real time too
    return driving(MLP.load(path, robot))


def _trained(robot: Robot) -> Path:
    """Beside the task's file, as robots of other people have it, or in the folder of this repository."""
    beside = task_of(robot).folder / "trained.safetensors"
    return beside if beside.is_file() else POLICY_FOLDER / robot.kind / "trained.safetensors"


def driving(mlp: MLP) -> Policy:
    """The network as a policy, without exploration."""
    return lambda observation, info: mlp(observation)
