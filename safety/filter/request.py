"""A request to the filter, its decision, and the checks of a request (docs/method.md §4)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import FARTHEST, Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.messaging.value_equality import ComparedByValue
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.blocking_constraint import BlockingConstraint
from brakeline.safety.filter.obstacle_checks import check_movers, check_shapes
from brakeline.safety.filter.reservation import OtherReservations, Reservation
from brakeline.safety.filter.scan_checks import check_scan
from brakeline.safety.filter.widening import PastWindow

ALLOWED, ADJUSTED, FAILSAFE, RECOVERING = "allowed", "adjusted", "failsafe", "recovering"
MOST_OBSERVED = 4096  # numbers in an observation
FEW = 64  # numbers, up to which a loop is faster than NumPy
NOT_FINITE = "the proposed action holds NaN or infinity"  # the reason of a failsafe
NOTHING_KNOWN = (
    "nothing is known of the space around the robot: give obstacles, or a scan, or say known_free if a map says that "
    "all space within reach is free"
)
SEND_LAST = "send the prediction of the last decision as it is, or none"
EXECUTED = "state inputs as the robot executes them, in the units of its description"
STOPPED = 0.9e-9  # an input below it surely belongs to a stop (`Robot.is_stop_input`)

Named: TypeAlias = dict[str, tuple[NDArray[np.floating[Any]], tuple[int, ...]]]  # arrays, and the shapes they must have


@dataclass(frozen=True, eq=False)
class Request(ComparedByValue):
    """A request: all that the filter must know to decide on one proposal.

    >>> from brakeline import Filter, Obstacle
    >>> ground = Filter.load("ground")
    >>> stand, wall = np.zeros((ground.robot.horizon, 2)), Shapes.of([Obstacle("box", (0.25, 0.0), (0.2, 2.0))], dim=2)
    >>> request = Request(state=np.zeros(5), action=[0.25, 0.0], input_in_force=stand[0], plan=stand, obstacles=wall)
    >>> ground.decide(request).kind
    'adjusted'

    Attributes:
        state (n,): measured state.
        action (m,): proposal.
        input_in_force (m,): input of the period before.
        plan (N, m): rest of the backup plan; in real time, from the input in force on.
        obstacles: at least those within the robot's `sight` of the measured position.
        model: version of the model set that verified the plan. Empty if the robot stands; `UNVERIFIED` if no model set
            verified the plan.
        predicted: predicted set of this state, from the last decision.
        movers: moving obstacles, at least those that may come within reach before the plan ends.
        scan: a measurement of free space. All space that it does not show to be free counts as occupied.
        reservation: the reservation of this robot, in a world with other robots.
        other_reservations: the reservations of the other robots.
        observation: the input of a rival's networks; the filter does not need it.
        widening: factor on every set of a plan, at least 1 (docs/method.md §15).
        state_widening: factor on the set of the next state, if it is larger than `widening`; at least 1. It widens the
            coordinates that decide nothing about obstacles and limits, such as speeds. `widening` widens the others.
        past: the last periods of a plan's length; the decision returns their score.
        known_free: all space within reach is free, apart from the obstacles. A request without obstacles and scan needs
            it. In joint space there is no space to describe: no request needs it.
        turn_aside: the filter turns a blocked robot towards the nearest direction in which it can drive on
            (docs/method.md §4). Robots without a heading and a turn rate ignore it, as the rivals do.
        acceleration_age: the horizontal acceleration in the states is the one of this long ago [s]. It must be the age
            with which the model set was recorded (`ModelSet.acceleration_age`).
    """

    state: Array
    action: Array
    input_in_force: Array
    plan: Array
    obstacles: Shapes
    model: str = ""
    predicted: Prediction | None = None
    movers: MovingObstacles | None = None
    scan: RangeMeasurement | None = None
    reservation: Reservation | None = None
    other_reservations: OtherReservations | None = None
    observation: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    known_free: bool = False
    turn_aside: bool = False
    widening: float = 1.0
    state_widening: float = 1.0
    past: PastWindow | None = None
    acceleration_age: float = 0.0

    def __post_init__(self) -> None:
        """Convert arrays to the type and the memory layout that compiled code needs; copy those that are read-only."""
        for name in ("state", "action", "input_in_force", "plan"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            object.__setattr__(self, name, array if array.flags.writeable else array.copy())

    @property
    def finite(self) -> bool:
        """Whether the proposed action is finite. If not, every method brakes."""
        return all(map(math.isfinite, self.action.ravel().tolist()))

    def names_standing(self, robot: Robot) -> bool:
        """Return whether the input in force and the plan are those of a robot that stands, whatever its speeds."""
        rests = not self.model and bool(robot.is_stop_input(self.plan).all())
        return rests and robot.may_be_standing(self.input_in_force)

    def still(self, robot: Robot) -> bool:
        """Return whether the robot stands and its plan is to stand. No model set needs to verify that."""
        return self.names_standing(robot) and robot.is_standing(self.state)

    def reservation_faults(self, robot: Robot) -> Iterator[str]:
        """Yield why the robot's reservation does not keep the other robots away from it, or it from them."""
        own, others, d = self.reservation, self.other_reservations, robot.position_dim
        if own is None:
            return
        if others is not None and others.touch(own):
            yield "the robot's reservation touches another robot's"
        if not own.may_contain(self.state[:d], robot.measurement_bound[:d], robot.footprint):
            yield "the robot has left the space that it reserves"


@dataclass(frozen=True, eq=False)
class Decision(ComparedByValue):
    """The answer to a request.

    >>> from brakeline import Filter, InProcess
    >>> decision = InProcess(Filter.load("ground")).decide(state=[0, 0, 0, 0, 0], action=[0.2, 0], known_free=True)
    >>> decision.kind, decision.verified, decision.plan.tolist()
    ('allowed', True, [[0.2, 0.0], [0.0, 0.0], [0.0, 0.0]])

    Attributes:
        kind: allowed, adjusted, failsafe or recovering (never verified).
        plan (N, m): the first row is for now; in real time it is in force, and the second row is for the next period.
        tube_center (N, d): centers of the boxes of the true positions at the ends of the periods, in the world.
        tube_half_width (N, d): half-widths of these boxes.
        predicted: set of the next measured state.
        margin: distance of the tube to the nearest half-space [m], or to a limit in the limit's own unit. The margin
            of a failsafe may be negative although the plan is verified: an earlier decision verified it, but this
            margin starts from the new measurement.
        at_least: the margin is only a lower bound, since no obstacle is within reach.
        model: version of the model set.
        broken: number of moving obstacles that a sensor saw outside their bounds of motion.
        blocked_by: the constraint that the proposal violated, if it was not allowed.
        reservation: the space that this robot reserves against the other robots of its world.
        bound: the largest share of verified plans that leave their tubes, at 99 % confidence. 1 if the model set states
            no bound, None if the method verifies nothing.
        judges: the model set can score a window that has ended; the next request should hold one.
        outside_share: the share of windows that may leave the sets (`certify --outside`). 0 if `judges` is false.
        score: the largest ratio of an error to its set, without widening, in the request's past window. None without
            such a window, or if the model set cannot score it.
        plan_score: the same of the errors that decide about obstacles and limits: those of positions (of all discs of
            the body), and of coordinates with a limit. After one period, `score` counts all coordinates.
        for_clearance: whether the proposal was verified too and only came nearer than the clearance margin. None if
            unknown.
    """

    kind: str
    plan: Array
    tube_center: Array
    tube_half_width: Array
    predicted: Prediction
    margin: float
    model: str
    at_least: bool = False
    reason: str = ""
    verified: bool = True
    contained: bool = True
    compared: bool = False
    time_ms: float = field(default=0.0, compare=False)
    solve_ms: float = field(default=0.0, compare=False)
    verify_ms: float = field(default=0.0, compare=False)
    solver: str = ""
    iterations: int = 0
    broken: int = 0
    blocked_by: BlockingConstraint | None = None
    reservation: Reservation | None = None
    bound: float | None = None
    for_clearance: bool | None = None
    judges: bool = False
    outside_share: float = 0.0
    score: float | None = None
    plan_score: float | None = None


def check_for_filter(robot: Robot, request: Request) -> None:
    """Check all fields that the filter reads, and the observation if the request has one.

    A proposed action with NaN or infinity passes: the decision on it is a failsafe.

    Raises:
        BadRequest: a value is missing, not finite, out of bounds or of the wrong size. It has the field's name.
    """
    predicted = request.predicted
    further: Named = {"plan": (request.plan, (robot.horizon, robot.action_dim))}
    if request.observation.size > MOST_OBSERVED:
        raise BadRequest("observation", f"an observation has at most {MOST_OBSERVED} numbers")
    further["observation"] = request.observation, (request.observation.size,)
    if predicted is not None:
        further["predicted_center"] = predicted.center, (robot.state_dim,)
        further["predicted_half_width"] = predicted.half_width, (robot.state_dim,)
    check_motion(robot, request, further)
    _within_bounds(robot, "plan", request.plan)
    if not robot.is_stop_input(request.plan[-1]):
        raise BadRequest("plan", "the backup plan does not end in a stop: append one to its rest in each period")
    check_surroundings(robot, request)
    if predicted is not None:
        if min(predicted.half_width.tolist()) < 0.0:
            raise BadRequest("predicted_half_width", f"a predicted set has a negative half-width: {SEND_LAST}")
        if not math.isfinite(predicted.heading):
            raise BadRequest("predicted_heading", f"predicted_heading is NaN or infinite: {SEND_LAST}")


def check_surroundings(robot: Robot, request: Request) -> None:
    """Check that a request describes the space around the robot, with the robot's number of dimensions.

    Raises:
        BadRequest: the description is missing or does not fit the robot. It has the field's name.
    """
    moving = request.movers is not None and len(request.movers.shapes)
    if not isinstance(request.known_free, bool | np.bool_):  # a text such as "no" is true
        raise BadRequest("known_free", f"known_free is a {type(request.known_free).__name__}: give True or False")
    if not robot.position_dim:
        _check_no_space(robot, request)
    elif not (len(request.obstacles) or moving or request.scan is not None or request.known_free):
        raise BadRequest("obstacles", NOTHING_KNOWN)
    for name in ("widening", "state_widening"):
        if not 1.0 <= (factor := getattr(request, name)) < math.inf:  # less would make sets smaller than stated
            why = "send the factor of the last scores, or none"
            raise BadRequest(name, f"{name} is finite and at least 1, not {factor:g}: {why}")
    if request.past is not None:
        _check_past(robot, request.past)
    if not robot.position_dim:
        return
    check_shapes(robot, request.obstacles)
    if request.movers is not None:
        check_movers(robot, request.movers)
    if request.scan is not None:
        check_scan(robot, request.state, request.scan)


def _check_no_space(robot: Robot, request: Request) -> None:
    """Check that a request about a robot in joint space describes nothing that only a robot with a position can hit."""
    named = {"scan": request.scan, "reservation": request.reservation, "fleet": request.other_reservations}
    given = [name for name, value in named.items() if value is not None]
    if len(request.obstacles) or request.movers is not None:
        given.append("obstacles")
    if given:
        raise BadRequest(given[0], f"a {robot.name} robot has no position: a request about it has no {given[0]}")


def _check_past(robot: Robot, past: PastWindow) -> None:
    sizes = (robot.horizon, robot.state_dim), (robot.horizon + 1, robot.action_dim)
    if (past.states.shape, past.inputs.shape) != sizes:
        why = f"past has {sizes[0][0]} states and {sizes[1][0]} inputs of {robot.name}: send a whole window, or none"
        raise BadRequest("past", why)
    # The product is NaN or infinite if a value is, or if a value is very large.
    finite = all(math.isfinite(np.vdot(part, part)) for part in (past.states, past.inputs))
    if not finite and not (np.isfinite(past.states).all() and np.isfinite(past.inputs).all()):
        raise BadRequest("past", "past holds NaN or infinity: begin a new window after a period without a state")


class FastRequestCheck:
    """Checks all numbers of a request at once, in a third of the time of `check_for_filter`."""

    def __init__(self, robot: Robot) -> None:
        n, m, most = robot.state_dim, robot.action_dim, np.finfo(float).max
        self.sizes = n, m, (robot.horizon, m)
        low, high = (np.tile(bound, (robot.horizon, 1)) for bound in robot.bounds)
        low[-1, robot.zero_at_rest], high[-1, robot.zero_at_rest] = -STOPPED, STOPPED
        fixed = [np.full(n, FARTHEST), np.full(m, most)]
        self.bounds = np.stack(
            [
                np.concatenate([*(-part for part in fixed), robot.bounds[0], low.ravel()]),
                np.concatenate([*fixed, robot.bounds[1], high.ravel()]),
            ]
        )
        predicted = np.stack([np.concatenate([np.full(n + 1, -most), np.zeros(n)]), np.full(2 * n + 1, most)])
        self.with_predicted = np.hstack([self.bounds, predicted])
        from brakeline.safety.filter.kernels import tube_kernels  # here, since clients need no compiled code

        self.within = tube_kernels.within

    def __call__(self, request: Request) -> bool:
        """Return False if `check_for_filter` must look at the request."""
        (n, m, planned), observed = self.sizes, request.observation
        inputs = request.action, request.input_in_force, request.plan.ravel()
        sized = request.state.shape == (n,) and inputs[0].shape == inputs[1].shape == (m,)
        if not (sized and request.plan.shape == planned):
            return False
        if observed.shape != (0,):
            # The product is NaN or infinite if a value of the observation is, or if a value is very large.
            bounded = observed.ndim == 1 and observed.size <= MOST_OBSERVED
            if not (bounded and math.isfinite(np.dot(observed, observed))):
                return False
        predicted = request.predicted
        if predicted is None:
            return self.within(np.concatenate((request.state, *inputs)), self.bounds)
        if not predicted.center.shape == predicted.half_width.shape == (n,):
            return False
        sets = (predicted.heading,), predicted.center, predicted.half_width
        return self.within(np.concatenate((request.state, *inputs, *sets)), self.with_predicted)


def check_motion(robot: Robot, request: Request, further: Named) -> None:
    """Check state and inputs, and that all further arrays have their shapes and are finite.

    Raises:
        BadRequest: a value is missing, not finite or of the wrong size. It has the field's name.
    """
    inputs = (robot.action_dim,)
    named: Named = {
        "state": (request.state, (robot.state_dim,)),
        "input_in_force": (request.input_in_force, inputs),
    }
    _sized(robot, "action", request.action, inputs)
    _finite(robot, named | further)
    if max(sizes := [abs(value) for value in request.state.tolist()]) > FARTHEST:  # in any unit
        at = sizes.index(max(sizes))
        why = f"{robot.state[at]} is {request.state[at]:g}; use SI units, and an origin near the robot"
        raise BadRequest("state", f"a state beyond ±{FARTHEST:g} is not plausible: {why}")
    _within_bounds(robot, "input_in_force", request.input_in_force)


def _within_bounds(robot: Robot, name: str, inputs: Array) -> None:
    low, high = robot.bounds
    outside = ~((inputs >= low) & (inputs <= high))  # NaN, too
    if outside.any():
        at = np.unravel_index(outside.argmax(), inputs.shape)
        label, least, most = robot.action[at[-1]], robot.action_low[at[-1]], robot.action_high[at[-1]]
        bounds = f"its bounds are {least:g} and {most:g}"
        raise BadRequest(name, f"{name}: {label} is {inputs[at]:g}, and {bounds}: {EXECUTED}")


def _sized(robot: Robot, name: str, value: NDArray[np.floating[Any]], shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        labels = {"state": robot.state, "action": robot.action, "input_in_force": robot.action}.get(name, ())
        meaning = f": {', '.join(labels)}" if labels else ""
        raise BadRequest(name, f"{name} has shape {value.shape}, a {robot.name} robot's has {shape}{meaning}")


def _finite(robot: Robot, named: Named) -> None:
    for name, (value, shape) in named.items():
        _sized(robot, name, value, shape)
        few = value.size <= FEW  # faster in a loop
        if not (all(map(math.isfinite, value.ravel().tolist())) if few else np.isfinite(value).all()):
            why = "follow the backup plan until you have finite numbers"
            raise BadRequest(name, f"{name} holds NaN or infinity: {why}")
