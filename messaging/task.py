"""Read the task of a robot: its observation, rewards and arenas, and the code that simulates it.

A task is a file beside the robot's file: `robots/NAME.task.toml`, or `my.task.toml` beside `my.toml`. A shipped robot
may have additional tasks, `robots/NAME+OTHER.task.toml`, which are based on the task named in `like`; the name
`NAME+OTHER` selects such a task. A task refers to code (`simulator`, `senses`, `policies`) as `module:name`, or as
`file.py:name` beside the task. Only `deploy` and `sim` load that code.

Robots and tasks are values: a program reads them once, by name or path, and passes them on.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import astuple, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from brakeline.errors import UnknownName, UnknownTask
from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.number_checks import check_most, check_numbers
from brakeline.messaging.ray_directions import LidarRays, planar_rays, spherical_rays
from brakeline.messaging.robot import FORMER_LAYOUTS, Robot, robot_named
from brakeline.messaging.robot_files import (
    REAL_TIME_SUFFIX,
    ROBOTS_FOLDER,
    TASK_SEPARATOR,
    TASK_SUFFIX,
    task_file,
    task_values,
)
from brakeline.messaging.task_code import load_code

_STRICT = ConfigDict(extra="forbid")


MOST_REWARD_FACTOR = 10.0  # of the sum of all rewards of a task, with the progress of one metre


@dataclass(frozen=True)
class Reward:
    """Rewards of an episode. The progress of all steps sums to the distance gained, whatever the path."""

    __pydantic_config__ = _STRICT
    progress: float = 20.0  # per metre closer to the goal
    goal: float = 100.0
    collision: float = -100.0
    run_into: float = -50.0  # collision while the robot stood
    cut: float = -20.0  # an intervention that ends the episode (SAILR)
    correction_penalty: float = 1.0  # subtracted for a correction by the whole range of an input; in proportion below

    def __post_init__(self) -> None:
        check_penalty(self.correction_penalty)
        check_numbers(self, "progress", "goal", least=0.0)
        check_numbers(self, "collision", "run_into", "cut")
        check_most(self, "collision", "run_into", "cut", most=0.0)

    @property
    def most(self) -> float:
        """The largest plausible reward or penalty of a step; the learner refuses a step with a larger one."""
        return MOST_REWARD_FACTOR * float(sum(map(abs, astuple(self))))


def check_penalty(penalty: float | None, robot: RobotWithTask | None = None) -> None:
    """Raise ValueError for a penalty that cannot be subtracted from a reward. None stands for the task's.

    Args:
        penalty: for a correction by the whole range of an input.
        robot: checks also that the learner accepts a correction by the whole range of all inputs.
    """
    if penalty is None:
        return
    if not 0.0 <= penalty < float("inf"):  # NaN fails too
        raise ValueError(f"a penalty is finite and not negative: {penalty:g} cannot be subtracted from a reward")
    if robot is not None and penalty > (most := robot.task.reward.most / math.sqrt(robot.action_dim)):
        raise ValueError(
            f"a penalty of {penalty:g} is out of proportion to the rewards of {robot.name}: give at most {int(most)}"
        )


@dataclass(frozen=True)
class LidarLayout:
    """The rays of an observation: `fan` rays in the plane, or `azimuths` times `elevations` rays in space."""

    __pydantic_config__ = _STRICT
    range: float  # observed as 1 [m]
    degrees: float  # angle that the fan or the elevations span
    fan: int = 0
    azimuths: int = 0
    elevations: int = 0

    def __post_init__(self) -> None:
        check_numbers(self, "range", above=0.0)
        check_numbers(self, "degrees", "fan", "azimuths", "elevations", least=0.0)
        check_most(self, "degrees", most=360.0)
        if (self.azimuths > 0) != (self.elevations > 0) or (self.fan and self.azimuths):
            counts = f"fan = {self.fan}, azimuths = {self.azimuths}, elevations = {self.elevations}"
            raise ValueError(f"{counts}: give the rays of a fan, or azimuths and elevations of rays in space")


@dataclass(frozen=True)
class Rivals:
    """Settings of the rivals that differ from the defaults, and margins [m] for the tuning of SECAS and PSF."""

    __pydantic_config__ = _STRICT
    secas: dict[str, float] = field(default_factory=dict)
    sailr: dict[str, float] = field(default_factory=dict)
    cbf: dict[str, float] = field(default_factory=dict)
    psf: dict[str, float] = field(default_factory=dict)
    margins: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_numbers(self, "margins", least=0.0)
        for method in (self.secas, self.sailr, self.cbf, self.psf):
            check_numbers(SimpleNamespace(**method), *method)


@dataclass(frozen=True)
class Task:
    """The task in a file.

    >>> task = robot_with_task("ground").task
    >>> task.observation_dim, task.arenas["default"].step_limit > 0
    (26, True)
    """

    __pydantic_config__ = _STRICT
    simulator: str  # code: (conditions, tap) -> MakeVehicle
    senses: str  # code: (robot, arena, rng, noise of a range) -> Senses
    policies: dict[str, str]  # scripted policies by name, code: (robot, rng) -> Policy
    observation: tuple[str, ...]  # "name [scale]" of each coordinate after the rays
    arenas: dict[str, ArenaKind]
    lidar: LidarLayout | None = None
    reward: Reward = field(default_factory=Reward)
    trajectories: int = 200  # number to record for a model set, 300 periods each
    steps: int = 60_000  # training steps in a comparison
    learner: dict[str, Any] = field(default_factory=dict)  # settings of TD3 for this task, in place of the defaults
    batch: dict[str, Any] = field(default_factory=dict)  # more of them for `train --backend batch`
    at_once: int = 16  # robots that train at once in a comparison, where batches simulate them
    simulator_version: int = 1  # raise it if the motion changes: what an older simulator recorded is recorded again
    turn_aside: bool = False  # the filter turns blocked robots aside (docs/method.md §4)
    symmetry: Literal["none", "turns"] = "none"  # turns: the task is invariant to quarter turns and mirroring
    rivals: Rivals = field(default_factory=Rivals)
    folder: Path = Path()  # folder of the task's file
    name: str = ""  # name of the file without its suffix; empty: there is no file

    def __post_init__(self) -> None:
        check_numbers(self, "trajectories", "steps", "at_once", least=1)
        check_numbers(self, "simulator_version", least=0)

    @cached_property
    def rays(self) -> LidarRays:
        """Directions and range of the observation's rays; no rays without a lidar."""
        lidar = self.lidar or LidarLayout(1.0, 0.0)
        if lidar.azimuths:
            return spherical_rays(lidar.azimuths, lidar.elevations, lidar.degrees, lidar.range)
        return planar_rays(lidar.fan, lidar.degrees, lidar.range)

    @cached_property
    def observed(self) -> tuple[str, ...]:
        """Names of all coordinates of an observation, rays first."""
        rays = self.rays
        return (*(f"ray {i} [range/{rays.range:g} m]" for i in range(len(rays.directions))), *self.observation)

    @property
    def default_arena(self) -> str:
        """The arena that is taken if none is named: the one called `default`, or the first in the file."""
        return "default" if "default" in self.arenas else next(iter(self.arenas), "default")

    @property
    def observation_dim(self) -> int:
        return len(self.observed)

    def code(self, place: str) -> Any:
        """Import the object at `module:name`, or at `file.py:name` beside the task's file. Errors: see `load_code`."""
        return load_code(place, self.folder)


@dataclass(frozen=True)
class RobotWithTask(Robot):
    """A robot with its task, as environments, policies and learners need it.

    The filter, its requests, model sets and data sets use a `Robot` without a task.

    >>> isinstance(robot_with_task("ground"), Robot)
    True
    """

    task: Task = field(kw_only=True, hash=False)

    def learning_layout(self) -> str:
        """Return the hash of what an actor and a learner must share: the robot's layout and the observation."""
        text = json.dumps([self.layout(), *self.task.observed])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def accepts_learning_layout(self, layout: object) -> bool:
        """Return whether a layout is this learning layout, or the one from before robots were files."""
        return isinstance(layout, str) and layout in (self.learning_layout(), FORMER_LAYOUTS.get(self.name))


NO_SPACE = (
    "has no position, and a task leads a robot to a place among obstacles: record it with a program of your own, "
    "import the log, and put the filter in front of your own policy"
)


def with_task(robot: Robot, task: Task) -> RobotWithTask:
    """Return the robot together with a task."""
    return RobotWithTask(**{item.name: getattr(robot, item.name) for item in fields(Robot)}, task=task)


def robot_with_task(name: Path | str) -> RobotWithTask:
    """Read a robot by its name or path, with its task.

    >>> robot_with_task("quadrotor").task.observation_dim
    189

    Args:
        name: as for `robot_named`. The task of `my.toml` is `my.task.toml` beside it; `ground+tracks` is the robot
            `ground` with the additional task `tracks`.

    Raises:
        UnknownRobot: no robot has this name, or its description has mistakes.
        UnknownTask: the robot has no such task, or the task's file has mistakes.
    """
    robot = robot_named(name)
    if not robot.position_dim:
        raise UnknownTask(f"{robot.name} {NO_SPACE}")
    return with_task(robot, read_task(task_path(str(name))))


def robot_maybe_with_task(name: str) -> Robot:
    """Read a robot like `robot_with_task`; a robot from a path may have no task."""
    if name.endswith(".toml") and not task_file(name).is_file():
        return robot_named(name)
    return robot_with_task(name)


def needs_task(robot: Robot) -> RobotWithTask:
    """Return the robot, which must have a task. Raises UnknownTask: the robot has no task."""
    if not isinstance(robot, RobotWithTask):
        if not robot.position_dim:
            raise UnknownTask(f"{robot.name} {NO_SPACE}")
        raise UnknownTask(
            f"{robot.name} has no task: write its observation, rewards and arenas to {robot.kind}.task.toml"
        )
    return robot


def arena_kind(robot: RobotWithTask, name: str) -> ArenaKind:
    """Return the kind of a robot's arena. Raises UnknownName: the robot has no arena of this name."""
    kinds = robot.task.arenas
    if name not in kinds:
        names = ", ".join(sorted(kinds)) or "none"
        raise UnknownName(f"no arena is called {name!r}; there are: {names} ({robot.kind})")
    return kinds[name]


STUDIED = ("default", "dense")  # the arenas of a study, unless others are named


def studied_arenas(robot: RobotWithTask, names: tuple[str, ...] = STUDIED) -> tuple[str, ...]:
    """Return the arenas of a study: those that were named, or those of `STUDIED` that a robot has.

    Raises:
        UnknownName: the robot has no arena of this name.
    """
    if names == STUDIED:
        names = tuple(name for name in STUDIED if name in robot.task.arenas) or STUDIED[:1]
    for name in names:
        arena_kind(robot, name)
    return names


def task_path(name: str) -> Path:
    """Return the path of the task of a robot's name or path.

    Raises:
        UnknownRobot, UnknownTask: there is no such robot, or no such file.
    """
    path = task_file(name)
    if path.is_file():
        return path
    kind = robot_named(name).kind
    if path.parent == ROBOTS_FOLDER and TASK_SEPARATOR in name:
        others = ROBOTS_FOLDER.glob(f"{kind}{TASK_SEPARATOR}*{TASK_SUFFIX}")
        names = sorted(other.name.removesuffix(TASK_SUFFIX) for other in others)
        raise UnknownTask(f"there is no task {name}; additional tasks of {kind}: {', '.join(names)}")
    raise UnknownTask(f"{kind} has no task: write its observation, rewards and arenas to {path}")


def address(name: str) -> str:
    """Return the name or the absolute path by which another process reads the same robot and task.

    Raises:
        UnknownRobot, UnknownTask: there is no such robot, or no such task.
    """
    base = name.removesuffix(REAL_TIME_SUFFIX)
    if base.endswith(".toml"):
        return str(Path(base).resolve()) + name[len(base) :]
    task_path(name)
    return name


def address_in_real_time(name: str) -> str:
    """Return the address of the same robot in real time."""
    return address(name.removesuffix(REAL_TIME_SUFFIX)) + REAL_TIME_SUFFIX


PLAIN = {"missing": "missing", "unexpected_keyword_argument": "unknown: check its spelling"}  # for pydantic's words


def read_task(path: Path) -> Task:
    """Read the task in a file. Raises UnknownTask: the file has mistakes; the message lists all of them."""
    try:
        values = task_values(path)
        arenas = values.get("arenas", {})
        values["arenas"] = {name: _arena(arenas, (name,)) for name in arenas}
        place = {"folder": path.parent, "name": path.name.removesuffix(TASK_SUFFIX)}
        return TypeAdapter(Task).validate_python(values | place)
    except ValidationError as error:
        problems = [
            (".".join(map(str, e["loc"])), PLAIN.get(e["type"], e["msg"].removeprefix("Value error, ")))
            for e in error.errors()
        ]
        lines = "".join(f"\n  {place}: {what}" if place else f"\n  {what}" for place, what in problems)
        raise UnknownTask(f"{path} is no task:{lines}") from error
    except RecursionError as error:
        raise UnknownTask(f"{path} is no task: it is like itself, at once or by way of other tasks") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnknownTask(f"{path} is no task: {error}") from error


def _arena(arenas: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of an arena, with those of the arena that it is `like` as defaults.

    names: its name, after those of the arenas that are like it.

    Raises:
        ValueError: there is no arena that it is like, or it is like itself.
    """
    first, name = names[0], names[-1]
    if name not in arenas:
        raise ValueError(f"arenas.{first}: no arena is called {name!r}")
    if name in names[:-1]:
        raise ValueError(f"arenas.{first}: it is like itself ({' → '.join(names)})")
    values = dict(arenas[name])
    base = values.pop("like", None)
    return ({} if base is None else _arena(arenas, (*names, base))) | values
