"""Load a robot's data set; if it is missing, record it in the simulator. An interrupted recording continues."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

from brakeline.deploy.data.build_lock import folder_lock
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.data.partial_save import partial_path
from brakeline.deploy.data.patient_save import save_patiently
from brakeline.deploy.data.recording_origin import ORIGIN, origin, outdated
from brakeline.deploy.progress import console, under_way
from brakeline.errors import BadData
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, needs_task
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

SAVE_EVERY = 2.0  # s: a killed recording loses no more of what it has finished
SEED = 20260
RESTLESS_SHARE = 0.5  # restless trajectories, in addition, for each other one


def load_or_record(
    robot: Robot,
    path: Path | None = None,
    trajectories: int | None = None,
    seed: int = SEED,
    conditions: Conditions | None = None,
    again: bool = False,
) -> Dataset:
    """Load the data set at `path`. Record it first if the file is missing or outdated, or if `again`.

    A recording ends with restless trajectories, half as many as others. The linear forms are not fitted to them, so
    that their model sets stay what they are (`Dataset.steady`).

    Raises:
        BadData: `again` would overwrite data that do not come from the simulator.
    """
    path = path or record_path(robot)
    if not again and _usable(path, robot):
        return Dataset.load(path)
    with folder_lock(path.parent):
        if not again and _usable(path, robot):
            return Dataset.load(path)
        _check_replaceable(path, robot)
        if not again and path.exists():
            aside = path.replace(path.with_suffix(".replaced"))
            console.print(
                f"recording again: {path} was recorded before the simulator of {robot.name} changed. The file before "
                f"is now {aside}",
                markup=False,
            )
        count = trajectories or needs_task(robot).task.trajectories
        return _record(needs_task(robot), path, count, seed, conditions or Conditions())


def _usable(path: Path, robot: Robot) -> bool:
    """Return whether there is a data set at `path` that does not come from an older simulator of the robot."""
    return path.exists() and not outdated(robot, Dataset.about_of(path))


def _record(robot: RobotWithTask, path: Path, trajectories: int, seed: int, conditions: Conditions) -> Dataset:
    from brakeline.deploy.data import collect  # brings the simulators

    part = partial_path(path)
    restless = math.ceil(RESTLESS_SHARE * trajectories)
    total = trajectories + restless
    periods = [collect.PERIODS] * trajectories + [collect.RESTLESS_PERIODS] * restless
    driven = _load_partial(part, robot, origin(robot, seed, conditions, restless), periods)
    before = f", {len(driven)} of them recorded before" if driven else ""
    console.print(
        f"recording {robot.name} once, into {path}: {total} trajectories{before}. You can interrupt it: the next call "
        "continues.",
        markup=False,
    )
    rest = collect.record_parts(robot, trajectories, seed, conditions, len(driven), restless)
    saved = time.monotonic()
    try:
        with under_way(f"recording {robot.name}", total) as advance:
            advance(len(driven))
            for finished in rest:
                driven += finished
                advance(len(finished))
                if time.monotonic() - saved > SAVE_EVERY:
                    _keep(collect.dataset(robot, driven, seed, conditions, restless), part)
                    saved = time.monotonic()
    except BaseException:  # an interruption, or an error of the simulator
        if driven and _keep(collect.dataset(robot, driven, seed, conditions, restless), part):
            console.print(
                f"[yellow]kept {len(driven)} of {total} trajectories[/]: run the same command again to continue"
            )
        raise
    data = collect.dataset(robot, driven, seed, conditions, restless)
    _check_replaceable(path, robot)  # an import may have written the file in the meantime
    save_patiently(data, path)
    part.unlink(missing_ok=True)
    return data


def _keep(data: Dataset, part: Path) -> bool:
    """Save what is recorded so far. If that fails, say so and return False: the recording goes on without it."""
    try:
        data.save(part)
    except OSError as error:
        console.print(f"{part} is not saved: {error.strerror}. Make room, or the recording is lost", markup=False)
        return False
    return True


def _check_replaceable(path: Path, robot: Robot) -> None:
    """Raise BadData if the data set at `path` does not come from the simulator: a recording must not replace it."""
    about = Dataset.about_of(path)
    kind = about.get("origin", ORIGIN)
    if kind != ORIGIN:
        source = about.get("sources", about.get("source", ""))
        raise BadData(
            f"{path} is kept: the data do not come from the simulator ({kind}{f': {source}' if source else ''}). If "
            f"the description of {robot.name} has changed, import the log again (`brakeline import LOG --robot ...`). "
            f"To record in the simulator, move the file away first, or call `collect` with another --out."
        )


def _load_partial(part: Path, robot: Robot, about: dict[str, str], periods: list[int]) -> list[Trajectory]:
    """Return the trajectories of an interrupted recording with the same settings, or an empty list.

    periods: of each trajectory of the whole recording. They differ if the number of trajectories does.
    """
    try:
        partial = Dataset.load(part)
    except BadData:
        return []
    lengths = [len(t.inputs) for t in partial.trajectories]
    if partial.robot.layout() != robot.layout() or partial.about != about or lengths != periods[: len(lengths)]:
        return []
    return [replace(t, before=None) for t in partial.trajectories]  # each began at rest


def data_for(robot: Robot) -> Dataset:
    """Load the robot's data set in use, and record it first if it is missing.

    One data set serves both modes: in lockstep and in real time.

    Raises:
        BadData: the description has changed since the recording in more than body, limits and sight.
    """
    lockstep = robot.in_lockstep()
    return described_today(load_or_record(lockstep), robot, record_path(lockstep))


def described_today(data: Dataset, robot: Robot, path: Path) -> Dataset:
    """Return a data set of the robot with the robot's description of today: its body, limits and sight.

    Raises:
        BadData: the description has changed since the recording in more than these.
    """
    lockstep = robot.in_lockstep()
    today = replace(data.robot, body=lockstep.body, limits=lockstep.limits, sight=lockstep.sight)
    if today.layout() != lockstep.layout():
        raise BadData(
            f"{path} was recorded before the description of {robot.name} changed in more than body, limits and sight: "
            "import the log again, or record again"
        )
    return replace(data, robot=robot)
