"""How any program asks the safety service, and what it must keep between two questions.

with SafetyClient.open("tcp/127.0.0.1:7447", "ground") as safety:
    answer = safety.decide(state=[0, 0, 0, 0, 0], action=[0.25, 0], obstacles=[Obstacle("cylinder", (0.4, 0), (0.1,))])
    drive(answer.action)          # and next period again; if it raises: drive(safety.fallback())
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusError, BusSettings
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.robot import FEEDBACK, Robot, robot_named
from brakeline.messaging.sensor_messages import RangeMeasurement, set_measurement
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import BadRequest
from brakeline.safety.service.filter_client import Answer, accept, known_free_in, observation_in, obstacles_in, scan_in
from brakeline.safety.service.request_digest import digest
from brakeline.safety.service.wire import decision_of, reservation_message, reservation_of

Array = NDArray[np.float64]

DEADLINE = 0.1  # s
NONCE = 16  # bytes
SAME_INPUT = 1e-9  # rounding allowed where inputs are compared


class SafetyError(BusError):
    """The service answered this request with an error: `type` and the `field` that is wrong."""

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type}: {error.message}")
        self.type, self.field = error.type, error.field


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
    """The question about an action. Raises BadRequest: a value is of another type."""
    backup_plan.measured(np.asarray(state, float))
    message = pb.Request(
        robot=backup_plan.robot.name,
        state=np.asarray(state, float).tolist(),
        action=np.asarray(action, float).tolist(),
        input_in_force=backup_plan.input_in_force.tolist(),
        plan=backup_plan.plan.ravel().tolist(),
        model=backup_plan.model,
        plan_token=backup_plan.plan_token,
        obstacles=obstacle_messages(obstacles_in(obstacles)),
        observation=observation_in(observation).tolist(),
        known_free=known_free_in(known_free),
        actor=actor,
        episode=episode,
        step=step,
        time=time,
        fleet=fleet,
    )
    set_measurement(message, scan_in(scan))
    if backup_plan.predicted is not None:
        message.predicted_center.extend(backup_plan.predicted.center.tolist())
        message.predicted_half_width.extend(backup_plan.predicted.half_width.tolist())
        message.predicted_heading = backup_plan.predicted.heading
    if message.fleet and backup_plan.reservation is not None:
        message.reservation.CopyFrom(reservation_message(backup_plan.reservation))
    return message


def read_reply(reply: pb.Reply, request: pb.Request, robot: Robot) -> Answer:
    """The decision in a reply to a request.

    Raises:
        SafetyError: it is an error, or its plan or prediction is not one of this robot's, or not one that follows the
            input in force.
    """
    if reply.WhichOneof("result") != "decision":
        raise SafetyError(reply.error)
    if reply.robot != robot.name:
        raise _bad_reply("robot", f"a decision about {reply.robot[:100]!r}")
    decision = reply.decision
    plan = np.array(decision.plan)
    if plan.size != robot.horizon * robot.action_dim:
        raise _bad_reply("plan", f"a plan of {plan.size} numbers")
    plan = plan.reshape(robot.horizon, robot.action_dim)
    if not ((plan >= robot.low() - 1e-9) & (plan <= robot.high() + 1e-9)).all():  # NaN fails too
        raise _bad_reply("plan", "an input out of bounds")
    if not robot.is_stop_input(plan[-1]):
        raise _bad_reply("plan", "a plan that does not end in a stop")
    if not _follows(plan, request, robot):
        raise _bad_reply("plan", "a plan that does not follow the input in force")
    sizes = {len(decision.predicted_center), len(decision.predicted_half_width)}
    if sizes not in ({robot.state_dim}, {0}):  # the rivals predict nothing
        raise _bad_reply("predicted_center", "a predicted state of the wrong size")
    said = [*decision.predicted_center, *decision.predicted_half_width, decision.predicted_heading, decision.margin]
    if not all(map(math.isfinite, said)) or min(decision.predicted_half_width, default=0.0) < 0.0:
        raise _bad_reply("predicted_center", "a predicted state or a margin that is none")
    try:
        if request.fleet:
            reservation_of(decision.reservation, robot)
        found = decision_of(decision, robot)
    except BadRequest as error:
        raise _bad_reply(error.field, str(error)) from error
    plan_tokens = tuple(decision.plan_tokens)
    return Answer.of(
        found, robot, queue_ms=decision.queue_ms, token_rejected=decision.token_rejected, plan_tokens=plan_tokens
    )


def _follows(plan: Array, request: pb.Request, robot: Robot) -> bool:
    """Does a plan (N, m) go on from the input in force, and from step to step, within the slew? A late robot's begins
    with the input that is in force meanwhile. What feedback will make of a state to come is not in the plan."""
    m, slew = robot.action_dim, np.asarray(robot.action_slew) + SAME_INPUT
    begun = np.array(request.plan[:m] if robot.late else request.input_in_force)
    if begun.shape != (m,):
        return False
    if robot.late and (np.abs(plan[0] - begun) > SAME_INPUT).any():
        return False
    planned = [rule != FEEDBACK for rule in robot.stop]
    steps = np.abs(np.diff(plan, axis=0))[:, planned]
    return bool((np.abs(plan[0] - begun) <= slew).all() and (steps <= slew[planned]).all())


def _bad_reply(field: str, message: str) -> SafetyError:
    return SafetyError(pb.Error(type="BadReply", field=field, message=message))


def bus_at(connect: str | Sequence[str], keys: Path | str | None, name: str) -> Bus:
    """A bus of one's own at these endpoints; keys: the folder with the keys of `name`, if the bus has keys.

    Raises:
        Unreachable: no router at these endpoints; BadKeys: no keys of that name.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    return Bus(BusSettings(connect=endpoints, keys=None if keys is None else Path(keys)), name)


class BusClient:
    """A bus to ask about robots of one kind, closed with it if it is its own."""

    def __init__(self, bus: Bus, robot: Robot | str, deadline: float) -> None:
        self.bus, self.deadline = bus, deadline
        self.robot = robot_named(robot) if isinstance(robot, str) else robot
        self._owned = False

    def close(self) -> None:
        if self._owned:
            self.bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


class SafetyClient(BusClient):
    """Asks the safety service about one robot, and keeps its committed plan.

    Not for several threads at once; a program with several robots has a client (or a `BackupPlan`) for each, and a
    `FleetClient` for those that share a world.
    """

    def __init__(self, bus: Bus, robot: Robot | str, deadline: float = DEADLINE) -> None:
        super().__init__(bus, robot, deadline)
        self.backup_plan = BackupPlan(self.robot)

    @classmethod
    def open(
        cls,
        connect: str | Sequence[str],
        robot: Robot | str,
        deadline: float = DEADLINE,
        keys: Path | str | None = None,
        name: str = "client",
    ) -> Self:
        """A client with a bus of its own.

        Args:
            robot: the robot, its name, or the path of its description.
            keys: the folder with the keys of `name`, if the bus has keys; its endpoints are then tls/HOST:PORT.

        Raises:
            Unreachable: no router at these endpoints; BadKeys: no keys of that name.
        """
        client = cls(bus_at(connect, keys, name), robot, deadline)
        client._owned = True
        return client

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
        """Ask for the decision on an action and commit to its plan; then execute `answer.action`.

        Args:
            actor: your name, the same in every question; episode, step, time [s]: for the service's log.

        Raises:
            BadRequest: a value is of another type; `field` names it.
            NoReply, Late, Refused, SafetyError: no decision; execute `fallback()` instead.
        """
        request = request_message(
            self.backup_plan,
            state,
            action,
            obstacles,
            scan=scan,
            observation=observation,
            known_free=known_free,
            actor=actor,
            episode=episode,
            step=step,
            time=time,
        )
        answer = read_reply(query_service(self.bus, [request], self.deadline)[0], request, self.robot)
        accept(self.backup_plan, answer)
        return answer

    def fallback(self) -> Array:
        """The committed plan's next input, for when there is no decision."""
        return self.backup_plan.fallback()

    def reset(self) -> None:
        """An episode begins, standing still."""
        self.backup_plan.reset()


def query_service(bus: Bus, requests: Sequence[pb.Request], deadline: float) -> list[pb.Reply]:
    """The replies to requests about robots of one kind, in their order.

    Raises:
        NoReply, Late, Refused: nobody serves, too late, or not understood at all.
        SafetyError: no batch of replies, or not as many as requests, or not to this question.
    """
    payload = pb.RequestBatch(requests=requests, nonce=secrets.token_bytes(NONCE)).SerializeToString()
    answer = bus.ask(DECIDE, payload, deadline, robot=requests[0].robot)
    try:
        batch = pb.ReplyBatch.FromString(answer)
    except DecodeError as error:
        raise _bad_reply("", f"not a reply batch: {error}") from error
    if batch.request != digest(payload):
        raise _bad_reply("request", "replies to another question")
    if len(batch.replies) != len(requests):
        raise _bad_reply("", f"{len(batch.replies)} replies to {len(requests)} requests")
    return list(batch.replies)
