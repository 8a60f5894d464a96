"""A data set from a log: what robots did in a run says what they are like now.

It makes a new version of the model set, never changes one in place (docs/method.md §4).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from brakeline.logs.reader import read
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import INPUT_TOLERANCE, Robot
from brakeline.safety.model.dataset import BadData, Dataset, Trajectory

FEWEST_STEPS = 5  # of a trajectory that is worth keeping


@dataclass(frozen=True)
class Recorded:
    """Data, and a line that says where they come from."""

    data: Dataset
    note: str


def from_log(path: Path, robot: Robot, last: int) -> Recorded:
    """The last steps of a robot kind in a log, as trajectories cut at episode ends and at lost steps.

    Raises:
        BadData: too few steps of that robot; NoLog, NotALog: no log.
    """
    steps: deque[pb.Step] = deque(maxlen=last)
    for record in read(path):
        if isinstance(record.message, pb.Step) and record.message.robot == robot.name:
            steps.append(record.message)
    trajectories = tuple(trajectories_of(steps, robot))
    if not trajectories:
        raise BadData(f"{path}: no trajectory of {robot.name}; was anything recorded?")
    data = Dataset(robot, trajectories, {"origin": "log"})
    data.check()
    return Recorded(data, f"{data.periods} of the last {len(steps)} steps of {robot.name} in {path}")


def trajectories_of(steps: Iterable[pb.Step], robot: Robot) -> Iterable[Trajectory]:
    """Runs of consecutive steps of one actor's episode."""
    ordered = sorted(steps, key=lambda s: (s.actor, s.header.run, s.episode, s.step))
    numbered = ((s.actor, s.header.run, s.episode, s.step - i) for i, s in enumerate(ordered))
    for _, group in groupby(zip(numbered, ordered, strict=True), key=lambda pair: pair[0]):
        run = [step for _, step in group]
        if len(run) > FEWEST_STEPS and run[0].path:
            yield _trajectory(run, robot)


def _trajectory(run: list[pb.Step], robot: Robot) -> Trajectory:
    """The first step only gives the state that the others start from, and the input in force then.

    In real time a step's action is what it decided for the period after it: it takes one step more to know that input.
    """
    given = robot.committed_steps
    first, rest = run[given], run[1 + given :]
    actions = _within(np.array([s.action for s in run], dtype=float), robot)
    paths = np.array([s.path for s in rest], dtype=float).reshape(len(rest), -1, robot.position_dim)
    return Trajectory(
        states=np.array([first.state, *(s.state for s in rest)]),
        inputs=actions[1 : len(run) - given],
        paths=paths,
        turned=np.array([s.turned for s in rest]),
        before=actions[0],
    )


def _within(inputs: np.ndarray, robot: Robot) -> np.ndarray:
    """Inputs (T, m), those at a bound exactly there: a step's were rounded to single precision."""
    inside = np.clip(inputs, robot.low(), robot.high())
    rounded = np.abs(inputs - inside) <= INPUT_TOLERANCE * (robot.high() - robot.low())
    return np.where(rounded, inside, inputs)
