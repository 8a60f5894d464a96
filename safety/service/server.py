"""PROCESS: the safety service. It keeps nothing about a robot between two queries, so replicas may run side by side."""

from __future__ import annotations

import dataclasses
import logging
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
from brakeline.messaging.robot import Robot, refuse_shipped_name, shipped_robots
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.topics import DECIDE, MODEL
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Decision, check_for_filter
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.methods import IN_USE, Method, Model, archive_path, load, ready
from brakeline.safety.model.stated_bound import check_bound
from brakeline.safety.service.joint_request import check_fleet, group_by_fleet, reservations_for
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
            if request.robot.removesuffix(REAL_TIME_SUFFIX) not in shipped_robots():
                raise UnknownRobot(f"no robot is called {request.robot!r:.80} here")
            have = ", ".join(self.filters) or "none"
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
            raise StaleModel("model", f"the plan was verified by model {request.model}, which was never in use here")
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

    def add(self, decision: Decision, finite: bool) -> None:
        """Count a decision; finite: whether its proposal was."""
        self.decisions += 1
        self.decide_ms += decision.time_ms
        self.compared += decision.compared
        self.violations += not decision.contained
        self.unverified += not decision.verified
        self.not_finite += not finite

    def figures(self) -> dict[str, float]:
        """Return the counters, with the mean time of a decision [ms]."""
        figures = dataclasses.asdict(self) | {"decide_ms": self.decide_ms / max(self.decisions, 1)}
        del figures["busy_time"]
        return figures


@dataclass(frozen=True)
class Receipt:
    """Who asked, and when the question arrived (perf_counter_ns)."""

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
        """Return the replies to a batch. Raises BadRequest if the bytes are not a batch.

        Args:
            asker: name of the process that asks; empty within one process.
        """
        received = perf_counter_ns()
        batch = batch_of(payload)
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
        if not messages[0].fleet:
            return [self._decide(message, receipt) for message in messages]
        try:
            check_fleet(messages)
            reservations = {message.actor: self._current_reservation(message) for message in messages}
        except (BadRequest, UnknownRobot) as error:
            return [self._refuse(error) for _ in messages]
        return [self._decide(message, receipt, reservations) for message in messages]

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
        self, message: pb.Request, receipt: Receipt, reservations: dict[str, Reservation] | None = None
    ) -> pb.Reply:
        """Return the reply about one robot; reservations: of its world's robots, in which its own is replaced."""
        try:
            method = self.models.method_for(message)
            token_rejected = self._reject_token(message, method.robot, receipt.holder)
            own, others = reservations_for(message.actor, reservations)
            request = request_of(message, method.robot, own, others)
            queue_ms = (perf_counter_ns() - receipt.time) * 1e-6
            decision = method.decide(request)
        except (BadRequest, UnknownRobot) as error:
            return self._refuse(error)
        except Exception as error:  # the robot brakes on the error reply, and the service goes on
            log.exception("decide failed for %s", receipt.about(message))
            return self._refuse(error)
        self.counts.add(decision, request.finite)
        if not decision.contained:
            log.warning("%s, step %d: outside the predicted set", receipt.about(message), message.step)
        if reservations is not None and decision.reservation is not None:
            reservations[message.actor] = decision.reservation
        reply = decision_reply(decision, queue_ms)
        reply.robot, reply.decision.token_rejected = method.robot.name, token_rejected
        if self.authenticator is not None and decision.verified:
            tokens = self.authenticator.plan_tokens(message, reply.decision, method.robot, receipt.holder)
            reply.decision.plan_tokens.extend(tokens)
        return reply

    def _reject_token(self, message: pb.Request, robot: Robot, asker: str) -> bool:
        """Return whether a request's plan token does not match its plan. If so, mark the plan as unverified."""
        rejected = self.authenticator is not None and not self.authenticator.is_authentic(message, robot, asker)
        if rejected:
            self.counts.token_rejected += 1
            message.model = UNVERIFIED
        return rejected

    def _refuse(self, error: Exception) -> pb.Reply:
        self.counts.errors += 1
        return error_reply(error)


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
                log.error("a model was refused: %s", error)

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
