"""What a data set shows of a robot, and, in words, what is still to be driven."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.deploy.data.certification import HELD_OUT, MAX_INFLATION
from brakeline.deploy.data.sources.quantity_names import column_names, split
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.stated_share import percent
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.error_causes import AFTER, BOTH, FAST, PATH, STANDING, TURNING
from brakeline.safety.model.fitting import FEWEST_STOPS
from brakeline.safety.model.model_set import DIRECT, ModelConfig
from brakeline.safety.model.stated_bound import plans_needed
from brakeline.safety.model.turning_in_place import standing_limits
from brakeline.safety.model.validation import ValidationReport, upper_bound
from brakeline.safety.model.windows import FREE, PLAN, resting_periods_at_end, stopping_distances, windows

NEAR = 0.05  # of its range: an input this near to a bound has been there
MOST_SHOWN = 3  # groups of violations
MOST_PLANS = 10**6  # beyond it nobody records
FEWEST = 20  # periods beyond an eighth of the range: below it nothing was seen there


@dataclass(frozen=True)
class ValueRange:
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
    seen: tuple[ValueRange, ...]
    stops: int  # that are long enough to tell what is still travelled after one
    braked_from: tuple[ValueRange, ...]  # inputs in force when a stop began
    plans: int  # plan windows of the whole horizon
    windows: int  # free ones
    missing: tuple[str, ...]

    @property
    def refused(self) -> str:
        """Why no model set at all can be made of it; empty if one may."""
        return "" if self.stops >= FEWEST_STOPS else self.missing[0]


def coverage(data: Dataset) -> Coverage:
    robot = data.robot
    names, inputs = column_names(robot)
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
    rested = resting_periods_at_end(robot)
    stops = sum(len(stopping_distances(robot, t, rested)) for t in data.trajectories)
    begun = _begun(data)
    braked = [
        _seen(name, robot.action[i], robot.action_low[i], robot.action_high[i], begun[:, i])
        for i, name in enumerate(inputs)
        if robot.zero_at_rest[i] and len(begun)
    ]
    missing = _stops_missing(robot, stops, rested)
    missing += [text for one in seen[: len(inputs)] for text in _never(one)]
    missing += [text for one in braked for text in _no_braking(one)]
    plans, free = (len(windows(data, robot.horizon, kind)) for kind in (PLAN, FREE))
    missing += _windows_missing(plans, free)
    return Coverage(tuple(seen), stops, tuple(braked), plans, free, tuple(missing))


def _seen(name: str, label: str, low: float, high: float, values: Array) -> ValueRange:
    return ValueRange(name, split(label)[1], low, high, float(values.min()), float(values.max()))


def _begun(data: Dataset) -> Array:
    """For each stop the strongest inputs in the time that a plan brakes for, before they were zero: (stops, m)."""
    robot = data.robot
    found = []
    for t in data.trajectories:
        before = np.zeros(robot.action_dim) if t.before is None else t.before
        inputs = np.vstack([before, t.inputs])
        rests = robot.is_stop_input(inputs)
        for i in np.flatnonzero(rests[1:] & ~rests[:-1]):
            last = inputs[max(i + 1 - max(robot.brake_steps, 1), 0) : i + 1]
            found.append(last[np.abs(last).argmax(0), np.arange(robot.action_dim)])
    return np.array(found).reshape(-1, robot.action_dim)


def _stops_missing(robot: Robot, stops: int, rested: int) -> list[str]:
    if stops >= FEWEST_STOPS:
        return []
    seconds = (rested + 2) * robot.period
    zero = " and ".join(
        name for name, is_zero in zip(column_names(robot)[1], robot.zero_at_rest, strict=True) if is_zero
    )
    return [
        f"{'no stops' if not stops else f'only {stops} stops'}, at least {FEWEST_STOPS} are needed: from every speed "
        f"give zero {zero} and let the robot stand for {seconds:.1f} s or more, {2 * FEWEST_STOPS} times or more"
    ]


def _never(one: ValueRange) -> list[str]:
    found = []
    room = NEAR * (one.high - one.low)
    if one.most < one.high - room:
        found.append(f"{one.name} never above {one.most:.3g} {one.unit} (bound {one.high:g}): drive this")
    if one.least > one.low + room:
        found.append(f"{one.name} never below {one.least:.3g} {one.unit} (bound {one.low:g}): drive this")
    return found


def _no_braking(one: ValueRange) -> list[str]:
    found = []
    room = 0.25 * (one.high - one.low)
    if one.most < one.high - room:
        found.append(f"no braking above {max(one.most, 0.0):.2g} {one.unit} of {one.name}: drive this")
    if one.low < 0.0 and one.least > one.low + room:
        found.append(f"no braking below {min(one.least, 0.0):.2g} {one.unit} of {one.name}: drive this")
    return found


def _windows_missing(plans: int, free: int) -> list[str]:
    enough = math.ceil(ModelConfig().fewest / (1.0 - HELD_OUT))
    if free < enough:
        return [f"only {free} windows of a plan's length, about {enough} are needed: drive on"]
    if plans < enough:
        return [
            f"{plans} windows brake as the filter's plans do; about {enough} would make narrower sets than all driving "
            "does: hold an input for a period, then stop by the description's rules"
        ]
    return []


def recording_advice(statement: ValidationReport, data: Dataset) -> list[str]:
    """What to record, or to lower, for the statement to come within the robot's limit, and to turn on the spot near
    obstacles; nothing if it does.
    """
    return _turns_missing(statement, data.robot) + _too_loose(statement, data)


def _turns_missing(statement: ValidationReport, robot: Robot) -> list[str]:
    if statement.mode != DIRECT or statement.in_place_windows or standing_limits(robot) is None:
        return []
    return [
        "too few turns on the spot to bound them apart from driving, so the filter keeps far off obstacles: "
        f"stand, then turn at various rates for {robot.horizon * robot.period:.1f} s or more each"
    ]


def _too_loose(statement: ValidationReport, data: Dataset) -> list[str]:
    """How the bound can come within the robot's limit. More of the same helps only while the share of held-out plans
    that leave their sets is below the limit."""
    limit, plans = data.robot.accept_bound, statement.windows
    if statement.bound_plan <= limit:
        return []
    bound = percent(statement.bound_plan)
    said = f"at most {bound} of plans leave their sets (99 % confidence), and the limit is {percent(limit)}"
    wanted = _plans_for(statement.violations, plans, limit)
    minutes = data.periods * data.robot.period / 60.0
    more = math.inf if not plans or wanted is None else minutes * (wanted / plans - 1.0)
    if not statement.violations:
        how = f": {math.ceil(more)} more minutes like these" if plans else ""
        return [f"{said}; to state that it takes {wanted} held-out plans, none outside, and there are {plans}{how}"]
    share = statement.violations / plans
    left = f"{statement.violations} of {plans} held-out plans ({share:.1%})"
    found = [f"{said}; {left} left their sets: {_where(statement)}"]
    if wanted is None:
        found.append(
            f"more minutes like these do not make fewer plans leave: {share:.1%} is above the limit of {percent(limit)}"
        )
    else:
        found.append(
            f"{math.ceil(more)} more minutes like these, {wanted} held-out plans, reach the limit only if no larger "
            f"share than {share:.1%} of them leaves its sets"
        )
    driving = dict.fromkeys(one.regime for one in statement.leaving if one.part not in ABOUT_PARTS)
    found += [f"{regime}: {_remedy(data.robot, regime)}" for regime in driving]
    parts = {one.part for one in statement.leaving}
    found += [text for part, text in ABOUT_PARTS.items() if part in parts]
    found.append(
        f"or wider sets: `certify --until-held` widens every envelope {statement.excess:.2g} times, so that none of "
        f"the {plans} plans leaves its set, and states at most {percent(upper_bound(0, plans))}; from "
        f"{plans_needed(limit)} held-out plans on `certify` widens them by itself, {MAX_INFLATION} times at most"
    )
    return found


ABOUT_PARTS = {
    PATH: f"{PATH}: log positions more often than once a period, or state the path's bulge",
    AFTER: f"{AFTER}: let it stand longer after each stop, or brake for more periods (`plan.brake`, `plan.horizon`)",
}


def _plans_for(violations: int, plans: int, limit: float) -> int | None:
    """So many held-out plans state the limit if as large a share of them leaves its sets; None: no number does."""
    if not violations:
        return plans_needed(limit)
    share = violations / plans
    if share >= limit:
        return None
    low, high = plans, plans
    while upper_bound(math.ceil(share * high), high) > limit:
        low, high = high, 2 * high
        if high > MOST_PLANS:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if upper_bound(math.ceil(share * middle), middle) > limit else (low, middle)
    return high


def _where(statement: ValidationReport) -> str:
    """Most of the violations, with the regime's own count beside them."""
    shown = [
        f"{one.plans} by {one.part} while {one.regime} (of {one.of} plans there; up to {one.excess:.2g} × its bound)"
        for one in statement.leaving[:MOST_SHOWN]
    ]
    rest = sum(one.plans for one in statement.leaving[MOST_SHOWN:])
    return ", ".join(shown + ([f"{rest} elsewhere"] if rest else []))


def _remedy(robot: Robot, regime: str) -> str:
    """What to record more of, or which bounds to lower, where plans left their sets while it drove so."""
    inputs = [split(label)[0] for label in robot.action]
    moving, turning = (
        " and ".join(name for name, moves in zip(inputs, robot.translates, strict=True) if moves == wanted)
        for wanted in (True, False)
    )
    if regime == STANDING:
        return "let it stand between drives and after every stop, with what moves it then (wind, its own estimate)"
    if regime == TURNING:
        return f"record more turning on the spot and at low speed, or lower the bounds of {turning}"
    if regime == FAST:
        return (
            f"record more driving above half of its speed, with changes of direction, or lower the bounds of {moving}"
        )
    if regime == BOTH:
        return f"record more turning at speed, or lower the bounds of {moving} or {turning}"
    return "record more slow driving, with starts and stops"
