"""PROCESS: the safety service. It keeps nothing about a robot between two queries, so replicas may run side by side."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from time import perf_counter_ns

from brakeline.errors import BadModel, BadRequest, BusError, NoModel, StaleModel, UnknownRobot, Untrusted
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.bus.identity import certified_name, speaks_for
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.robot import refuse_shipped_name, shipped_robots
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.topics import DECIDE, MODEL
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import check_for_filter
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.methods import IN_USE, Method, Model, archive_path, load, ready
from brakeline.safety.model.stated_bound import check_bound
from brakeline.safety.service.joint_request import (
    check_fleet,
    group_by_fleet,
    other_reservations,
    touches_another,
)
from brakeline.safety.service.plan_token import PlanAuthenticator
from brakeline.safety.service.signature import SignedModel, TrustedSigners
from brakeline.safety.service.wire import batch_of, decision_reply, digest, error_reply, request_of, reservation_of

log = logging.getLogger("brakeline.safety")


@dataclass
class ModelRegistry:
    """The method in use for each robot, and all versions that have been in use."""

    archive: Path | None = None  # folder for every installed version; None: no archive
    # largest accepted bound of a validation report, by the robot's name. Defaults to the limit in the description that
    # the model set holds.
    limits: Mapping[str, float] = field(default_factory=dict)
    accept_bound: float | None = None  # largest bound that the user accepts explicitly, in place of `limits`
    filters: dict[str, Method] = field(default_factory=dict)  # the method in use, by the robot's name
    known: set[str] = field(default_factory=set)  # versions that have been in use
    # number of the signature of the method in use, by the robot's name; 0: not signed
    numbers: dict[str, int] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def install(self, model: Model, signed: SignedModel | None = None, number: int = 0) -> None:
        """Use a model from now on. Running decisions finish with the model before.

        Args:
            model: a model set or a rival's model.
            signed: the signed file that it comes from, for the archive.
            number: of its signature.

        Raises:
            BadModel: the model does not fit its robot, or uses the name of another robot that Brakeline ships; or it
                was signed before the model in use.
            TooLoose: the bound in its validation report is larger than the accepted one.
        """
        robot = model.robot
        limit = self.limits.get(robot.name, robot.accept_bound)
        check_bound(model, dataclasses.replace(robot, accept_bound=limit), self.accept_bound)
        method = ready(model)
        try:
            refuse_shipped_name(model.robot)
        except UnknownRobot as error:
            raise BadModel(str(error)) from error
        with self._lock:
            if number < (in_use := self.numbers.get(robot.name, 0)):
                raise BadModel(
                    f"{robot.name}: {method.version} was signed before the model in use (number {number}, not above "
                    f"{in_use}). To go back to it, sign it again: `brakeline keys FOLDER --sign FILE`"
                )
            self.numbers[robot.name] = number
            self.filters[model.robot.name] = method
            self.known.add(method.version)
        log.info("%s: model %s in use (%s)", model.robot.name, method.version, type(method).__name__)
        if self.archive is not None:
            self._save(archive_path(self.archive, model.robot.name, method.version), signed or model)

    @staticmethod
    def _save(path: Path, model: Model | SignedModel) -> None:
        """Add a model to the archive. If that fails, the service goes on, and says so."""
        try:
            model.save(path)
            write_atomically(path.with_name(IN_USE), path.stem.encode())
        except OSError as error:
            log.error("a model is in use but could not be archived, so a restarted service will not use it: %s", error)

    def method_for(self, request: pb.Request) -> Method:
        """Return the method for a request.

        Raises:
            UnknownRobot, NoModel: there is no model of this robot.
            BadRequest: the client drives by another description of the robot.
            StaleModel: the plan was verified by a model that was never in use here.
        """
        method = self.filters.get(request.robot)
        if method is None:
            have = ", ".join(self.filters) or "none"
            if request.robot.removesuffix(REAL_TIME_SUFFIX) not in shipped_robots():
                raise UnknownRobot(
                    f"no robot is called {request.robot!r:.80} here (loaded: {have}): start another service with its "
                    "description (`brakeline safety FILE.toml`), or ask about these"
                )
            start = f"start another service (`brakeline safety {request.robot}`)"
            raise NoModel(
                "robot", f"no model of {request.robot} is loaded (loaded: {have}): {start}, or ask about these"
            )
        if request.layout and not method.robot.accepts_layout(request.layout):
            raise BadRequest(
                "layout",
                f"the client drives by another description of {request.robot} than the model was made for: "
                "give both the same file, or make the model again",
            )
        known = request.model in ("", UNVERIFIED) or request.model in self.known
        if not known and not self._archived(request.robot, request.model):
            why = f"the plan was verified by model {request.model}, which was never in use here"
            raise StaleModel("model", f"{why}: follow it until the robot stands, and then send an empty `model`")
        return method

    def _archived(self, robot: str, version: str) -> bool:
        if self.archive is None or not version.isalnum():
            return False
        if archive_path(self.archive, robot, version).exists():
            self.known.add(version)
            return True
        return False


@dataclass
class ServiceCounts:
    """Counters of a running service, for its health messages."""

    decisions: int = 0
    errors: int = 0
    compared: int = 0
    violations: int = 0
    unverified: int = 0
    token_rejected: int = 0
    not_finite: int = 0  # decisions on proposals with NaN or infinity
    decide_ms: float = 0.0
    busy_time: float = 0.0  # s

    def add(self, reply: pb.Reply, finite: bool) -> None:
        """Count a reply; finite: whether the proposal was."""
        if not reply.HasField("decision"):
            self.errors += 1
            return
        decision = reply.decision
        self.decisions += 1
        self.decide_ms += decision.time_ms
        self.compared += decision.compared
        self.violations += not decision.contained
        self.unverified += not decision.verified
        self.token_rejected += decision.token_rejected
        self.not_finite += not finite

    def figures(self) -> dict[str, float]:
        """Return the counters, with the mean time of a decision [ms]."""
        figures = dataclasses.asdict(self) | {"decide_ms": self.decide_ms / max(self.decisions, 1)}
        del figures["busy_time"]
        return figures


@dataclass(frozen=True)
class Receipt:
    """Who asked, and when the query arrived (perf_counter_ns)."""

    asker: str
    time: int

    @property
    def holder(self) -> str:
        """The name on the certificate of the asker, to which plan tokens are issued."""
        return certified_name(self.asker)

    def about(self, message: pb.Request) -> str:
        """Name the robot of a request for the log; the request itself may name the robot of another asker."""
        name = message.actor or message.robot
        return name if speaks_for(self.asker or name, name) else f"{self.asker}, about {headline(name)}"


@dataclass(frozen=True)
class BatchHandler:
    """The service's core: a function from the bytes of a RequestBatch to the bytes of a ReplyBatch."""

    models: ModelRegistry  # the methods in use
    counts: ServiceCounts  # to count in
    # checks the plan tokens. Without one (in process, or when a log is replayed), every plan counts as verified by the
    # model that the request names.
    authenticator: PlanAuthenticator | None = None

    def __call__(self, payload: bytes, asker: str = "") -> bytes:
        """Return the replies to a batch.

        Args:
            asker: name of the process that asks; empty within one process.

        Raises:
            BadRequest: the bytes are not a batch.
            UnknownRobot, NoModel: no request is about a robot of this service. A client takes the first answer that is
                no error, so another service on the bus may answer.
        """
        received = perf_counter_ns()
        batch = batch_of(payload)
        if all(message.robot not in self.models.filters for message in batch.requests):
            self.counts.errors += len(batch.requests)
            self.models.method_for(batch.requests[0])  # raises
        replies: list[pb.Reply] = [pb.Reply()] * len(batch.requests)
        for world in group_by_fleet(batch.requests):
            messages = [batch.requests[i] for i in world]
            for i, reply in zip(world, self._decide_world(messages, Receipt(asker, received)), strict=True):
                replies[i] = reply
        answer = pb.ReplyBatch(replies=replies, request=digest(payload)).SerializeToString()
        self.counts.busy_time += (perf_counter_ns() - received) * 1e-9
        return answer

    def _decide_world(self, messages: Sequence[pb.Request], receipt: Receipt) -> list[pb.Reply]:
        """Return the replies about the robots of one world."""
        try:
            if messages[0].fleet:
                check_fleet(messages)
                replies = self._decide_fleet(messages, receipt)
            else:
                replies = [self._decide(message, receipt) for message in messages]
        except (BadRequest, UnknownRobot) as error:
            replies = [error_reply(error) for _ in messages]
        for message, reply in zip(messages, replies, strict=True):
            self.counts.add(reply, all(map(math.isfinite, message.action)))
            if reply.HasField("decision") and not reply.decision.contained:
                log.warning("%s, step %d: outside the predicted set", receipt.about(message), message.step)
        return replies

    def _decide_fleet(self, messages: Sequence[pb.Request], receipt: Receipt) -> list[pb.Reply]:
        """Return the replies about the robots of a fleet, decided one after the other.

        A robot without a verified plan may reserve space that touches a robot that was decided before. That robot is
        decided again. Each round but the last leaves one more robot without a verified plan.

        Raises:
            BadRequest, UnknownRobot: the reservation of a robot is not known.
        """
        asked = {message.actor: self._current_reservation(message) for message in messages}
        now = dict(asked)
        replies = [self._decide(message, receipt, asked, now) for message in messages]
        for _ in messages if not all(reply.decision.verified for reply in replies) else ():
            for i, message in enumerate(messages):
                if replies[i].decision.verified and touches_another(message.actor, now):
                    replies[i] = self._decide(message, receipt, asked, now)
        return replies

    def _current_reservation(self, message: pb.Request) -> Reservation:
        """Return the reservation of a fleet's robot. One that stands without it reserves the space it stands in."""
        method = self.models.method_for(message)
        if not isinstance(method, Filter):
            raise BadRequest("fleet", "only the filter makes reservations: the rivals predict nothing")
        robot = method.robot
        if not robot.position_dim:
            raise BadRequest("fleet", f"{robot.name} has no position, so it reserves no space: ask without a fleet")
        if robot.late:
            why = f"{robot.name}: a robot in real time gets its decisions too late for reservations"
            raise BadRequest("fleet", why)
        if message.HasField("reservation"):
            return reservation_of(message.reservation, robot)
        request = request_of(message, robot)
        check_for_filter(robot, request)
        if not request.still(robot):
            why = f"{message.actor} moves without a reservation: no robot can keep away from it"
            raise BadRequest("reservation", why)
        return method.standing_reservation(request.state, request.widening)

    def _decide(
        self,
        message: pb.Request,
        receipt: Receipt,
        asked: Mapping[str, Reservation] | None = None,
        now: dict[str, Reservation] | None = None,
    ) -> pb.Reply:
        """Return the reply about one robot.

        Args:
            message: its request. receipt: who asked.
            asked: the reservations that the requests of its world hold.
            now: the present reservations of its world's robots, in which the robot's new one replaces its own.
        """
        try:
            method = self.models.method_for(message)
            authentic = self.authenticator is None or self.authenticator.is_authentic(
                message, method.robot, receipt.holder
            )
            own, others = None if asked is None else asked[message.actor], other_reservations(message.actor, now)
            request = request_of(message, method.robot, own, others)
            if not authentic:
                request = dataclasses.replace(request, model=UNVERIFIED)
            queue_ms = (perf_counter_ns() - receipt.time) * 1e-6
            decision = method.decide(request)
        except (BadRequest, UnknownRobot) as error:
            return error_reply(error)
        except Exception as error:  # the robot brakes on the error reply, and the service goes on
            log.exception("decide failed for %s", receipt.about(message))
            return error_reply(error)
        if now is not None and decision.reservation is not None:
            now[message.actor] = decision.reservation
        reply = decision_reply(decision, queue_ms)
        reply.robot, reply.decision.token_rejected = method.robot.name, not authentic
        if self.authenticator is not None and decision.verified:
            tokens = self.authenticator.plan_tokens(message, reply.decision, method.robot, receipt.holder)
            reply.decision.plan_tokens.extend(tokens)
        return reply


@dataclass(frozen=True)
class SafetySettings:
    """Settings of the process."""

    bus: BusSettings  # how to join the bus
    models: tuple[Path, ...]  # model files, one for each robot
    # archive, limits, accept_bound: of `ModelRegistry`
    archive: Path | None = None
    name: str = "safety"  # of the process
    limits: Mapping[str, float] = field(default_factory=dict)
    accept_bound: float | None = None
    secrets: Path | None = None  # folder with the key of the plan tokens, on a bus without keys


def main(settings: SafetySettings) -> None:
    """Serve until SIGINT or SIGTERM. Raises BadModel: a file holds no model, or is not signed on a bus with keys."""
    import brakeline.safety.filter.kernels.halfspace_kernels  # noqa: F401  # compiles for seconds the first time: do it before the service announces itself

    keys = settings.bus.keys
    models, counts = ModelRegistry(settings.archive, settings.limits, settings.accept_bound), ServiceCounts()
    with Process(settings.bus, settings.name) as process:
        trust = TrustedSigners.load(keys) if keys is not None else None
        authenticator = PlanAuthenticator.of(keys or settings.secrets)
        for path in settings.models:
            if trust is None:
                models.install(load(path))
            else:
                signed = SignedModel.load(path)
                models.install(trust.load_model(path), signed, trust.number(signed))

        def replace(sample: Sample) -> None:
            try:
                message = sample.message()
                if trust is None:
                    raise Untrusted("without keys, a service takes no models over the bus: it cannot check signatures")
                signed = SignedModel(message.file, message.claim, message.signature)
                models.install(trust.open(signed, message.robot), signed, trust.number(signed))
            except (BadModel, BusError) as error:
                log.error("a model at %s was refused: %s", sample.key[:200], error)

        before = perf_counter_ns() * 1e-9, 0.0  # time of the last figures, and the busy time until then [s]

        def refresh() -> None:
            nonlocal before
            now = perf_counter_ns() * 1e-9, counts.busy_time
            busy = (now[1] - before[1]) / max(now[0] - before[0], 1e-9)
            before = now
            process.figures.update(counts.figures() | {"busy": busy})
            process.notes.update({f"model {name}": method.version for name, method in models.filters.items()})

        process.refresh = refresh
        process.bus.subscribe(MODEL, replace)
        process.bus.serve(DECIDE, BatchHandler(models, counts, authenticator))
        process.announce()
        log.info("ready")
        process.stop.wait()
