"""Measure what a data set covers of a robot's inputs and states, and advise what to record next."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brakeline.deploy.data.certification import HELD_OUT, MAX_INFLATION
from brakeline.deploy.data.input_response import followed_inputs
from brakeline.deploy.data.sources.quantity_names import column_names
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.stated_share import percent
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.driving_kinds import at_bound
from brakeline.safety.model.error_causes import AFTER, BOTH, FAST, PATH, REGIMES, STANDING, TURNING, ViolationGroup
from brakeline.safety.model.fitting import FEWEST_STOPS
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, ModelConfig
from brakeline.safety.model.stated_bound import plans_needed
from brakeline.safety.model.turning_in_place import standing_limits
from brakeline.safety.model.validation import ValidationReport, upper_bound
from brakeline.safety.model.windows import FREE, PLAN, resting_periods_at_end, stopping_distances, windows

NEAR = 0.05  # share of an input's range: values this close to a bound count as at the bound
FEWEST_CRUISES = plans_needed(0.1)  # plans of a kind that, without a violation, bound its share outside by 10 %
MOST_SHOWN = 3  # groups of violations in a message
VAGUE = 0.25  # of a plan's way: a wider tube shows that the model predicts little
TOO_FAST = 3.0  # times as far as its follower: an input that jumps farther in a period
MOST_PLANS = 10**6  # largest number of plans that advice asks for


@dataclass(frozen=True)
class ValueRange:
    """The range of an input, or of a coordinate that follows one, with the bounds of the input, in `unit`.

    low, high: bounds of the description; least, most: smallest and largest value in the data.
    """

    name: str
    unit: str
    low: float
    high: float
    least: float
    most: float

    @property
    def share(self) -> float:
        """Return the covered share of the range between the bounds, in [0, 1]."""
        inside = min(self.most, self.high) - max(self.least, self.low)
        return max(inside, 0.0) / (self.high - self.low)


@dataclass(frozen=True)
class Coverage:
    """What a data set covers. `missing` lists in words what to record next."""

    seen: tuple[ValueRange, ...]
    stops: int  # long enough to measure the remaining motion after a stop
    plans: int  # plan windows of the whole horizon
    windows: int  # free windows
    missing: tuple[str, ...]

    @property
    def refused(self) -> str:
        """Return the reason why no model set can be built from the data, or an empty string."""
        return "" if self.stops >= FEWEST_STOPS else self.missing[0]


def coverage(data: Dataset) -> Coverage:
    """Measure the coverage of a data set."""
    robot = data.robot
    names, inputs = column_names(robot)
    driven, states = (np.concatenate([getattr(t, part) for t in data.trajectories]) for part in ("inputs", "states"))
    bounds = list(zip(robot.action_low, robot.action_high, strict=True))
    units = [split_label(label)[1] for label in robot.action]
    seen = [_seen(name, units[i], *bounds[i], driven[:, i]) for i, name in enumerate(inputs)]
    followers = [
        _seen(names[k], split_label(robot.state[k])[1], *bounds[i], states[:, k]) for i, k in followed_inputs(robot)
    ]
    rested = resting_periods_at_end(robot)
    stops = sum(len(stopping_distances(robot, t, rested)) for t in data.trajectories)
    begun = _begun(data)
    at_rest = [i for i, zero in enumerate(robot.zero_at_rest) if zero and len(begun)]
    braked = [_seen(inputs[i], units[i], *bounds[i], begun[:, i]) for i in at_rest]
    plans, free = (len(windows(data, robot.horizon, kind)) for kind in (PLAN, FREE))
    missing = _stops_missing(robot, stops, rested)
    missing += [text for one in seen for text in _unreached_bounds(one)]
    missing += [text for one in braked for text in _unbraked_ranges(one)]
    few = _windows_missing(plans, free, linear=bool(robot.feedback))
    missing += few or _plans_missing(data)
    return Coverage((*seen, *followers), stops, plans, free, tuple(missing))


def _seen(name: str, unit: str, low: float, high: float, values: Array) -> ValueRange:
    return ValueRange(name, unit, low, high, float(values.min()), float(values.max()))


def _begun(data: Dataset) -> Array:
    """Return the strongest inputs (stops, m) in the `brake_steps` periods before each stop."""
    robot = data.robot
    strongest = []
    for t in data.trajectories:
        before = np.zeros(robot.action_dim) if t.before is None else t.before
        inputs = np.vstack([before, t.inputs])
        rests = robot.is_stop_input(inputs)
        for i in np.flatnonzero(rests[1:] & ~rests[:-1]):
            last = inputs[max(i + 1 - max(robot.brake_steps, 1), 0) : i + 1]
            strongest.append(last[np.abs(last).argmax(0), np.arange(robot.action_dim)])
    return np.array(strongest).reshape(-1, robot.action_dim)


def _stops_missing(robot: Robot, stops: int, rested: int) -> list[str]:
    if stops >= FEWEST_STOPS:
        return []
    seconds = (rested + 2) * robot.period
    zero = " and ".join(
        name for name, is_zero in zip(column_names(robot)[1], robot.zero_at_rest, strict=True) if is_zero
    )
    return [
        f"{'no stops' if not stops else f'only {stops} stops'}, but at least {FEWEST_STOPS} are needed: from various "
        f"speeds, set {zero} to zero and let the robot stand for {seconds:.1f} s or more; repeat this "
        f"{2 * FEWEST_STOPS} times or more"
    ]


def _unreached_bounds(one: ValueRange) -> list[str]:
    room = NEAR * (one.high - one.low)
    above = f"{one.name} never above {one.most:.3g} {one.unit} (bound {one.high:g}): record this"
    below = f"{one.name} never below {one.least:.3g} {one.unit} (bound {one.low:g}): record this"
    return [above] * (one.most < one.high - room) + [below] * (one.least > one.low + room)


def _unbraked_ranges(one: ValueRange) -> list[str]:
    room = 0.25 * (one.high - one.low)
    above = f"no braking above {max(one.most, 0.0):.2g} {one.unit} of {one.name}: record this"
    below = f"no braking below {min(one.least, 0.0):.2g} {one.unit} of {one.name}: record this"
    return [above] * (one.most < one.high - room) + [below] * (one.low < 0.0 and one.least > one.low + room)


def _windows_missing(plans: int, free: int, linear: bool) -> list[str]:
    """Return what is missing. linear: `certify` fits a linear mode by default, for which plan windows are better."""
    enough = math.ceil(ModelConfig().fewest / (1.0 - HELD_OUT))
    if free < enough:
        return [f"only {free} windows of a plan's length, but about {enough} are needed: record more"]
    if linear and plans < enough:
        return [
            f"only {plans} windows brake as the filter's plans do; with about {enough} the sets become narrower than "
            "with free windows: hold an input for one period, then stop by the description's rules"
        ]
    return []


def _plans_missing(data: Dataset) -> list[str]:
    """Return what is missing if so few plans cannot state the robot's limit, even with none of them outside."""
    robot = data.robot
    limit, wanted = robot.accept_bound, plans_needed(robot.accept_bound)
    plans = sum(len(t.inputs) // robot.horizon for t in data.joined().trajectories)
    if not 0 < plans < wanted or robot.feedback:  # a robot that stops by feedback has linear model sets
        return []
    more = math.ceil(data.periods * robot.period / 60.0 * (wanted / plans - 1.0))
    return [
        f"at most {plans} plans of {robot.horizon} periods that do not overlap, so a model set states that at most "
        f"{percent(upper_bound(0, plans))} of plans leave their tubes, or more, and the limit is {percent(limit)}: "
        f"record {more} more minute{'s' * (more > 1)} like these, or write a larger `accept_bound` into the description"
    ]


def recording_advice(report: ValidationReport, data: Dataset) -> list[str]:
    """Return advice, in sentences, on what to record.

    With these data, the bound is within the robot's limit, turns on the spot have bounds of their own, and much is
    known of a policy that keeps an input at its bound. The list is empty if all this is so already.
    """
    robot = data.robot
    missing = _relation_missing(report, data) + _turns_missing(report, robot) + _cruises_missing(report, robot)
    return missing + _too_loose(report, data)


def _relation_missing(report: ValidationReport, data: Dataset) -> list[str]:
    """Return advice if a learned period predicts little of a plan: columns, stamps or the description are wrong."""
    horizon, d = data.robot.horizon, data.robot.position_dim
    ways = [np.linalg.norm(t.states[horizon:, :d] - t.states[:-horizon, :d], axis=1) for t in data.trajectories]
    way = float(np.quantile(np.concatenate(ways), 0.99)) if d and any(map(len, ways)) else 0.0
    if report.mode != ONE_STEP or report.unit != "m":
        return []
    faster = _faster_inputs(data)
    if report.half_width_full <= (0.5 if faster else 1.0) * VAGUE * way:
        return []
    return [
        f"a clear relation between inputs and motion: where the robot stops from full speed is known only to "
        f"±{report.half_width_full:.2g} m, and a plan is {way:.2g} m long. Look for a wrong column, sign or time stamp "
        "in the log, for a state that the description lacks, and for a delay of more than one period" + faster
    ]


def _faster_inputs(data: Dataset) -> str:
    """Return more advice if inputs jump much farther in a period than the coordinates that follow them move."""
    inputs, states = column_names(data.robot)[1], data.robot.state
    seen = []
    for i, follower in followed_inputs(data.robot):
        jump = max(np.abs(np.diff(t.inputs[:, i])).max(initial=0.0) for t in data.trajectories)
        move = np.quantile(np.concatenate([np.abs(np.diff(t.states[:, follower])) for t in data.trajectories]), 0.99)
        if jump > TOO_FAST * move > 0.0:
            name, unit = split_label(states[follower])
            moves = f"the measured {name} by {move:.2g} {unit}"
            seen.append(f"the input {inputs[i]} jumps by {jump:.2g} {unit} in a period, {moves}")
    if not seen:
        return ""
    return (
        f". Or the robot limits its acceleration ({'; '.join(seen)}): then record driving whose inputs change no "
        "faster than the robot, and write these changes as `slew` into the description"
    )


def _turns_missing(report: ValidationReport, robot: Robot) -> list[str]:
    if report.mode != DIRECT or report.in_place_windows or standing_limits(robot) is None:
        return []
    return [
        "too few turns on the spot to bound them separately, so the filter keeps far away from obstacles: let the "
        f"robot stand, then turn at various rates, each for {robot.horizon * robot.period:.1f} s or more"
    ]


def _cruises_missing(report: ValidationReport, robot: Robot) -> list[str]:
    """Return advice on inputs that few plans of the data hold at their bounds, as trained policies do."""
    plans = {group.name: group.plans for group in report.groups}
    rare = [(name, plans.get(name, 0)) for name in at_bound(robot) if plans.get(name, 0) < FEWEST_CRUISES]
    if not report.groups or not rare:
        return []
    seen = " and ".join(f"{number} plans with {name}" for name, number in rare)
    return [
        f"only {seen} (of {report.windows} plans), so little is known of a policy that drives like that, as trained "
        f"ones do: hold the input there, until there are {FEWEST_CRUISES} such plans, or lower its bound"
    ]


def _too_loose(report: ValidationReport, data: Dataset) -> list[str]:
    """Return advice on a bound above the limit.

    More data of the same kind help only if the share of held-out plans that leave their sets is below the limit.
    """
    limit, plans, violations = data.robot.accept_bound, report.windows, report.violations
    if report.bound_plan <= limit:
        return []
    bound = percent(report.bound_plan)
    bounded = f"at most {bound} of plans leave their sets (99 % confidence), and the limit is {percent(limit)}"
    wanted = _plans_for(violations, plans, limit)
    minutes = data.periods * data.robot.period / 60.0
    more = math.ceil(minutes * (wanted / plans - 1.0)) if plans and wanted is not None else 0
    if not violations:
        how = f": record {more} more minute{'s' * (more > 1)} like these" if plans else ""
        return [
            f"{bounded}; to state the limit, {wanted} held-out plans without a violation are needed, and there are "
            f"{plans}{how}"
        ]
    share = f"{violations / plans:.1%}"
    leaving = report.leaving or _kinds_left(report)
    driving = dict.fromkeys(one.regime for one in leaving if one.part not in ABOUT_PARTS)
    parts = {one.part for one in leaving}
    wider = (
        "`certify` with a smaller --outside lets fewer of the plans leave them, except those with jumping inputs"
        if report.mode == ONE_STEP
        else f"`certify --until-held` widens each error bound {report.excess:.2g} times, so that none of "
        f"the {plans} plans leaves its set. It then states at most {percent(upper_bound(0, plans))}. With "
        f"{plans_needed(limit)} or more held-out plans `certify` widens them by itself, at most {MAX_INFLATION} times"
    )
    return [
        f"{bounded}; {violations} of {plans} held-out plans ({share}) left their sets: {_where(leaving)}",
        f"more minutes like these do not help: the share of {share} is above the limit of {percent(limit)}"
        if wanted is None
        else f"{more} more minutes like these, {wanted} held-out plans, reach the limit only if at most "
        f"{share} of them leave their sets",
        *(f"{regime}: {_remedy(data.robot, regime)}" for regime in driving),
        *(text for part, text in ABOUT_PARTS.items() if part in parts),
        f"or wider sets: {wider}",
    ]


ABOUT_PARTS = {
    PATH: f"{PATH}: log positions more than once per period, or (Gymnasium) set `chord_deviation`",
    AFTER: f"{AFTER}: stand longer after each stop, or brake for more periods (`plan.brake`, `plan.horizon`)",
}


def _plans_for(violations: int, plans: int, limit: float) -> int | None:
    """Return how many held-out plans state the limit at the same share of violations; None if no number does."""
    if not violations:
        return plans_needed(limit)
    share = violations / plans
    if share >= limit or upper_bound(math.ceil(share * MOST_PLANS), MOST_PLANS) > limit:
        return None
    return (
        plans
        + 1
        + bisect_left(range(plans + 1, MOST_PLANS), True, key=lambda n: upper_bound(math.ceil(share * n), n) <= limit)
    )


def _kinds_left(report: ValidationReport) -> tuple[ViolationGroup, ...]:
    """Return the violations of mode one-step, which knows the regime of each plan, not the part outside."""
    left = (g for g in report.groups if g.name in REGIMES and g.violations)
    return tuple(ViolationGroup("", g.name, g.violations, g.plans, g.excess) for g in left)


def _where(leaving: Sequence[ViolationGroup]) -> str:
    """Describe the largest groups of violations, each with the number of plans in its regime."""
    shown = [
        f"{one.plans}{f' by {one.part}' if one.part else ''} while {one.regime} (of {one.of} such plans; errors up to "
        f"{one.excess:.2g} × their bound)"
        for one in leaving[:MOST_SHOWN]
    ]
    rest = sum(one.plans for one in leaving[MOST_SHOWN:])
    return ", ".join(shown + ([f"{rest} elsewhere"] if rest else []))


def _remedy(robot: Robot, regime: str) -> str:
    """Return what to record, or which bounds to lower, if plans left their sets in this regime."""
    inputs = [split_label(label)[0] for label in robot.action]
    moving, turning = (
        " and ".join(name for name, moves in zip(inputs, robot.translates, strict=True) if moves == wanted)
        for wanted in (True, False)
    )
    remedies = {
        STANDING: "record standing between drives and after every stop (with wind, estimator drift)",
        TURNING: f"record more turning on the spot and at low speed, or lower the bounds of {turning}",
        FAST: f"record more driving above half of top speed and changes of direction, or lower the bounds of {moving}",
        BOTH: f"record more turning at speed, or lower the bounds of {moving} or {turning}",
    }
    return remedies.get(regime, "record more slow driving, with starts and stops")


def draw_coverage(data: Dataset, covered: Coverage, path: Path) -> None:
    """Plot the driven paths, and each input against its follower with its bounds, into the image `path`.

    In joint space, there is the second coordinate against the first one; a single coordinate is drawn over the time.
    """
    from matplotlib.figure import Figure

    robot = data.robot
    inputs = column_names(robot)[1]
    panels = 1 + robot.action_dim
    figure = Figure(figsize=(4.2 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels)
    for t in data.trajectories:
        along = [robot.period * np.arange(len(t.states)), *t.states.T]
        axes[0].plot(*(along[1:3] if robot.state_dim > 1 else along), linewidth=0.7)
    if robot.position_dim:
        axes[0].set_aspect("equal", adjustable="datalim")
    names = robot.state[:2] if robot.state_dim > 1 else ("time [s]", robot.state[0])
    axes[0].set(xlabel=names[0], ylabel=names[1])
    for i, ax in enumerate(axes[1:]):
        follower = robot.follows[i]
        driven = np.concatenate([t.inputs[:, i] for t in data.trajectories])
        if follower >= 0:
            moved = np.concatenate([t.states[1:, follower] for t in data.trajectories])
            ax.plot(driven, moved, ".", markersize=2, alpha=0.4)
            ax.set_ylabel(f"{robot.state[follower]}, one period later")
        else:
            ax.hist(driven, bins=40)
            ax.set_ylabel("periods")
        for bound in (robot.action_low[i], robot.action_high[i]):
            ax.axvline(bound, color="k", linewidth=0.8, linestyle="--")
        ax.set_xlabel(f"{inputs[i]} [{split_label(robot.action[i])[1]}]")
    title = f"{robot.name}: {data.periods} periods, {covered.stops} stops"
    figure.suptitle("\n".join([title, *(f"missing: {text}" for text in covered.missing[:4])]), fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
