"""A client of the safety service for one robot.

with SafetyClient.open("tcp/127.0.0.1:7447", "ground") as safety:
    answer = safety.decide(state=[0, 0, 0, 0, 0], action=[0.25, 0], obstacles=[Obstacle("cylinder", (0.4, 0), (0.1,))])
    drive(answer.action)          # once a period; if `decide` raises: drive(safety.fallback())
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from brakeline.errors import BadRequest, SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.identity import distinct_name
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.robot import Array, Robot, robot_named
from brakeline.messaging.sensor_messages import RangeMeasurement, set_measurement
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.model.model_config import MOST_OUTSIDE
from brakeline.safety.service.filter_client import (
    Answer,
    accept,
    known_free_in,
    observation_in,
    obstacles_in,
    scan_in,
    vector_in,
)
from brakeline.safety.service.obstacle_frame import ObstacleFrame
from brakeline.safety.service.plan_token import SIZE
from brakeline.safety.service.service_query import query_service
from brakeline.safety.service.wire import array_of, bad_reply, decision_of, reservation_message, reservation_of

DEADLINE = 0.1  # s
LONGEST_DEADLINE = 86400.0  # s
SAME_INPUT = 1e-9  # rounding error allowed between two equal inputs


def request_message(
    backup_plan: BackupPlan,
    state: ArrayLike,
    action: ArrayLike,
    obstacles: Iterable[Obstacle] | None = None,
    *,
    scan: RangeMeasurement | None = None,
    observation: ArrayLike | None = None,
    known_free: bool = False,
    actor: str = "",
    episode: int = 0,
    step: int = 0,
    time: float = 0.0,
    fleet: Sequence[str] = (),
) -> pb.Request:
    """Return the message that requests a decision on an action. Raises BadRequest if a value has another type."""
    measured = vector_in("state", state)
    backup_plan.measured(measured)
    message = pb.Request(
        robot=backup_plan.robot.name,
        layout=backup_plan.robot.layout(),
        state=measured.tolist(),
        action=vector_in("action", action).tolist(),
        input_in_force=backup_plan.input_in_force.tolist(),
        plan=backup_plan.plan.ravel().tolist(),
        model=backup_plan.model,
        plan_token=backup_plan.plan_token,
        obstacles=obstacle_messages(obstacles_in(obstacles)),
        observation=observation_in(observation).tolist(),
        known_free=known_free_in(known_free),
        turn_aside=backup_plan.turn_aside,
        widening=backup_plan.widening.factor,
        state_widening=backup_plan.widening.state_factor,
        acceleration_age=backup_plan.acceleration_age,
    )
    _set_labels(message, actor=actor, episode=episode, step=step, time=time, fleet=fleet)
    set_measurement(message, scan_in(scan))
    _set_history(message, backup_plan)
    return message


def _set_labels(message: pb.Request, **labels: Any) -> None:
    """Set the fields that name a request, for the log and for plan tokens. Raises BadRequest for another type."""
    name = ""
    try:
        for name, value in labels.items():
            if name == "fleet":
                message.fleet.extend(value)
            else:
                setattr(message, name, value)
    except (AttributeError, TypeError, ValueError) as error:
        give = "give texts as actor and fleet, whole numbers from 0 as episode and step, and seconds as time"
        raise BadRequest(name, f"{name} is {labels[name]!r:.80}: {give}") from error


def _set_history(message: pb.Request, backup_plan: BackupPlan) -> None:
    """Set what the robot committed to before: its past states and inputs, its prediction and its reservation."""
    if (past := backup_plan.past) is not None:
        message.past_states.extend(past.states.ravel().tolist())
        message.past_inputs.extend(past.inputs.ravel().tolist())
        message.past_from_start = past.from_start
    if backup_plan.predicted is not None:
        message.predicted_center.extend(backup_plan.predicted.center.tolist())
        message.predicted_half_width.extend(backup_plan.predicted.half_width.tolist())
        message.predicted_heading = backup_plan.predicted.heading
    if message.fleet and backup_plan.reservation is not None:
        message.reservation.CopyFrom(reservation_message(backup_plan.reservation))


def read_reply(reply: pb.Reply, request: pb.Request, robot: Robot) -> Answer:
    """Return the answer in the reply to a request.

    Raises:
        SafetyError: the reply is an error, or its plan is not possible for this robot after the input in force, or
            another field is not valid, or it says that a plan is verified and lacks what the verification gives.
    """
    if (result := reply.WhichOneof("result")) != "decision":
        raise bad_reply("", "neither a decision nor an error") if result is None else SafetyError(reply.error)
    if reply.robot != robot.name:
        raise bad_reply("robot", f"a decision about {reply.robot[:100]!r}")
    decision = reply.decision
    _check_plan(decision, request, robot)
    _check_prediction(decision, robot)
    _check_figures(decision, robot)
    if decision.verified:
        _check_verified(decision, robot)
    try:
        if request.fleet:
            reservation_of(decision.reservation, robot)
        answer = decision_of(decision, robot)
    except BadRequest as error:
        raise bad_reply(error.field, str(error)) from error
    plan_tokens = tuple(decision.plan_tokens)
    return Answer.of(
        answer, robot, queue_ms=decision.queue_ms, token_rejected=decision.token_rejected, plan_tokens=plan_tokens
    )


def _check_plan(decision: pb.Decision, request: pb.Request, robot: Robot) -> None:
    """Raise SafetyError if the robot cannot execute the plan after the input in force."""
    plan = array_of(decision.plan)
    if plan.size != robot.horizon * robot.action_dim:
        raise bad_reply("plan", f"a plan of {plan.size} numbers")
    plan = plan.reshape(robot.horizon, robot.action_dim)
    low, high = robot.bounds
    if not ((plan >= low) & (plan <= high)).all():  # NaN fails too
        raise bad_reply("plan", "an input out of bounds")
    if not robot.is_stop_input(plan[-1]):
        raise bad_reply("plan", "a plan that does not end in a stop")
    if not _follows(plan, request, robot):
        raise bad_reply("plan", "a plan that does not follow the input in force")


def _check_prediction(decision: pb.Decision, robot: Robot) -> None:
    """Raise SafetyError if the predicted set of the next state or the margin is not valid."""
    sizes = {len(decision.predicted_center), len(decision.predicted_half_width)}
    if sizes not in ({robot.state_dim}, {0}):  # the rivals predict nothing
        raise bad_reply("predicted_center", "a predicted state of the wrong size")
    numbers = [*decision.predicted_center, *decision.predicted_half_width, decision.predicted_heading, decision.margin]
    if not all(map(math.isfinite, numbers)) or min(decision.predicted_half_width, default=0.0) < 0.0:
        raise bad_reply("predicted_center", "a predicted state or a margin that is not valid")


def _check_figures(decision: pb.Decision, robot: Robot) -> None:
    """Raise SafetyError if what the decision states beside its plan and sets is not valid."""
    for name in ("time_ms", "solve_ms", "verify_ms", "queue_ms"):
        if not math.isfinite(getattr(decision, name)):
            raise bad_reply(name, "a time that is not finite")
    if not 0.0 <= decision.bound <= 1.0:  # NaN fails too
        raise bad_reply("bound", "a bound that is no share of plans")
    if not 0.0 <= decision.outside_share <= MOST_OUTSIDE:
        raise bad_reply("outside_share", f"a share of windows outside that is not within 0 and {MOST_OUTSIDE:g}")
    for name in ("score", "plan_score"):
        if not getattr(decision, name) >= 0.0:  # infinity is a score
            raise bad_reply(name, "a score that is no ratio")
    if len(decision.plan_tokens) > robot.horizon + 1 or any(len(token) != SIZE for token in decision.plan_tokens):
        raise bad_reply("plan_tokens", "plan tokens of the wrong size or number")
    stopped = decision.stopped
    if {len(stopped.normal), len(stopped.at)} not in ({robot.position_dim}, {0}):
        raise bad_reply("stopped", "a constraint in another number of coordinates")
    if math.isnan(stopped.room) or not all(map(math.isfinite, (stopped.after, *stopped.normal, *stopped.at))):
        raise bad_reply("stopped", "a constraint that holds NaN or infinity")


def _check_verified(decision: pb.Decision, robot: Robot) -> None:
    """Raise SafetyError if a decision says that its plan is verified, and lacks what each verification gives."""
    if decision.model in ("", UNVERIFIED):  # an empty one would say that the robot stands
        raise bad_reply("model", "a verified plan without the model that verified it")
    if decision.kind == pb.RECOVERING:
        raise bad_reply("kind", "a verified plan to recover: nothing verifies such plans")
    if len(decision.tube_center) != robot.horizon * robot.position_dim:
        raise bad_reply("tube_center", "a verified plan without its tube")
    if not decision.predicted_center:
        raise bad_reply("predicted_center", "a verified plan without the predicted state")
    if not decision.HasField("bound"):
        raise bad_reply("bound", "a verified plan without the bound that its model set states")


def _follows(plan: Array, request: pb.Request, robot: Robot) -> bool:
    """Return whether a plan (N, m) continues the input in force, and each input the one before, within the slew limit.

    A late robot's plan begins with the input that is in force until the decision arrives. Inputs that feedback computes
    from a future state are not compared.
    """
    m = robot.action_dim
    before = request.plan[:m] if robot.late else request.input_in_force[:]
    if len(before) != m:
        return False
    steps = np.abs(plan - np.concatenate(([before], plan[:-1])))
    if robot.late and (steps[0] > SAME_INPUT).any():
        return False
    if robot.feedback:
        steps[1:, robot.stops_by_feedback] = 0.0
    return bool((steps <= robot.slew + SAME_INPUT).all())


def bus_at(connect: str | Sequence[str], keys: Path | str | None, name: str) -> Bus:
    """Connect a new bus to endpoints; keys: the folder with the keys of `name`, if the bus has keys.

    Raises:
        Unreachable: there is no router at the endpoints.
        BadKeys: the folder has no keys of that name.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    return Bus(BusSettings(connect=endpoints, keys=None if keys is None else Path(keys)), distinct_name(name))


class BusClient:
    """A client over a bus, for robots of one kind. It closes the bus if it opened it."""

    def __init__(self, bus: Bus, robot: Robot | Path | str, deadline: float) -> None:
        """Make a client.

        Args:
            bus: the bus.
            robot: the robot, its name, or the path of its description.
            deadline: longest wait for a decision [s].

        Raises:
            ValueError: the deadline is not above 0 and at most `LONGEST_DEADLINE`.
            UnknownRobot: no robot has this name.
        """
        if not (isinstance(deadline, int | float | np.number) and 0.0 < deadline <= LONGEST_DEADLINE):  # NaN fails too
            raise ValueError(f"a deadline is a time above 0 and at most {LONGEST_DEADLINE:g} s, not {deadline!r}")
        self.bus, self.deadline = bus, deadline
        self.robot = robot if isinstance(robot, Robot) else robot_named(robot)
        self._owned = False

    @classmethod
    def _opened(cls, connect: str | Sequence[str], keys: Path | str | None, name: str, *more: Any) -> Self:
        """Return a client with a bus of its own; more: the other arguments of the constructor."""
        bus = bus_at(connect, keys, name)
        try:
            client = cls(bus, *more)
        except BaseException:
            bus.close()
            raise
        client._owned = True
        return client

    def close(self) -> None:
        if self._owned:
            self.bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


class SafetyClient(BusClient):
    """Requests decisions about one robot from the safety service, and keeps its backup plan.

    Use a client in one thread at a time, and in the process that opened it: a process that is forked later gets no
    answers. With several robots, use one client for each, or a `FleetClient` for robots that share a world.

    >>> with SafetyClient.open(ENDPOINT, "ground", deadline=5.0) as safety:  # of `brakeline safety ground --listen …`
    ...     safety.decide([0, 0, 0, 0, 0], [0.25, 0], [Obstacle("cylinder", (0.4, 0.0), (0.1,))]).kind
    'allowed'
    """

    def __init__(
        self, bus: Bus, robot: Robot | Path | str, deadline: float = DEADLINE, acceleration_age: float = 0.0
    ) -> None:
        """acceleration_age: your states hold the horizontal acceleration of this long ago [s]."""
        super().__init__(bus, robot, deadline)
        self.backup_plan = BackupPlan(self.robot, acceleration_age=acceleration_age)
        self._frame = ObstacleFrame(self.robot)

    @classmethod
    def open(
        cls,
        connect: str | Sequence[str],
        robot: Robot | Path | str,
        deadline: float = DEADLINE,
        keys: Path | str | None = None,
        name: str = "client",
        acceleration_age: float = 0.0,
    ) -> Self:
        """Return a client with a bus of its own.

        Args:
            connect: endpoints, for example tcp/HOST:PORT, or tls/HOST:PORT on a bus with keys.
            robot: the robot, its name, or the path of its description.
            deadline: longest wait for a decision [s].
            keys: the folder with the keys of `name`, on a bus with keys.
            name: of this client on the bus. Only `client` may be the name of several; a service keeps at most 8 waiting
                queries of one name.
            acceleration_age: your states hold the horizontal acceleration of this long ago [s].

        Raises:
            Unreachable: there is no router at the endpoints.
            BadKeys: the folder has no keys of that name.
            ValueError: the deadline is not above 0 and at most a day.
        """
        return cls._opened(connect, keys, name, robot, deadline, acceleration_age)

    def decide(
        self,
        state: ArrayLike,
        action: ArrayLike,
        obstacles: Iterable[Obstacle] | None = None,
        *,
        scan: RangeMeasurement | None = None,
        observation: ArrayLike | None = None,
        known_free: bool = False,
        actor: str = "",
        episode: int = 0,
        step: int = 0,
        time: float = 0.0,
    ) -> Answer:
        """Request the decision on an action and commit to its plan. Then execute `answer.action`.

        Args:
            actor: your name, the same in every request. The plan tokens are issued to it.
            episode, step, time: for the service's log; time in s.
            state, action, obstacles, scan, observation, known_free: as in `FilterClient.decide`.

        Raises:
            BadRequest: a value has another type; `field` names it.
            NoReply, Late, Refused, SafetyError: there is no decision. Execute `fallback()` instead.
        """
        listed = None if obstacles is None else obstacles_in(obstacles)
        request = request_message(
            self.backup_plan,
            state,
            action,
            listed,
            scan=scan,
            observation=observation,
            known_free=known_free,
            actor=actor,
            episode=episode,
            step=step,
            time=time,
        )
        self._frame.see(np.array(request.state), listed)
        answer = read_reply(query_service(self.bus, [request], self.deadline)[0], request, self.robot)
        accept(self.backup_plan, answer)
        return answer

    def fallback(self) -> Array:
        """Return the backup plan's next input, for a period without a decision."""
        return self.backup_plan.fallback()

    def reset(self) -> None:
        """Begin an episode with a robot that stands still."""
        self.backup_plan.reset()
        self._frame.reset()
