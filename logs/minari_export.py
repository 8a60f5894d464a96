"""Export the episodes of a log as a Minari data set for offline learners."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.errors import ExportError
from brakeline.logs.log_export import robot_steps
from brakeline.logs.reader import Paths
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask

BATCH = 100  # episodes per write
# Fields of a step in the `infos` of the data set.
INFOS = ("penalty", "goal", "collision", "decision", "clearance", "speed", "weights_version")


def episodes(paths: Paths, robot: RobotWithTask) -> Iterator[list[pb.Step]]:
    """Yield the consecutive steps of each episode of each actor, in the order of the episodes' ends.

    A lost step splits an episode into parts; the last step of an incomplete part does not end the episode. Duplicate
    steps are skipped.
    """
    running: dict[str, list[pb.Step]] = {}
    for record in robot_steps(paths, robot):
        step: pb.Step = record.message
        steps = running.setdefault(step.actor, [])
        if steps:
            last = steps[-1]
            current, previous = (step.episode, step.step), (last.episode, last.step)
            if step.header.run == last.header.run and current <= previous:
                continue
            if current != (previous[0], previous[1] + 1) or step.header.run != last.header.run:
                yield steps
                steps = running[step.actor] = []
        steps.append(step)
        if step.terminated or step.truncated:
            yield steps
            running[step.actor] = []
    yield from (steps for steps in running.values() if steps)


def to_minari(paths: Paths, robot: RobotWithTask, name: str) -> dict[str, Any]:
    """Write the episodes of a robot kind as the local Minari data set `name`, e.g. "brakeline/ground-v0".

    Returns:
        `path`, and the numbers of `episodes` and `steps`.

    Actions are the executed ones; rewards have no intervention penalty. `infos` has the proposed actions, the penalty
    and the decisions. The last step of an incomplete episode is truncated. The data set is in
    `$MINARI_DATASETS_PATH`, by default ~/.minari/datasets.

    Raises:
        ExportError: the data set exists, or the log has no step of this robot.
        LogError: as `open_log`.
    """
    import gymnasium
    import minari
    from minari.storage.datasets_root_dir import get_dataset_path

    path = Path(get_dataset_path(name))
    if path.exists():
        raise ExportError(f"{path} exists already: give another name, e.g. with the next -v<number>")
    about: dict[str, Any] = {
        "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (robot.task.observation_dim,), np.float32),
        "action_space": gymnasium.spaces.Box(robot.low().astype(np.float32), robot.high().astype(np.float32)),
        "algorithm_name": "logged by brakeline",
        "author": "brakeline",
        "author_email": "none",
        "code_permalink": "none",
        "description": f"{robot.name}: observation {robot.task.observed}; action {robot.action}",
    }
    all_episodes = episodes(paths, robot)
    dataset: Any = None
    count = steps = 0
    while batch := [_buffer(number, episode) for number, episode in enumerate(islice(all_episodes, BATCH), count)]:
        if dataset is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # the data set has no registered environment
                dataset = minari.create_dataset_from_buffers(name, batch, **about)
        else:
            dataset.update_dataset_from_buffer(batch)
        count += len(batch)
        steps += sum(len(buffer.rewards) for buffer in batch)
    return {"path": str(path), "episodes": count, "steps": steps}


def _buffer(number: int, steps: list[pb.Step]) -> Any:
    from minari.data_collector import EpisodeBuffer

    observations = [steps[0].observation, *(step.next_observation for step in steps)]
    truncations = [step.truncated for step in steps]
    truncations[-1] |= not steps[-1].terminated
    infos = {name: np.array([getattr(step, name) for step in steps]) for name in INFOS}
    return EpisodeBuffer(
        id=number,
        observations=np.array(observations, np.float32),
        actions=np.array([step.action for step in steps], np.float32),
        rewards=[step.reward for step in steps],
        terminations=[step.terminated for step in steps],
        truncations=truncations,
        infos=infos | {"proposed": np.array([step.proposed for step in steps], np.float32)},
    )
