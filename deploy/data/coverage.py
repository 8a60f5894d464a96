"""What a data set shows of a robot, and, in words, what is still to be driven."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from deploy.data.certified import HELD_OUT
from deploy.data.sources.quantities import columns_of, split
from messaging.robots import Array, Robot
from safety.dataset import Dataset
from safety.fitting import FEWEST_STOPS
from safety.in_place import standing_limits
from safety.model_set import DIRECT, Recipe
from safety.statement import CONFIDENCE, Statement
from safety.windows import FREE, PLAN, standing_at_the_end, stops_of, windows

NEAR = 0.05  # of its range: an input this near to a bound has been there
AIMED = 0.01  # share of plans outside their sets that is to be excluded, with the statement's confidence
FEWEST = 20  # periods beyond an eighth of the range: below it nothing was seen there


@dataclass(frozen=True)
class Seen:
    """Of an input, or of a coordinate that comes to one: least and most, against its bounds, in its unit."""

    name: str
    unit: str
    low: float
    high: float
    least: float
    most: float

    @property
    def share(self) -> float:
        """Of the range between the bounds."""
        inside = min(self.most, self.high) - max(self.least, self.low)
        return max(inside, 0.0) / (self.high - self.low)


@dataclass(frozen=True)
class Coverage:
    seen: tuple[Seen, ...]
    stops: int  # that are long enough to tell what is still travelled after one
    braked_from: tuple[Seen, ...]  # inputs in force when a stop began
    plans: int  # plan windows of the whole horizon
    windows: int  # free ones
    missing: tuple[str, ...]

    @property
    def refused(self) -> str:
        """Why no model set at all can be made of it; empty if one may."""
        return "" if self.stops >= FEWEST_STOPS else self.missing[0]


def coverage(data: Dataset) -> Coverage:
    robot = data.robot
    names, inputs = columns_of(robot)
    driven = np.concatenate([t.inputs for t in data.trajectories])
    states = np.concatenate([t.states for t in data.trajectories])
    seen = [
        _seen(name, robot.action[i], robot.action_low[i], robot.action_high[i], driven[:, i])
        for i, name in enumerate(inputs)
    ]
    seen += [
        _seen(names[k], robot.state[k], robot.action_low[i], robot.action_high[i], states[:, k])
        for i, k in enumerate(robot.follows)
        if k >= 0
    ]
    rested = standing_at_the_end(robot)
    stops = sum(len(stops_of(robot, t, rested)) for t in data.trajectories)
    begun = _begun(data)
    braked = [
        _seen(name, robot.action[i], robot.action_low[i], robot.action_high[i], begun[:, i])
        for i, name in enumerate(inputs)
        if robot.stopping[i] and len(begun)
    ]
    missing = _stops_missing(robot, stops, rested)
    missing += [text for one in seen[: len(inputs)] for text in _never(one)]
    missing += [text for one in braked for text in _no_braking(one)]
    plans, free = (len(windows(data, robot.horizon, kind)) for kind in (PLAN, FREE))
    missing += _windows_missing(plans, free)
    return Coverage(tuple(seen), stops, tuple(braked), plans, free, tuple(missing))


def _seen(name: str, label: str, low: float, high: float, values: Array) -> Seen:
    return Seen(name, split(label)[1], low, high, float(values.min()), float(values.max()))


def _begun(data: Dataset) -> Array:
    """For each stop the strongest inputs in the time that a plan brakes for, before they were zero: (stops, m)."""
    robot = data.robot
    found = []
    for t in data.trajectories:
        before = np.zeros(robot.action_dim) if t.before is None else t.before
        inputs = np.vstack([before, t.inputs])
        rests = robot.rests(inputs)
        for i in np.flatnonzero(rests[1:] & ~rests[:-1]):
            last = inputs[max(i + 1 - max(robot.brake_steps, 1), 0) : i + 1]
            found.append(last[np.abs(last).argmax(0), np.arange(robot.action_dim)])
    return np.array(found).reshape(-1, robot.action_dim)


def _stops_missing(robot: Robot, stops: int, rested: int) -> list[str]:
    if stops >= FEWEST_STOPS:
        return []
    seconds = (rested + 2) * robot.period
    zero = " and ".join(name for name, is_zero in zip(columns_of(robot)[1], robot.stopping, strict=True) if is_zero)
    return [
        f"{'no stops' if not stops else f'only {stops} stops'}, at least {FEWEST_STOPS} are needed: from every speed "
        f"give zero {zero} and let the robot stand for {seconds:.1f} s or more, {2 * FEWEST_STOPS} times or more"
    ]


def _never(one: Seen) -> list[str]:
    found = []
    room = NEAR * (one.high - one.low)
    if one.most < one.high - room:
        found.append(f"{one.name} never above {one.most:.3g} {one.unit} (bound {one.high:g}): drive this")
    if one.least > one.low + room:
        found.append(f"{one.name} never below {one.least:.3g} {one.unit} (bound {one.low:g}): drive this")
    return found


def _no_braking(one: Seen) -> list[str]:
    found = []
    room = 0.25 * (one.high - one.low)
    if one.most < one.high - room:
        found.append(f"no braking above {max(one.most, 0.0):.2g} {one.unit} of {one.name}: drive this")
    if one.low < 0.0 and one.least > one.low + room:
        found.append(f"no braking below {min(one.least, 0.0):.2g} {one.unit} of {one.name}: drive this")
    return found


def _windows_missing(plans: int, free: int) -> list[str]:
    enough = math.ceil(Recipe().fewest / (1.0 - HELD_OUT))
    if free < enough:
        return [f"only {free} windows of a plan's length, about {enough} are needed: drive on"]
    if plans < enough:
        return [
            f"{plans} windows brake as the filter's plans do; about {enough} would make narrower sets than all driving "
            "does: hold an input for a period, then stop by the description's rules"
        ]
    return []


def more_to_drive(statement: Statement, data: Dataset) -> list[str]:
    """What a statement can't say yet, and how much more driving like this it takes."""
    turns = []
    if statement.mode == DIRECT and not statement.in_place_windows and standing_limits(data.robot) is not None:
        turns = [
            "too few turns on the spot to bound them apart from driving, so the filter keeps far off obstacles: "
            f"stand, then turn at various rates for {data.robot.horizon * data.robot.period:.1f} s or more each"
        ]
    if statement.bound_plan <= AIMED:
        return turns
    wanted = math.ceil(math.log(1.0 - CONFIDENCE) / math.log(1.0 - AIMED))
    minutes = data.periods * data.robot.period / 60.0 * (wanted / max(statement.windows, 1) - 1.0)
    return [
        *turns,
        f"at most {statement.bound_plan:.1%} of plans leave their sets (99 % confidence); to say {AIMED:.0%} it takes "
        f"{wanted} held-out plans without one, {max(minutes, 0.0):.0f} more minutes like these",
    ]
