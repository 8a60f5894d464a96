"""Recorded trajectories, their checks, and the windows that model sets are made from.

A *plan window* of length k starts at a period whose inputs follow the robot's schedule (chosen inputs, then braking)
for k periods. Displacement is taken in the robot's frame at the window's start, so position is no regressor.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messaging.files import write_whole
from messaging.robots import Robot, UnknownRobot, robot_named
from messaging.shapes import rotate
from safety.tensors import pack, unpack

Array = NDArray[np.float64]

ENTRY = "dataset"
FEWEST_WINDOWS = 200  # of a length; below it nothing useful is bounded
WORST_CONDITION = 1e4  # of the whitened regressors' second moment


class BadData(ValueError):
    """A data set that must not be used; the message says which check failed."""


@dataclass(frozen=True)
class Trajectory:
    """One uninterrupted recording; nothing pairs its last sample with another's first.

    states: (T+1, n) measured; inputs: (T, m) executed.
    paths: (T, S, d) positions within each period relative to its start, in the frame of its start, from
    dead reckoning; turned: (T,) heading change over each period, likewise [rad].
    """

    states: Array
    inputs: Array
    paths: Array
    turned: Array
    before: Array | None = None  # (m,) the input in force at the start; None: standing still


@dataclass(frozen=True)
class Dataset:
    robot: Robot
    trajectories: tuple[Trajectory, ...]
    about: dict[str, str] = field(default_factory=dict)  # where it comes from: noise levels, seed, payload ...

    @property
    def periods(self) -> int:
        return sum(len(t.inputs) for t in self.trajectories)

    def check(self) -> None:
        """Raises BadData unless dimensions agree, everything is finite and inputs are within bounds."""
        robot = self.robot
        if not self.trajectories:
            raise BadData("the data set holds no trajectory")
        for i, t in enumerate(self.trajectories):
            periods = len(t.inputs)
            shapes = t.states.shape, t.inputs.shape, t.paths.shape, t.turned.shape
            samples = max(t.paths.shape[1], 1) if t.paths.ndim == 3 else 1
            wanted = (
                (periods + 1, robot.state_dim),
                (periods, robot.action_dim),
                (periods, samples, robot.position_dim),
                (periods,),
            )
            if shapes != wanted or not periods:
                raise BadData(f"trajectory {i}: shapes {shapes} where {wanted} belong")
            if t.before is not None and t.before.shape != (robot.action_dim,):
                raise BadData(f"trajectory {i}: the input before it has shape {t.before.shape}")
            for name in ("states", "inputs", "paths", "turned", "before"):
                if getattr(t, name) is not None and not np.isfinite(getattr(t, name)).all():
                    raise BadData(f"trajectory {i}: {name} holds NaN or infinity")
            inputs = t.inputs if t.before is None else np.vstack([t.before, t.inputs])
            if (inputs < robot.low() - 1e-9).any() or (inputs > robot.high() + 1e-9).any():
                raise BadData(f"trajectory {i}: an input is out of the robot's bounds")
            jumps = np.flatnonzero(_jump(robot, t) > 0.0)
            if len(jumps):
                raise BadData(f"trajectory {i}: the position jumps in period {jumps[0]}: two recordings in one?")

    def split(self, shares: Sequence[float]) -> list[Dataset]:
        """Whole trajectories dealt out in turn, by shares that add up to 1."""
        edges = np.cumsum([0.0, *shares])
        place = (np.arange(len(self.trajectories)) * 0.6180339887) % 1.0  # low discrepancy: even over the recording
        parts = np.searchsorted(edges, place, side="right") - 1
        return [
            Dataset(self.robot, tuple(t for t, p in zip(self.trajectories, parts, strict=True) if p == i), self.about)
            for i in range(len(shares))
        ]

    def save(self, path: Path) -> None:
        """Writes a safetensors file: trajectories one after the other, with their lengths."""
        names = ("states", "inputs", "paths", "turned")
        tensors = {n: np.concatenate([getattr(t, n) for t in self.trajectories]) for n in names}
        still = np.zeros(self.robot.action_dim)
        tensors["before"] = np.array([still if t.before is None else t.before for t in self.trajectories])
        tensors["lengths"] = np.array([len(t.inputs) for t in self.trajectories])
        about = {"robot": self.robot.name, "layout": self.robot.layout(), "about": self.about}
        write_whole(path, pack(tensors, ENTRY, about))

    @staticmethod
    def load(path: Path) -> Dataset:
        """Reads and checks a data set.

        Raises:
            BadData: not such a file, of another robot layout, or a check fails.
        """
        try:
            tensors, about = unpack(path.read_bytes(), ENTRY)
            about_data = dict(about.get("about", {}))
        except (OSError, ValueError, TypeError) as error:
            raise BadData(f"{path} is no data set: {error}") from error
        missing = {"states", "inputs", "paths", "turned", "before", "lengths"} - tensors.keys()
        if missing or "robot" not in about:
            raise BadData(f"{path} is no data set: {', '.join(sorted(missing)) or 'its robot'} is missing")
        try:
            robot = robot_named(str(about["robot"]))
        except UnknownRobot as error:
            raise BadData(f"{path}: {error}") from error
        if about.get("layout") != robot.layout():
            raise BadData(f"{path} was recorded for another layout of {robot.name}: record it again")
        lengths = tensors.pop("lengths")
        tensors = {name: np.atleast_1d(tensor).astype(float) for name, tensor in tensors.items()}
        if lengths.ndim != 1 or lengths.dtype.kind != "i" or (lengths <= 0).any():
            raise BadData(f"{path}: the trajectories' lengths are no lengths")
        total = lengths.sum()
        wanted = {
            "states": total + len(lengths),
            "inputs": total,
            "paths": total,
            "turned": total,
            "before": len(lengths),
        }
        if any(len(tensors[name]) != count for name, count in wanted.items()):
            raise BadData(f"{path}: the trajectories' lengths do not add up")
        ends = np.cumsum(lengths)
        trajectories = tuple(
            Trajectory(
                tensors["states"][start + i : end + i + 1],
                tensors["inputs"][start:end],
                tensors["paths"][start:end],
                tensors["turned"][start:end],
                tensors["before"][i],
            )
            for i, (start, end) in enumerate(zip(ends - lengths, ends, strict=True))
        )
        data = Dataset(robot, trajectories, about_data)
        data.check()
        return data

    def digest(self) -> str:
        """Hash of the recorded numbers."""
        sha = hashlib.sha256()
        for t in self.trajectories:
            sha.update(t.states.tobytes())
            sha.update(t.inputs.tobytes())
            sha.update(t.paths.tobytes())
            sha.update(t.turned.tobytes())
            sha.update(b"" if t.before is None else t.before.tobytes())
        return sha.hexdigest()[:12]


@dataclass(frozen=True)
class Windows:
    """Windows of k periods: z (T, nz) = [x_0; u_prev; free inputs], targets y (T, n) after k periods, in the frame of
    the start (position: displacement, heading: change, else the value); bulge (T,) [m] of the last period off its
    chord; latch (T,) [m] travelled after the window while the input stays zero, NaN where it does not."""

    z: Array
    y: Array
    bulge: Array
    latch: Array
    start: NDArray[np.intp]  # (T, 2): trajectory, period

    def __len__(self) -> int:
        return len(self.z)

    def take(self, index: NDArray[np.bool_]) -> Windows:
        return Windows(self.z[index], self.y[index], self.bulge[index], self.latch[index], self.start[index])


def displacement(robot: Robot, start: Array, end: Array) -> Array:
    """`end` (..., n) as seen from `start` (..., n): position and heading relative, in the frame of the start."""
    seen = end.copy()
    position = end[..., : robot.position_dim] - start[..., : robot.position_dim]
    if robot.heading is not None:
        position = rotate(position, -start[..., robot.heading])
        turn = end[..., robot.heading] - start[..., robot.heading]
        seen[..., robot.heading] = (turn + np.pi) % (2.0 * np.pi) - np.pi
    seen[..., : robot.position_dim] = position
    return seen


def windows(data: Dataset, k: int) -> Windows:
    """All windows of k periods in the data, within trajectories only. Raises BadData when there is no trajectory."""
    if not data.trajectories:
        raise BadData("no trajectory: record more of them")
    parts = [_windows_of(data.robot, t, k, i) for i, t in enumerate(data.trajectories)]
    return Windows(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("z", "y", "bulge", "latch", "start")))


def _windows_of(robot: Robot, t: Trajectory, k: int, number: int) -> Windows:
    m, free = robot.action_dim, robot.free_steps
    count = max(len(t.inputs) - k + 1, 0)
    padded = np.vstack([t.inputs, np.zeros((free, m))])  # the free inputs beyond k play no part
    chosen = np.hstack([padded[j : j + count] for j in range(free)])
    planned = chosen @ robot.schedule()[: k * m].T
    actual = np.hstack([t.inputs[j : j + count] for j in range(k)]).reshape(count, k * m)
    start = np.flatnonzero((np.abs(planned - actual) < 1e-9).all(1))
    earlier = np.zeros(m) if t.before is None else t.before
    before = np.vstack([earlier, t.inputs])[start]
    z = np.hstack([t.states[start][:, list(robot.regressor)], before, chosen[start]])
    y = displacement(robot, t.states[start], t.states[start + k])
    bulge = _off_chord(t.paths)[start + k - 1]
    latch = _rest_travel(t)[np.minimum(start + k, len(t.inputs))]
    return Windows(z, y, bulge, latch, np.column_stack([np.full(len(start), number), start]))


def _jump(robot: Robot, t: Trajectory) -> Array:
    """How much farther [m] the measured position moved in each period than dead reckoning and noise explain: (T,)."""
    moved = np.linalg.norm(np.diff(t.states[:, : robot.position_dim], axis=0), axis=1)
    steps = np.diff(t.paths, axis=1, prepend=0.0)
    way = np.linalg.norm(steps, axis=2).sum(1)
    noise = 2.0 * np.linalg.norm(robot.measurement_bound[: robot.position_dim])
    return np.asarray(moved - 2.0 * (way + noise))  # twice: it is for gross errors, not for a slipping wheel


def _off_chord(paths: Array) -> Array:
    """Largest distance of the positions (T, S, d) within a period from the chord of its ends: (T,)."""
    chord = paths[:, -1:]
    length2 = np.maximum((chord**2).sum(-1, keepdims=True), 1e-18)
    along = np.clip((paths * chord).sum(-1, keepdims=True) / length2, 0.0, 1.0)
    return np.asarray(np.sqrt(((paths - along * chord) ** 2).sum(-1)).max(1))


def _rest_travel(t: Trajectory) -> Array:
    """At each period: the way from there [m] while the input stays zero; NaN if it is not zero there. (T+1,)."""
    travel = np.full(len(t.inputs) + 1, np.nan)
    zero = (np.abs(t.inputs) < 1e-9).all(1)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], zero, [False]]).astype(int)))
    for begin, end in zip(runs[::2], runs[1::2], strict=True):
        turned = np.concatenate([[0.0], np.cumsum(t.turned[begin:end])[:-1]])
        paths = t.paths[begin:end]
        if paths.shape[-1] >= 2:
            paths = rotate(paths, np.broadcast_to(turned[:, None], paths.shape[:2]))
        ends = np.vstack([np.zeros((1, paths.shape[-1])), np.cumsum(paths[:, -1], 0)])
        points = paths + ends[:-1, None]
        for at in range(begin, end):
            reach = points[at - begin :] - ends[at - begin]
            travel[at] = np.sqrt((reach**2).sum(-1)).max()
    return travel


def apart(w: Windows, length: int) -> Windows:
    """Those of the windows that do not overlap: each starts at least `length` periods after the one before."""
    chosen = np.zeros(len(w), dtype=bool)
    last = (-1, 0)
    for i, (trajectory, period) in enumerate(w.start):
        if trajectory != last[0] or period >= last[1] + length:
            chosen[i] = True
            last = (trajectory, period)
    return w.take(chosen)


@dataclass(frozen=True)
class Quality:
    """Of a set of regressors, each scaled by its largest value."""

    samples: int
    rank: int
    smallest: float  # singular value, per sqrt(sample)
    condition: float


def quality(z: Array, name: str) -> Quality:
    """Raises BadData when regressors (T, nz) are too few, rank-deficient or nearly collinear."""
    if len(z) < FEWEST_WINDOWS:
        raise BadData(f"{name}: {len(z)} windows, at least {FEWEST_WINDOWS} are needed: record more")
    scaled = z / np.maximum(np.abs(z).max(0), 1e-12)
    singular = np.linalg.svd(scaled / np.sqrt(len(z)), compute_uv=False)
    rank = int((singular > 1e-6).sum())
    condition = float(singular[0] / max(singular[-1], 1e-300))
    if rank < z.shape[1]:
        raise BadData(f"{name}: the regressors have rank {rank} of {z.shape[1]}: record more varied inputs")
    if condition > WORST_CONDITION:
        raise BadData(f"{name}: condition number {condition:.3g} is above {WORST_CONDITION:.0g}: vary the inputs more")
    return Quality(len(z), rank, float(singular[-1]), condition)
