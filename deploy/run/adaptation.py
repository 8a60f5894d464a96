"""Certify a robot again while it drives, when it is no longer the robot that was recorded (docs/method.md §15).

`Adaptation` hears the steps and exchanges of all robots of one kind. It keeps the recent ones in memory, so it needs no
log. It decides when to fit a new model set, on which driving, and whether the result may replace the one in use.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from brakeline.deploy.data.certification import certify, certify_update
from brakeline.deploy.data.run_dataset import runs_of, trajectories_of
from brakeline.errors import BadData, BadModel, BadStep, ErrorBoundError, Implausible
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import about_age
from brakeline.messaging.robot import Robot
from brakeline.messaging.stated_share import percent
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.widening import CHANGED, RESERVE
from brakeline.safety.model.calibration_samples import FOLDS
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ONE_STEP, ModelConfig, ModelSet
from brakeline.safety.model.repeated_driving import without_repeats
from brakeline.safety.model.set_shape import plans_from
from brakeline.safety.model.stated_bound import accepted_bound, plans_needed, refusal
from brakeline.safety.model.validation import ValidationReport, most_violations
from brakeline.safety.model.windows import FREE, PLAN, recorded_domain, windows

REQUESTS = 100  # in so many requests without a break, a changed robot asked for a widening above `CHANGED`
FEWEST_MINUTES = 4.0  # of driving after the change
AGAIN = 15.0  # minutes of driving after which a model set may be replaced without a change
MEMORY = 20.0  # minutes of driving, of all robots of the kind together
PAUSE = 1.0  # minutes of driving from one attempt to the next
SPARE = 1.2  # factor on the driving that the accepted bound needs: windows must not cross the ends of trajectories
TIGHTER = 0.9  # largest ratio of the new half-widths to the widened ones in use
# Least ratio of a range of the recent driving to that of the set in use. A fit knows its range, and the filter keeps
# the robot within it. An update keeps the range of the set in use.
FITTED, UPDATED = 0.5, 0.75
# In `about` of a fit to less than `UPDATED`, and of all sets after it: the speed or input that the fit covered least.
NARROWER = "narrower"
MOST_ROBOTS = 10_000
WAITING = "waiting"  # the first word of `Adaptation.progress`
SILENT = 30.0  # s after which a robot counts as gone


@dataclass(frozen=True, order=True)
class DrivenPeriod:
    """The place of a period in the driving of one robot: steps of later periods are not less."""

    run: int
    episode: int
    step: int


@dataclass
class RobotState:
    """What the requests of one robot say.

    Attributes:
        version: model set of the last decision.
        since: first period under this version.
        widened: first period of the requests that were widened without a break up to now; None: the last one was not.
            Once the robot has changed, a request counts as long as it asks for more than the stated sets.
        requests: number of these requests.
        widening: of the last request.
        arrived: when its last exchange arrived [s].
    """

    version: str
    since: DrivenPeriod
    widened: DrivenPeriod | None = None
    requests: int = 0
    widening: float = 1.0
    arrived: float = 0.0

    @property
    def changed(self) -> bool:
        """Whether the robot has used more than its sets for long."""
        return self.requests >= REQUESTS


@dataclass(frozen=True)
class Recertification:
    """The result of an attempt.

    Attributes:
        text: why the model set is published, or why there is none.
        model: the model set to publish; None if it may not be used.
        data: the data whose domain it has; None if it has that of the set in use, as an update does.
        replaces: version of the set in use with which it was compared.
    """

    text: str
    model: ModelSet | None = None
    data: Dataset | None = None
    replaces: str = ""


@dataclass
class Adaptation:
    """The recent driving of all robots of one kind.

    Attributes:
        robot: the robot kind, with its description of today.
        in_use: returns the model set of a version that decided. Raises BadModel if it is not known.
        accept_bound: largest accepted bound; by default the limit in the robot's description.
    """

    robot: Robot
    in_use: Callable[[str], ModelSet]
    accept_bound: float | None = None
    _steps: deque[pb.Step] = field(init=False)
    _robots: dict[str, RobotState] = field(default_factory=dict)
    _driven: int = 0  # periods since the last attempt

    def __post_init__(self) -> None:
        self._steps = deque(maxlen=max(self._periods(MEMORY), math.ceil(1.5 * self.needed)))
        self._driven = self._periods(PAUSE)

    def _periods(self, minutes: float) -> int:
        return math.ceil(60.0 * minutes / self.robot.period)

    def _minutes(self, periods: int) -> float:
        return periods * self.robot.period / 60.0

    @property
    def plans_needed(self) -> int:
        """Plans that do not overlap from which a model set can state the accepted bound; the folds cut a few."""
        return plans_needed(accepted_bound(self.robot, self.accept_bound)) + FOLDS

    @property
    def needed(self) -> int:
        """Periods of driving from which a model set can state the accepted bound, about."""
        return max(self._periods(FEWEST_MINUTES), math.ceil(SPARE * self.plans_needed * self.robot.horizon))

    def step(self, step: pb.Step) -> None:
        """Add a step, without the fields that no data set needs. Raises BadStep."""
        robot = self.robot
        sizes = len(step.state), len(step.action), len(step.path) % robot.position_dim
        if sizes != (robot.state_dim, robot.action_dim, 0) or not step.path:
            raise BadStep("state, action, path", f"of another size than those of {robot.name}")
        if not np.isfinite([*step.state, *step.action, *step.path, step.turned]).all():
            raise BadStep("state, action, path", "NaN or infinity")
        step.ClearField("observation")
        step.ClearField("next_observation")
        step.ClearField("proposed")
        self._steps.append(step)
        self._driven += 1

    def exchange(self, exchange: pb.Exchange, arrived: float) -> None:
        """Add an exchange with the safety service; one without a decision names no version, and is left out.

        Raises Implausible if there are too many robots.

        arrived: when it arrived [s], by a clock of this process. The clocks of other machines may differ by hours.
        """
        if not exchange.reply.HasField("decision"):
            return
        request, decision = exchange.request, exchange.reply.decision
        now = DrivenPeriod(exchange.header.run, request.episode, request.step)
        state = self._robots.get(request.actor)
        if state is None or state.since.run != now.run:
            if state is None and len(self._robots) >= MOST_ROBOTS:
                self._robots = self._driving_robots()  # those that are gone make room
                if len(self._robots) >= MOST_ROBOTS:
                    raise Implausible(f"{request.actor} is rejected: there are already {MOST_ROBOTS} robots")
            state = self._robots[request.actor] = RobotState(decision.model, now)
        elif decision.model != state.version:
            state.version, state.since = decision.model, now
        state.widening, state.arrived = (request.widening if 1.0 <= request.widening < math.inf else 1.0), arrived
        if state.widening > (RESERVE if state.changed else CHANGED):
            state.widened, state.requests = state.widened or now, state.requests + 1
        else:
            state.widened, state.requests = None, 0

    @property
    def version(self) -> str:
        """The model set of the latest decision."""
        return max(self._driving_robots().values(), key=lambda state: state.arrived).version

    @property
    def widening(self) -> float:
        """The least widening of the robots. A model set is for all of them."""
        return min((state.widening for state in self._driving_robots().values()), default=1.0)

    @property
    def since_change(self) -> float:
        """Minutes of driving since all robots have changed; 0 if one of them has not."""
        return self._minutes(len(self._since_change())) if self._changed() else 0.0

    @property
    def plans_since_change(self) -> int:
        """Plans that do not overlap since all robots have changed; 0 if one of them has not."""
        return self._plans(self._since_change()) if self._changed() else 0

    @property
    def progress(self) -> str:
        """What is missing until a model set can be fitted to the driving since the change; empty if nothing is."""
        plans, needed, minutes = self.plans_since_change, self.plans_needed, self.since_change
        if not self._changed() or (plans >= needed and minutes >= FEWEST_MINUTES):
            return ""
        minutes_a_plan = minutes / plans if plans else SPARE * self.robot.horizon * self.robot.period / 60.0
        left = max((needed - plans) * minutes_a_plan, FEWEST_MINUTES - minutes)
        bound = percent(accepted_bound(self.robot, self.accept_bound))
        have = f"{min(plans, needed)} of the {needed} plans since the change that state {bound}"
        return f"{WAITING}: {have}, {left:.1f} minutes left"

    def _plans(self, steps: list[pb.Step]) -> int:
        """Return how many plans that do not overlap these steps hold. A trajectory begins with its second step."""
        robot = self.robot
        runs = map(len, runs_of(steps))
        return sum(max(0, periods - 1 - robot.committed_steps) // robot.horizon for periods in runs)

    def _driving_robots(self) -> dict[str, RobotState]:
        latest = max((state.arrived for state in self._robots.values()), default=0.0)
        return {name: state for name, state in self._robots.items() if latest - state.arrived <= SILENT}

    def _changed(self) -> bool:
        robots = self._driving_robots()
        return bool(robots) and all(state.changed for state in robots.values())

    def _since(self, starts: dict[str, DrivenPeriod]) -> list[pb.Step]:
        return [
            step
            for step in self._steps
            if (start := starts.get(step.actor)) is not None
            and step.header.run == start.run
            and DrivenPeriod(step.header.run, step.episode, step.step) >= start
        ]

    def _since_change(self) -> list[pb.Step]:
        robots = self._driving_robots()
        return self._since({name: s.widened for name, s in robots.items() if s.widened is not None})

    def attempt(self) -> Recertification | None:
        """Fit and check a model set, if it is time; None if it is not."""
        if self._driven < self._periods(PAUSE):
            return None
        if self._changed():
            steps = self._since_change()
            why = f"{self._minutes(len(steps)):.1f} minutes after the change, at {self.widening:.2g} times the sets"
        else:
            again, robots = self._periods(AGAIN), self._driving_robots()
            steps = self._since({n: state.since for n, state in robots.items()}) if self._driven >= again else []
            why = f"after {self._minutes(len(steps)):.1f} minutes without a new one"
            if len(steps) < again:
                return None
        if len(steps) < self._periods(FEWEST_MINUTES) or self._plans(steps) < self.plans_needed:
            return None
        self._driven = 0
        return self._certified(steps, why)

    def _certified(self, steps: list[pb.Step], why: str) -> Recertification:
        """Return the narrowest model set of these steps that may be used, or why there is none."""
        widening, version, robot = self.widening, self.version, self.robot
        try:
            trajectories, _ = without_repeats(robot, tuple(trajectories_of(steps, robot)))
            about = {"origin": "adaptation", "why": why} | about_age(step.acceleration_age for step in steps)
            data = Dataset(robot, trajectories, about)
            data.check()
            in_use = self.in_use(version)
            covered = _coverage(in_use, data)
        except (BadData, BadModel) as error:
            return Recertification(f"none {why}: {error}")
        if narrower := covered.name if covered.narrower else in_use.about.get(NARROWER):  # an update inherits it
            data = replace(data, about=data.about | {NARROWER: narrower})
        most = _largest_half_width(in_use, widening, data)
        room = Filter(in_use).constraints.plan_widening(widening) * room_to_stand(in_use)
        updatable = in_use.model_config.mode == ONE_STEP and not covered.narrower
        ways = (_fitted, certify_update) if updatable else (_fitted,)
        tried = [self._tried(way, in_use, data, most, room) for way in ways]
        if all(result.model is None for _, result in tried):
            return Recertification(f"none {why}: {'; '.join(result.text for _, result in tried)}")
        _, best = min(tried, key=lambda pair: pair[0])
        assert best.model is not None
        keeps = f"; {covered.name} stays within {covered.share:.0%} of its range" if covered.narrower else ""
        return replace(best, text=f"{best.model.version} {why}, {best.text}{keeps}", replaces=version)

    def _tried(
        self, way: Way, in_use: ModelSet, data: Dataset, most: float, room: float
    ) -> tuple[float, Recertification]:
        """Return the mean half-width of a new model set [m], infinite if it may not be used, and the set or the reason.

        most: the largest mean half-width that may replace the set in use [m]. room: the most for a standing robot [m].
        """
        try:
            model, report = way(in_use, data, self._outside(in_use, data))
            width = mean_half_width(model, data)
        except (BadData, ErrorBoundError, ValueError) as error:
            return math.inf, Recertification(f"{NAMES[way]}: {error}")
        refused = refusal(self.robot, model.about, self.accept_bound)
        if not refused and not width <= most:  # NaN too
            refused = f"its sets are {TIGHTER * width / most:.2g} times as wide as those in use, as widened"
        if not refused and not (stands := room_to_stand(model)) <= room:
            refused = f"a standing robot needs {stands:.2f} m of room; with the set in use, as widened, {room:.2f} m"
        if refused:
            return math.inf, Recertification(f"{NAMES[way]}: {refused}")
        stated = (
            f"±{1e3 * report.half_width_full:.0f} mm after a full stop, at most {percent(report.bound_plan)} outside"
        )
        return width, Recertification(f"{NAMES[way]}: {stated}", model, data=None if way is certify_update else data)

    def _outside(self, in_use: ModelSet, data: Dataset) -> float:
        """Return the share of the windows that may leave the new sets: that of the set in use, or less.

        It follows from the number of plans alone: with so many outside, the bound is still accepted.
        """
        plans = sum(len(t.inputs) // self.robot.horizon for t in data.joined().trajectories)
        allowed = most_violations(plans, accepted_bound(self.robot, self.accept_bound)) / plans
        return max(ModelConfig.outside, min(in_use.model_config.outside, allowed))

    def confirmed(self, attempt: Recertification) -> Recertification:
        """Return an attempt as it stands after a fit of minutes: without its set, if another one came into use."""
        if attempt.model is None or attempt.replaces == self.version:
            return attempt
        return Recertification(f"none: {self.version} came into use during the fit; it was compared with another set")


@dataclass(frozen=True)
class _Coverage:
    """The speed, acceleration or input of which recent driving covers least.

    Attributes:
        name: its label in the robot's description.
        share: the driven range, as a share of the range in the set in use.
    """

    name: str
    share: float

    @property
    def narrower(self) -> bool:
        """Whether it is too little for an update.

        Its statement would not hold beyond the driven range: of the windows of a quadrotor with a payload that flew
        faster again, 15 % left sets that stated 2.9 %.
        """
        return self.share < UPDATED


def _coverage(in_use: ModelSet, data: Dataset) -> _Coverage:
    """Return what the recent driving covers least. Raises BadData: too little for a fit, which would slow the robot.

    After a fit to less than `UPDATED`, later sets must cover `UPDATED`: the robot must not become slower with each set.
    """
    ranges, recorded = np.ptp(in_use.domain, axis=0), np.ptp(recorded_domain(data), axis=0)
    shares = np.divide(recorded, ranges, out=np.full(len(ranges), np.inf), where=ranges > 0.0)
    robot, least = in_use.robot, int(shares.argmin())
    names = [*(robot.state[k] for k in robot.regressor), *robot.action]
    covered, needed = _Coverage(names[least], float(shares[least])), UPDATED if NARROWER in in_use.about else FITTED
    if covered.share < needed:
        raise BadData(
            f"the driving covers {covered.share:.0%} of the range of {covered.name} in the set in use, not {needed:.0%}"
        )
    return covered


def _fitted(in_use: ModelSet, data: Dataset, outside: float) -> tuple[ModelSet, ValidationReport]:
    """Fit a model set to the recent driving alone. Raises BadData."""
    return certify(data, ModelConfig(mode=ONE_STEP, outside=outside))


Way = Callable[[ModelSet, Dataset, float], tuple[ModelSet, ValidationReport]]
NAMES: dict[Way, str] = {_fitted: "a fit to this driving", certify_update: "an update of the set in use"}


def _largest_half_width(in_use: ModelSet, widening: float, data: Dataset) -> float:
    """Return the largest mean half-width that may replace a set in use that the robots widen [m]."""
    return TIGHTER * Filter(in_use).constraints.plan_widening(widening) * mean_half_width(in_use, data)


def room_to_stand(model: ModelSet) -> float:
    """Return how far the sets of a robot that stands, or turns in place, reach [m].

    If the recent driving holds little standing, the sets of a fit are wide there, and the robot may be stuck.
    """
    return Filter(model).clearance_margin


def mean_half_width(model: ModelSet, data: Dataset) -> float:
    """Return the mean half-width of the position at the end of plans that begin as the windows in the data do [m]."""
    robot = data.robot
    z = plans_from(robot, windows(data, robot.horizon, FREE).z)
    if model.model_config.windows == PLAN:
        z = z[:, : robot.regressor_dim + robot.free_steps * robot.action_dim]
    half_widths = model.steps[-1].half_widths(z)[:, : robot.position_dim].mean(axis=1)
    if model.one_step is not None:
        half_widths *= model.one_step.last_stretches(robot, z)
    return float(half_widths.mean())
