"""Recorded trajectories, and the checks that they must pass."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.errors import BadData, UnknownRobot
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot import Array, Robot, refuse_shipped_name, robot_named
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.model.repeated_driving import repeated_driving
from brakeline.safety.model.tensor_file import has_entry, pack, unpack

ENTRY = "dataset"
RESTLESS = "restless"  # entry in `about`: the number of restless trajectories, which are the last ones


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One uninterrupted recording of T periods. Two trajectories are equal only if they are the same object.

    >>> states, inputs = np.zeros((4, 5)), np.zeros((3, 2))
    >>> standing = Trajectory(states, inputs, paths=np.zeros((3, 1, 2)), turned=np.zeros(3))
    >>> len(standing.inputs)
    3

    Attributes:
        states (T+1, n): measured states.
        inputs (T, m): executed inputs.
        paths (T, S, d): S positions within each period [m], relative to its start and in the frame of its start, from
            dead reckoning. In joint space (T, S, n): S states within each period, relative to its start.
        turned (T,): heading change over each period [rad], from dead reckoning.
        before (m,): the input in force at the start. None if the robot stood still.
        headings (T, S): heading changes [rad] since the period's start, at the times of `paths`. None if unknown.
    """

    states: Array
    inputs: Array
    paths: Array
    turned: Array
    before: Array | None = None
    headings: Array | None = None

    @property
    def first_in_force(self) -> Array:
        """The input in force (m,) at the start; zero if the robot stood still."""
        return np.zeros(self.inputs.shape[1]) if self.before is None else self.before

    def in_force(self) -> Array:
        """Return the input in force (T, m) at the start of each period."""
        return np.vstack([self.first_in_force, self.inputs[:-1]])


def _continues(first: Trajectory, second: Trajectory) -> bool:
    """Return whether a trajectory begins with the state and the input that another one ends with."""
    if second.before is None or (first.headings is None) != (second.headings is None):
        return False
    same = np.array_equal(first.states[-1], second.states[0]) and np.array_equal(first.inputs[-1], second.before)
    return same and first.paths.shape[1] == second.paths.shape[1]


def _chained(parts: list[Trajectory]) -> Trajectory:
    if len(parts) == 1:
        return parts[0]
    states = np.concatenate([parts[0].states[:1], *(t.states[1:] for t in parts)])
    inputs, paths, turned = (
        np.concatenate([getattr(t, name) for t in parts]) for name in ("inputs", "paths", "turned")
    )
    within = [t.headings for t in parts if t.headings is not None]
    return Trajectory(states, inputs, paths, turned, parts[0].before, np.concatenate(within) if within else None)


@dataclass(frozen=True)
class Dataset:
    """Recorded trajectories of one robot.

    >>> data = Dataset.load(RECORDING)  # a file of `brakeline collect` or `brakeline import`
    >>> data.robot.name, data.periods > 10_000
    ('ground', True)

    Attributes:
        robot: the robot's description.
        trajectories: recordings, each uninterrupted.
        about: the origin of the data: noise levels, seed, payload and more.
        chord_deviation: how far the path may leave the straight line between two samples of the source [m]. In joint
            space, how far a limit's value may exceed its values at both samples, in units of `Robot.limit_scales`.
    """

    robot: Robot
    trajectories: tuple[Trajectory, ...]
    about: dict[str, str] = field(default_factory=dict)
    chord_deviation: float = 0.0

    @property
    def periods(self) -> int:
        return sum(len(t.inputs) for t in self.trajectories)

    def steady(self) -> Dataset:
        """Return the data set without the restless trajectories, which only mode one-step uses."""
        restless = int(self.about.get(RESTLESS, "0"))
        about = {name: value for name, value in self.about.items() if name != RESTLESS}
        return replace(self, trajectories=self.trajectories[: len(self.trajectories) - restless], about=about)

    def joined(self) -> Dataset:
        """Return the data set with trajectories joined where one continues the one before it.

        `import` cuts a recording into many, because the linear modes hold out whole trajectories. No window of a
        plan's length crosses a cut.
        """
        chains: list[list[Trajectory]] = []
        for t in self.trajectories:
            if chains and _continues(chains[-1][-1], t):
                chains[-1].append(t)
            else:
                chains.append([t])
        return replace(self, trajectories=tuple(_chained(chain) for chain in chains))

    def check(self) -> None:
        """Check shapes, finite values, the bounds of inputs, that no position jumps, and that no driving occurs twice.

        Raises:
            BadData: a check fails; the message says which one, and in which trajectory.
        """
        robot = self.robot
        if not self.trajectories:
            raise BadData("the data set holds no trajectory: record or import some driving")
        if not 0.0 <= self.chord_deviation < math.inf:
            raise BadData(f"the chord deviation {self.chord_deviation!r} is no length: it is finite, and 0 m or more")
        for i, t in enumerate(self.trajectories):
            periods = len(t.inputs)
            shapes = t.states.shape, t.inputs.shape, t.paths.shape, t.turned.shape
            samples = max(t.paths.shape[1], 1) if t.paths.ndim == 3 else 1
            wanted = (
                (periods + 1, robot.state_dim),
                (periods, robot.action_dim),
                (periods, samples, robot.path_dim),
                (periods,),
            )
            if shapes != wanted or not periods:
                raise BadData(f"trajectory {i}: states, inputs, paths and turned have shapes {shapes}, not {wanted}")
            if t.before is not None and t.before.shape != (robot.action_dim,):
                raise BadData(f"trajectory {i}: before has shape {t.before.shape}, not {(robot.action_dim,)}")
            if t.headings is not None and t.headings.shape != t.paths.shape[:2]:
                raise BadData(f"trajectory {i}: headings has shape {t.headings.shape}, not {t.paths.shape[:2]}")
            for name in ("states", "inputs", "paths", "turned", "before", "headings"):
                if getattr(t, name) is not None and not np.isfinite(getattr(t, name)).all():
                    raise BadData(f"trajectory {i}: {name} holds NaN or infinity")
            inputs = t.inputs if t.before is None else np.vstack([t.before, t.inputs])
            if (inputs < robot.low() - 1e-9).any() or (inputs > robot.high() + 1e-9).any():
                raise BadData(f"trajectory {i}: an input is out of the robot's bounds: correct the bounds or the log")
            jumps = np.flatnonzero(_jump(robot, t) > 0.0)
            if len(jumps):
                why = f"trajectory {i}: the position jumps in period {jumps[0]}"
                raise BadData(f"{why}: if two recordings meet there, give them as two trajectories")
        if (twice := repeated_driving(robot, self.trajectories)) is not None:
            raise BadData(
                f"trajectories {twice.first} and {twice.second} hold the same driving, {twice.seconds:.0f} s in all: a "
                "copy is no evidence. Give each recording once"
            )

    def split(self, shares: Sequence[float]) -> list[Dataset]:
        """Split the data set into parts with whole trajectories.

        Args:
            shares: the share of each part; their sum is 1.
        """
        edges = np.cumsum([0.0, *shares])
        place = (np.arange(len(self.trajectories)) * 0.6180339887) % 1.0  # golden ratio: spreads each part evenly
        parts = np.searchsorted(edges, place, side="right") - 1
        return [
            replace(self, trajectories=tuple(t for t, p in zip(self.trajectories, parts, strict=True) if p == i))
            for i in range(len(shares))
        ]

    def save(self, path: Path | str) -> None:
        """Write a safetensors file with the concatenated trajectories and their lengths."""
        names = ("states", "inputs", "paths", "turned")
        tensors = {n: np.concatenate([getattr(t, n) for t in self.trajectories]) for n in names}
        tensors["before"] = np.array([t.first_in_force for t in self.trajectories])
        if all(t.headings is not None for t in self.trajectories):
            tensors["headings"] = np.concatenate([t.headings for t in self.trajectories])
        tensors["lengths"] = np.array([len(t.inputs) for t in self.trajectories])
        robot = self.robot.in_lockstep()
        about: dict[str, Any] = {"robot": robot.name, "layout": robot.layout(), "about": self.about}
        about["bulge"] = self.chord_deviation  # its former name, which files still have
        about["description"] = json.dumps(robot.description)  # as text, since the order of its names matters
        write_atomically(Path(path), pack(tensors, ENTRY, about))

    @staticmethod
    def load(path: Path | str) -> Dataset:
        """Read and check a data set.

        Raises:
            BadData: the file is no data set, the robot's layout has changed, or a check fails.
        """
        try:
            tensors, about = unpack(Path(path).read_bytes(), ENTRY)
            about_data = dict(about.get("about", {}))
        except (OSError, ValueError, TypeError) as error:
            raise BadData(f"{path} is no data set: {error}") from error
        missing = {"states", "inputs", "paths", "turned", "before", "lengths"} - tensors.keys()
        if missing or "robot" not in about:
            raise BadData(f"{path} is no data set: {', '.join(sorted(missing)) or 'its robot'} is missing")
        robot = _recorded_robot(path, about)
        chord_deviation = about.get("bulge", 0.0)
        if not isinstance(chord_deviation, int | float) or not 0.0 <= chord_deviation < math.inf:
            raise BadData(
                f"{path}: the chord deviation {chord_deviation!r} is no length: it is finite, and 0 m or more"
            )
        data = Dataset(robot, _separated(path, tensors), about_data, float(chord_deviation))
        data.check()
        return data

    @staticmethod
    def about_of(path: Path) -> dict[str, str]:
        """Return the origin of a data set (`about`) of any robot, or nothing if the file is no data set."""
        try:
            return dict(unpack(path.read_bytes(), ENTRY)[1].get("about", {}))
        except (OSError, ValueError, TypeError):
            return {}

    @staticmethod
    def check_out(path: Path) -> None:
        """Raise ValueError if `--out` names something that is no data set, and that would be lost."""
        if path.is_dir():
            raise ValueError(f"--out {path} is a folder: give the path of a file, such as data.safetensors")
        if path.exists() and not has_entry(path.read_bytes(), ENTRY):
            raise ValueError(f"--out {path} exists, and is no data set: choose another file, or delete it")

    def digest(self) -> str:
        """Return a hash of the recorded numbers, 12 hexadecimal digits: the same after `save` and `load`."""
        sha = hashlib.sha256()
        for t in self.trajectories:
            for part in (t.states, t.inputs, t.paths, t.turned, t.first_in_force, t.headings):
                sha.update(b"" if part is None else part.tobytes())
        return sha.hexdigest()[:12]


def bends(robot: Robot, states: Array) -> Array:
    """Return the sizes (T-1,) of the second differences of the position [m] in states (T+1, n).

    In joint space, they are those of the limits' values, in units of `Robot.limit_scales`.
    """
    second = np.diff(states, 2, axis=0)
    if not robot.position_dim:
        return np.asarray(np.abs(robot.limit_values(second)).max(1))
    return np.asarray(np.linalg.norm(second[:, : robot.position_dim], axis=1))


def _jump(robot: Robot, t: Trajectory) -> Array:
    """Return how much farther the measured position moved than dead reckoning and noise explain (T,) [m]."""
    moved = np.linalg.norm(np.diff(t.states[:, : robot.position_dim], axis=0), axis=1)
    steps = np.diff(t.paths, axis=1, prepend=0.0)
    driven = np.linalg.norm(steps, axis=2).sum(1)
    noise = 2.0 * np.linalg.norm(robot.measurement_bound[: robot.position_dim])
    return np.asarray(moved - 2.0 * (driven + noise))  # factor 2: detect gross errors, not slipping wheels


def _recorded_robot(path: Path | str, about: dict[str, Any]) -> Robot:
    """Return the robot of a data set. Raises BadData: there is no such robot, or its layout has changed."""
    name, described = str(about["robot"]), about.get("description")
    try:
        robot = (
            robot_named(name)
            if described is None
            else refuse_shipped_name(robot_from_description(parse_json(described), name))
        )
    except (UnknownRobot, ValueError, TypeError) as error:
        raise BadData(f"{path}: {error}") from error
    if robot.name != name:
        raise BadData(f"{path} is about robot {name!r}, but its description is about {robot.name!r}: record it again")
    if not robot.accepts_layout(about.get("layout")):
        raise BadData(f"{path} was recorded for another layout of {robot.name}: record it again")
    return robot


def _separated(path: Path | str, tensors: dict[str, Array]) -> tuple[Trajectory, ...]:
    """Separate the trajectories that `Dataset.save` concatenated. Raises BadData: their lengths do not fit."""
    lengths = tensors["lengths"]
    parts = {name: np.atleast_1d(tensor).astype(float) for name, tensor in tensors.items() if name != "lengths"}
    if lengths.ndim != 1 or lengths.dtype.kind != "i" or (lengths <= 0).any():
        raise BadData(f"{path}: the trajectories' lengths are no lengths: they are whole numbers above 0")
    total, count = lengths.sum(), len(lengths)
    wanted = {"states": total + count, "inputs": total, "paths": total, "turned": total, "before": count}
    if "headings" in parts:
        wanted["headings"] = total
    if any(len(parts[name]) != rows for name, rows in wanted.items()):
        raise BadData(f"{path}: the trajectories' lengths do not add up to the numbers of states and inputs")
    ends = np.cumsum(lengths)
    return tuple(
        Trajectory(
            parts["states"][start + i : end + i + 1],
            parts["inputs"][start:end],
            parts["paths"][start:end],
            parts["turned"][start:end],
            parts["before"][i],
            parts["headings"][start:end] if "headings" in parts else None,
        )
        for i, (start, end) in enumerate(zip(ends - lengths, ends, strict=True))
    )
