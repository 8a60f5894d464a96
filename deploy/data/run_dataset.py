"""Build a data set from the log of a run, to certify a new version of the model set (docs/method.md §4)."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from shlex import quote

import numpy as np

from brakeline.errors import BadData
from brakeline.logs.reader import Log, Paths, find, open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import about_age
from brakeline.messaging.robot import INPUT_TOLERANCE, Robot
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.repeated_driving import without_repeats

FEWEST_STEPS = 5  # shorter trajectories are dropped
MOST_NAMED = 5  # keys of other messages that an error names


def from_log(path: Path, robot: Robot, last: int) -> tuple[Dataset, str]:
    """Read the last `last` steps of a robot from a log, as trajectories that end at episode ends and lost steps.

    Returns the data set, and a sentence about its source.

    Raises:
        BadData: the log holds too few steps of the robot, or they are of another description.
        LogError: the file does not exist, or is not a log.
    """
    steps: deque[pb.Step] = deque(maxlen=last)
    described: deque[str] = deque(maxlen=last)  # the description that the file of each step contains
    log, others = open_log(path), Counter[str]()
    for record in log:
        if isinstance(record.message, pb.Step) and record.message.robot == robot.name:
            steps.append(record.message)
            described.append(log.metadata.get("robots", {}).get(robot.kind, ""))
        else:
            others[record.key] += 1
    for text in dict.fromkeys(described):
        check_described(path, robot, text)
    damage = "".join(f"; {cut}" for cut in log.cuts)
    trajectories, repeats = without_repeats(robot, tuple(trajectories_of(steps, robot)))
    if not trajectories:
        content = ", ".join(f"{count} of {key}" for key, count in others.most_common(MOST_NAMED)) or "none"
        raise BadData(
            f"{path}: no trajectory of {robot.name}, of which it has {len(steps)} steps{damage}. Other messages: "
            f"{content}. See what the log holds with `brakeline analyse {quote(str(path))}`, or name its robot with "
            "--robot"
        )
    data = Dataset(robot, trajectories, {"origin": "log"} | about_age(step.acceleration_age for step in steps))
    data.check()
    left_out = f"; {repeats} repeated episodes left out" if repeats else ""
    return data, f"{data.periods} of the last {len(steps)} steps of {robot.name} in {path}{left_out}{damage}"


def check_logs(logs: Paths, robot: Robot, more: Mapping[str, str] = {}) -> None:
    """Check that the vectors in logs have the meaning that the description of the robot gives them.

    Args:
        more: as for `check_described`.

    Raises:
        LogError: a path is no log.
        BadData: a file was recorded with another description of the robot.
    """
    for path in find(logs):
        log_file = Log((path,))
        next(log_file.rows(), None)  # metadata precede the first message
        check_described(path, robot, log_file.metadata.get("robots", {}).get(robot.kind, ""), more)


def check_described(path: Path, robot: Robot, text: str, more: Mapping[str, str] = {}) -> None:
    """Raise BadData if a description, as JSON text in a log, has other columns or another period than the robot.

    Args:
        more: further fields of the robot that must not differ, and a word for each.
    """
    try:
        recorded = robot_from_description(parse_json(text))
    except ValueError:  # an old log has no description
        return
    parts = {"period": "period", "state": "coordinates", "action": "inputs", "heading": "heading", **more}
    if changed := [word for name, word in parts.items() if getattr(recorded, name) != getattr(robot, name)]:
        raise BadData(
            f"{path} was recorded with another description of {robot.name}: {', '.join(changed)} differ. Get the "
            f"description of then with `brakeline robot new {robot.kind}.toml --from {quote(str(path))}`, in another "
            "folder, or record again"
        )


def trajectories_of(steps: Iterable[pb.Step], robot: Robot) -> Iterator[Trajectory]:
    """Yield a trajectory for each run of consecutive steps in one episode of one actor."""
    for run in runs_of(steps):
        if len(run) > FEWEST_STEPS and run[0].path:
            yield _trajectory(run, robot)


def runs_of(steps: Iterable[pb.Step]) -> Iterator[list[pb.Step]]:
    """Yield the runs of consecutive steps in one episode of one actor; a step counts once."""
    # A folder may have a copy of a log. A vehicle that does not follow its inputs shows nothing about them.
    unique = {(s.actor, s.header.run, s.episode, s.step): s for s in steps if not s.lost}
    ordered = [unique[place] for place in sorted(unique)]
    numbered = ((s.actor, s.header.run, s.episode, s.step - i) for i, s in enumerate(ordered))
    for _, group in groupby(zip(numbered, ordered, strict=True), key=lambda pair: pair[0]):
        yield [step for _, step in group]


def _trajectory(run: list[pb.Step], robot: Robot) -> Trajectory:
    """Convert consecutive steps to a trajectory.

    The first step only gives the initial state and the input in force at that time. In real time a step's action is
    for the period after it, so that one more step is needed for that input.
    """
    late = robot.committed_steps
    first, rest = run[late], run[1 + late :]
    actions = _snap_to_bounds(np.array([s.action for s in run], dtype=float), robot)
    paths = np.array([s.path for s in rest], dtype=float).reshape(len(rest), -1, robot.path_dim)
    return Trajectory(
        states=np.array([first.state, *(s.state for s in rest)]),
        inputs=actions[1 : len(run) - late],
        paths=paths,
        turned=np.array([s.turned for s in rest]),
        before=actions[0],
    )


def _snap_to_bounds(inputs: np.ndarray, robot: Robot) -> np.ndarray:
    """Return the inputs (T, m), with those at a bound exactly at it: the log holds them in single precision."""
    inside = np.clip(inputs, robot.low(), robot.high())
    rounded = np.abs(inputs - inside) <= INPUT_TOLERANCE * (robot.high() - robot.low())
    return np.where(rounded, inside, inputs)
