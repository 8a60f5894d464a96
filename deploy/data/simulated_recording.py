"""The data set of a robot, recorded in its simulator where it is missing; interrupted, it is gone on from."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from brakeline.deploy.data import collect
from brakeline.deploy.data.build_lock import folder_lock
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.progress import each
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, needs_task
from brakeline.safety.model.dataset import BadData, Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

PACE = 0.25  # s a trajectory, on a core that is not quite its own
SAVE_EVERY = 20.0  # s: no more of a recording is lost when it is killed
SEED = 20260

console = Console(stderr=True, highlight=False, soft_wrap=True)


def load_or_record(
    robot: Robot,
    path: Path | None = None,
    trajectories: int | None = None,
    seed: int = SEED,
    conditions: Conditions | None = None,
    again: bool = False,
) -> Dataset:
    """The data set at `path`, recorded first if it is not there (or `again`).

    What was driven before an interruption lies beside it, and is gone on from: every trajectory has a generator of its
    own, so the data are the same as in one go.

    Raises:
        BadData: there are data that no simulator could bring back (`again`): these are kept.
    """
    path = path or record_path(robot)
    if path.exists() and not again:
        return Dataset.load(path)
    with folder_lock(path.parent):
        if path.exists() and not again:
            return Dataset.load(path)
        _spare(path, robot)
        count = trajectories or needs_task(robot).task.trajectories
        return _record(needs_task(robot), path, count, seed, conditions or Conditions())


def _record(robot: RobotWithTask, path: Path, trajectories: int, seed: int, conditions: Conditions) -> Dataset:
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    driven = _begun(part, robot, trajectories, seed, conditions)
    console.print(
        f"recording {robot.name} once, into {path}: {trajectories} trajectories, "
        + (f"{len(driven)} of them there already" if driven else about(PACE * trajectories))
        + "; interrupted, it goes on from there the next time",
        markup=False,
    )
    rest = collect.record(robot, trajectories, seed, conditions, len(driven))
    saved = time.monotonic()
    try:
        for trajectory in each(rest, f"recording {robot.name}", trajectories, len(driven)):
            driven.append(trajectory)
            if time.monotonic() - saved > SAVE_EVERY:
                collect.dataset(robot, driven, seed, conditions).save(part)
                saved = time.monotonic()
    except KeyboardInterrupt:
        if driven:
            collect.dataset(robot, driven, seed, conditions).save(part)
            console.print(f"[yellow]kept {len(driven)} of {trajectories} trajectories[/]: the same command goes on")
        raise
    data = collect.dataset(robot, driven, seed, conditions)
    _spare(path, robot)  # what was put there meanwhile
    data.save(path)
    part.unlink(missing_ok=True)
    return data


def _spare(path: Path, robot: Robot) -> None:
    """Raises BadData if somebody drove what lies at the path: a recording in a simulator must not replace it."""
    about = Dataset.about_of(path)
    origin = about.get("origin", collect.ORIGIN)
    if origin != collect.ORIGIN:
        source = about.get("sources", about.get("source", ""))
        raise BadData(
            f"{path} is kept: it was not recorded in the simulator ({origin}{f': {source}' if source else ''}). If the "
            f"description of {robot.name} has changed, import the log again (`brakeline import LOG --robot ...`); to "
            f"record in the simulator, move the file away first, or give `collect` another --out"
        )


def _begun(part: Path, robot: Robot, trajectories: int, seed: int, conditions: Conditions) -> list[Trajectory]:
    """What an interrupted recording of the same kind had driven."""
    if not part.exists():
        return []
    try:
        kept = Dataset.load(part)
    except BadData:
        return []
    if kept.robot.layout() != robot.layout() or kept.about != collect.origin(seed, conditions):
        return []
    return [replace(t, before=None) for t in kept.trajectories[:trajectories]]  # as driven: from standing still


def about(seconds: float) -> str:
    """How long something will take, roughly."""
    return f"about {seconds / 60.0:.0f} min" if seconds > 90.0 else f"about {10 * math.ceil(seconds / 10.0)} s"


def data_for(robot: Robot) -> Dataset:
    """The data set in use of a robot, recorded first if it is not there: one record serves, whether questions are late
    or not.

    Raises:
        BadData: it was recorded of a robot that differs in more than its body, limits and sight.
    """
    now = robot.in_lockstep()
    data = load_or_record(now)
    if replace(data.robot, body=now.body, limits=now.limits, sight=now.sight).layout() != now.layout():
        raise BadData(f"{record_path(now)} was recorded before the description of {now.name} changed")
    return replace(data, robot=robot)
