"""Find driving that a data set holds twice: a copy adds no evidence, but would lower the stated bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from brakeline.messaging.robot import Robot
    from brakeline.safety.model.dataset import Trajectory

SHORTEST, FEWEST_ROWS = 3.0, 20  # s and periods: shorter equal stretches do not count, such as equal starts
LEAST = 10.0  # s of equal driving, in all, that make a copy
DIGITS = 8  # of the largest value of a column: a copy with other stamps differs by rounding when it is resampled
Array = NDArray[np.float64]
Words = NDArray[np.uint64]


@dataclass(frozen=True)
class RepeatedDriving:
    """Driving that two trajectories share, but for rounding, and its length in all trajectories."""

    first: int  # index of the trajectory that holds it first
    second: int  # index of the one that holds it again
    seconds: float


def repeated_driving(robot: Robot, trajectories: Sequence[Trajectory]) -> RepeatedDriving | None:
    """Return the driving that occurs more than once; None if there is none.

    Two stretches are the same if all states and inputs of `SHORTEST` seconds are equal in `DIGITS` digits and the state
    changes in each of these periods. No sensor repeats its noise; a robot that stands still may repeat its state.
    """
    length = max(FEWEST_ROWS, math.ceil(SHORTEST / robot.period))
    if sum(len(t.inputs) for t in trajectories) < 2 * length:
        return None
    states = _rounded([_turned_once(robot, t.states) for t in trajectories])
    inputs = _rounded([t.inputs for t in trajectories])
    rows = np.concatenate([np.hstack([x[1:], u]) for x, u in zip(states, inputs, strict=True)])
    words = np.ascontiguousarray(rows + 0.0).view(np.uint64)  # + 0.0: no negative zero
    moves = np.concatenate([(np.diff(x, axis=0) != 0.0).any(1) for x in states])
    owner = np.repeat(np.arange(len(trajectories)), [len(t.inputs) for t in trajectories])
    chain = _chains(trajectories)[owner]
    still = np.concatenate([[0], np.cumsum(~moves)])
    whole = chain[: len(chain) - length + 1] == chain[length - 1 :]
    starts = np.flatnonzero(whole & (still[length:] == still[:-length]))
    values, first, group = np.unique(_window_values(words, length)[starts], return_index=True, return_inverse=True)
    if len(values) == len(starts):
        return None
    origins = starts[first[group]]
    same = (origins != starts) & (words[origins] == words[starts]).all(1)
    origins, copies = origins[same], starts[same]
    ends = np.zeros(len(owner) + 1, np.intp)
    ends[copies] += 1
    np.subtract.at(ends, copies + length, 1)
    seconds = robot.period * int(np.count_nonzero(np.cumsum(ends)))
    return None if seconds < LEAST else RepeatedDriving(int(owner[origins[0]]), int(owner[copies[0]]), seconds)


def without_repeats(robot: Robot, trajectories: Sequence[Trajectory]) -> tuple[tuple[Trajectory, ...], int]:
    """Return the trajectories without those that repeat an earlier one, and how many are left out.

    For steps that belong together, such as those of a log or an environment: an actor that begins again with the same
    seeds drives the same episodes.
    """
    unique = {(t.states.tobytes(), t.inputs.tobytes()): t for t in reversed(trajectories)}
    distinct = list(reversed(unique.values()))
    while (twice := repeated_driving(robot, distinct)) is not None:  # a part of an episode
        del distinct[twice.second]
    return tuple(distinct), len(trajectories) - len(distinct)


def _chains(trajectories: Sequence[Trajectory]) -> NDArray[np.intp]:
    """Number the trajectories (T,); one that begins where the one before it ends has the same number."""
    goes_on = [np.array_equal(one.states[-1], two.states[0]) for one, two in pairwise(trajectories)]
    return np.cumsum([0, *(not on for on in goes_on)])


def _turned_once(robot: Robot, states: Array) -> Array:
    """Return states (T, n) with the heading in [0, 2 pi): an unwrapped heading depends on the driving before."""
    if robot.heading is None:
        return states
    states = states.copy()
    states[:, robot.heading] %= 2.0 * np.pi
    return states


def _rounded(parts: Sequence[Array]) -> list[Array]:
    """Return arrays (T, n) of one quantity with `DIGITS` digits after the largest value of each column."""
    largest = np.max([np.abs(part).max(0) for part in parts], axis=0)
    largest[largest <= 0.0] = 1.0
    return [np.round(part / largest, DIGITS) for part in parts]


def _window_values(words: Words, length: int) -> Words:
    """Return a hash of each window of `length` rows."""
    draw = np.random.default_rng(0)
    factors = draw.integers(0, 2**63, words.shape[1], np.uint64) * np.uint64(2) + np.uint64(1)
    row = (words * factors).sum(1, dtype=np.uint64)
    row = (row ^ (row >> np.uint64(29))) * factors[0]
    row ^= row >> np.uint64(32)
    count = len(row) - length + 1
    window = np.zeros(count, np.uint64)
    for k in range(length):
        window = window * factors[-1] + row[k : k + count]
    return window
