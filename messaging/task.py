"""What is learned with a robot: what its policy observes and is paid, in which arenas, and what stands for the robot.

A task is a file beside the robot's: `robots/NAME.task.toml`, or `my.task.toml` beside `my.toml`. A robot that comes
with the program may have further ones, `robots/NAME+OTHER.task.toml`, each of which says what it is `like`; give the
name `NAME+OTHER` to get that task. What a task names as code (`simulator`, `senses`, `policies`) is `module:name`, or
`file.py:name` beside the task; only `deploy` and `sim` load it.

Robots and tasks are values: a program reads them once, by name or path, and passes them on.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import sys
import tomllib
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from brakeline.messaging.ray_directions import LidarRays, planar_rays, spherical_rays
from brakeline.messaging.robot import (
    FORMER_LAYOUTS,
    REAL_TIME_SUFFIX,
    ROBOTS_FOLDER,
    TASK_SEPARATOR,
    Robot,
    robot_named,
)

_STRICT = ConfigDict(extra="forbid")


class UnknownTask(ValueError):
    """There is no task for this robot, or its file is none; the message says what is wrong in it."""


@dataclass(frozen=True)
class Reward:
    """What an episode pays. Progress adds up to the way made towards the goal, whichever way was taken."""

    __pydantic_config__ = _STRICT
    progress: float = 20.0  # a metre nearer to the goal
    goal: float = 100.0
    collision: float = -100.0
    run_into: float = -50.0  # while it stood
    cut: float = -20.0  # where an intervention ends the episode: SAILR's lowest


@dataclass(frozen=True)
class MoverKind:
    """What goes about in an arena: how many (least, most), how large, how fast; what a sensor tells of them."""

    __pydantic_config__ = _STRICT
    count: tuple[int, int]
    radius: float  # m; in the plane a disc, in space a ball
    speed: float  # m/s, at most
    acceleration: float  # m/s², at most
    keep: float  # m from the robot's start to its surface, at the start
    position_error: float = 0.03  # m, of what is measured of them
    velocity_error: float = 0.05  # m/s
    steps_over: bool = False  # whoever it runs into while that stands, and which then goes on; else that is its end


@dataclass(frozen=True)
class ArenaKind:
    """What is drawn for an arena of one name. Pairs are (least, most)."""

    __pydantic_config__ = _STRICT
    half_width: float  # m
    cylinders: tuple[int, int]
    radius: tuple[float, float]  # m
    boxes: tuple[int, int]
    edge: tuple[float, float]  # m, both edges of a box
    square: bool  # boxes have two equal edges
    gap: float  # m between any two obstacles in plan, walls included, beyond the robot's diameter
    path_clearance: float  # m beside the footprint, all along some way from start to goal
    goal_distance: float  # m from the start, at least
    step_limit: int
    start_clearance: float = 0.1  # m beside the footprint, at the start and at the goal
    goal_radius: float = 0.25  # m
    height: float | None = None  # m from floor to ceiling; None: an arena in the plane, without
    tall: tuple[float, float] = (0.0, 0.0)  # m, a box's height in space
    spheres: tuple[int, int] = (0, 0)
    ball: tuple[float, float] = (0.0, 0.0)  # m, radius of a sphere
    movers: MoverKind | None = None
    ring: float | None = None  # m: starts are on a circle of this radius, goals opposite: who shares it has to pass


@dataclass(frozen=True)
class Lidar:
    """The rays of an observation: a fan of so many in the plane, or azimuths x elevations in space."""

    __pydantic_config__ = _STRICT
    range: float  # m, observed as 1
    degrees: float  # that the fan, or the elevations, spread over
    fan: int = 0
    azimuths: int = 0
    elevations: int = 0


@dataclass(frozen=True)
class Rivals:
    """Where SECAS and SAILR are tuned otherwise than by default, and the margins [m] that SECAS's tuning tries."""

    __pydantic_config__ = _STRICT
    secas: dict[str, float] = field(default_factory=dict)
    sailr: dict[str, float] = field(default_factory=dict)
    margins: tuple[float, ...] = ()


@dataclass(frozen=True)
class Task:
    """A task as its file says it. observation: what follows the rays, each name with its scale."""

    __pydantic_config__ = _STRICT
    simulator: str  # makes vehicles: (conditions, tap) -> MakeVehicle
    senses: str  # observes: (robot, arena, rng, noise of a range) -> Senses
    policies: dict[str, str]  # scripted ones by name: (robot, rng) -> Policy
    observation: tuple[str, ...]
    arenas: dict[str, ArenaKind]
    lidar: Lidar | None = None
    reward: Reward = field(default_factory=Reward)
    trajectories: int = 200  # of 300 periods, that are recorded for a model set
    steps: int = 60_000  # of training, in a comparison
    symmetry: Literal["none", "turns"] = "none"  # turns: the world turned by quarters and mirrored is as true
    rivals: Rivals = field(default_factory=Rivals)
    folder: Path = Path()  # where its file lies
    name: str = ""  # of its file; empty: it has none

    @cached_property
    def rays(self) -> LidarRays:
        """Where the observation's rays point; none without a lidar."""
        seen = self.lidar or Lidar(1.0, 0.0)
        if seen.azimuths:
            return spherical_rays(seen.azimuths, seen.elevations, seen.degrees, seen.range)
        return planar_rays(seen.fan, seen.degrees, seen.range)

    @cached_property
    def observed(self) -> tuple[str, ...]:
        """The names of all coordinates of an observation, the rays first."""
        rays = self.rays
        return (*(f"ray {i} [range/{rays.range:g} m]" for i in range(len(rays.directions))), *self.observation)

    @property
    def observation_dim(self) -> int:
        return len(self.observed)

    def code(self, place: str) -> Any:
        """What stands at `module:name`, or `file.py:name` beside the task's file.

        Raises:
            UnknownTask: there is no such thing.
        """
        module, _, name = place.partition(":")
        try:
            if module.endswith(".py"):
                return getattr(_module_in(self.folder / module), name)
            return getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, OSError) as error:
            raise UnknownTask(f"{place!r} is no code that can be loaded: {error}") from error


def _module_in(path: Path) -> Any:
    """The module in a file, loaded once."""
    name = f"task_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    if name not in sys.modules:
        found = importlib.util.spec_from_file_location(name, path)
        if found is None or found.loader is None:
            raise ImportError(f"{path} is no Python file")
        module = importlib.util.module_from_spec(found)
        sys.modules[name] = module
        found.loader.exec_module(module)
    return sys.modules[name]


@dataclass(frozen=True)
class RobotWithTask(Robot):
    """A robot together with its task: what an environment, a policy, and a learner need.

    The filter needs a `Robot` alone: a request, a model set, and a data set know no task.
    """

    task: Task = field(kw_only=True, hash=False)

    def learning_layout(self) -> str:
        """Return the hash of what an actor and a learner must share: the robot's vectors and the observation."""
        words = json.dumps([self.layout(), *self.task.observed])
        return hashlib.sha256(words.encode()).hexdigest()[:16]

    def accepts_learning_layout(self, layout: object) -> bool:
        """Is it this learning layout, or the one that the robot had before robots were files?"""
        return layout == self.learning_layout() or layout == FORMER_LAYOUTS.get(self.name)


def with_task(robot: Robot, task: Task) -> RobotWithTask:
    """Return the robot together with a task."""
    return RobotWithTask(**{part.name: getattr(robot, part.name) for part in fields(Robot)}, task=task)


def robot_with_task(name: str) -> RobotWithTask:
    """Read the robot of a name or at a path, and its task.

    Args:
        name: as `robot_named` takes it. The task of `my.toml` is `my.task.toml` beside it; `ground+tracks` is the robot
            `ground` with another task than its usual one.

    Raises:
        UnknownRobot; UnknownTask: there is no such task.
    """
    return with_task(robot_named(name), read(task_path(name)))


def robot_maybe_with_task(name: str) -> Robot:
    """Read the robot of a name or at a path, together with its task if it has one: somebody's own robot needs none.

    Raises:
        UnknownRobot; UnknownTask: the name says a task that there is not, or its file is none.
    """
    robot = robot_named(name)
    if name.endswith(".toml") and not _task_beside(name).is_file():
        return robot
    return with_task(robot, read(task_path(name)))


def needs_task(robot: Robot) -> RobotWithTask:
    """Return the robot if it has a task.

    Raises:
        UnknownTask: it has none.
    """
    if not isinstance(robot, RobotWithTask):
        raise UnknownTask(
            f"{robot.name} has no task: what it observes, is paid, and drives in ({robot.kind}.task.toml)"
        )
    return robot


def task_path(name: str) -> Path:
    """Return the file of the task that belongs to a robot's name or path.

    Raises:
        UnknownRobot; UnknownTask: there is no such file.
    """
    if name.removesuffix(REAL_TIME_SUFFIX).endswith(".toml"):
        path = _task_beside(name)
    else:
        path = ROBOTS_FOLDER / f"{name.removesuffix(REAL_TIME_SUFFIX)}.task.toml"
    if path.is_file():
        return path
    kind = robot_named(name).kind
    if TASK_SEPARATOR in name and not name.removesuffix(REAL_TIME_SUFFIX).endswith(".toml"):
        there = sorted(
            p.name.removesuffix(".task.toml") for p in ROBOTS_FOLDER.glob(f"{kind}{TASK_SEPARATOR}*.task.toml")
        )
        raise UnknownTask(f"there is no {name}; of {kind} there are, besides itself: {', '.join(there)}")
    raise UnknownTask(f"{kind} has no task: what it observes, is paid, and drives in (expected: {path})")


def _task_beside(path: str) -> Path:
    return Path(path.removesuffix(REAL_TIME_SUFFIX)).with_suffix(".task.toml")


def address(name: str) -> str:
    """Return the name or the absolute path from which another process reads the same robot and task.

    Raises:
        UnknownRobot; UnknownTask: there is no such robot, or no such task of it.
    """
    base = name.removesuffix(REAL_TIME_SUFFIX)
    if base.endswith(".toml"):
        return str(Path(base).resolve()) + name[len(base) :]
    task_path(name)
    return name


def address_in_real_time(name: str) -> str:
    """Return the address of the same robot in real time."""
    return address(name.removesuffix(REAL_TIME_SUFFIX)) + REAL_TIME_SUFFIX


def read(path: Path) -> Task:
    """The task in a file.

    Raises:
        UnknownTask: with every mistake in it.
    """
    try:
        values = _with_base(path)
        arenas = values.get("arenas", {})
        values["arenas"] = {name: _alike(arenas, name) for name in arenas}
        return TypeAdapter(Task).validate_python(
            values | {"folder": path.parent, "name": path.name.removesuffix(".task.toml")}
        )
    except ValidationError as error:
        lines = "".join(f"\n  {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise UnknownTask(f"{path} is no task:{lines}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnknownTask(f"{path} is no task: {error}") from error


def _with_base(path: Path) -> dict[str, Any]:
    """What a task's file says, with what the one beside it says that it is `like` where it says nothing itself."""
    own = tomllib.loads(path.read_text())
    base = own.pop("like", None)
    return ({} if base is None else _with_base(path.with_name(f"{base}.task.toml"))) | own


def _alike(arenas: dict[str, Any], name: str) -> dict[str, Any]:
    """An arena's values, with those of the one that it is `like` where it has none of its own."""
    own = dict(arenas[name])
    base = own.pop("like", None)
    return (_alike(arenas, base) if base is not None else {}) | own
