"""PROCESS: answers `decide` queries; keeps nothing about any robot, so several may run side by side."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from time import perf_counter_ns

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusError, BusSettings, Sample
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import REAL_TIME_SUFFIX, UnknownRobot, refuse_shipped_name, shipped_robots
from brakeline.messaging.topics import DECIDE, MODEL
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import BadRequest, StaleModel, check_for_filter
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.methods import Method, Model, load, ready
from brakeline.safety.model.model_set import BadModel
from brakeline.safety.model.stated_bound import check_bound
from brakeline.safety.service.joint_request import FleetReservations, group_by_fleet, joint_request
from brakeline.safety.service.plan_token import PlanAuthenticator
from brakeline.safety.service.request_digest import digest
from brakeline.safety.service.signature import SignedModel, TrustedSigners, Untrusted
from brakeline.safety.service.wire import batch_of, decision_reply, error_reply, request_of, reservation_of

log = logging.getLogger("brakeline.safety")


class NoModel(BadRequest):
    """No model of this robot is loaded."""


@dataclass
class ModelRegistry:
    """The method in use for each robot, and every version there has been, with an archive folder if given.

    limits: the largest stated bound that is used without a question, by the robot's name; without it the limit in the
    model set's own description counts. accept_bound: the largest that is accepted explicitly, in place of both.
    """

    archive: Path | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    accept_bound: float | None = None
    filters: dict[str, Method] = field(default_factory=dict)
    known: set[str] = field(default_factory=set)
    _lock: Lock = field(default_factory=Lock)

    def install(self, model: Model, signed: SignedModel | None = None) -> None:
        """Put a model to use; requests in hand finish with the one before. signed: as it came, to be archived so.

        Raises:
            BadModel: it does not fit its robot, or its robot has the name of another that comes with the program.
            TooLoose: its statement is looser than what is used.
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
            self.filters[model.robot.name] = method
            self.known.add(method.version)
        log.info("%s: model %s in use (%s)", model.robot.name, method.version, type(method).__name__)
        if self.archive is not None:
            (signed or model).save(archive_path(self.archive, model.robot.name, method.version))

    def method_for(self, request: pb.Request) -> Method:
        """Raises UnknownRobot, NoModel or StaleModel."""
        method = self.filters.get(request.robot)
        if method is None:
            if request.robot.removesuffix(REAL_TIME_SUFFIX) not in shipped_robots():
                raise UnknownRobot(f"no robot is called {request.robot!r:.80} here")
            have = ", ".join(self.filters) or "none"
            raise NoModel("robot", f"no model of {request.robot} is loaded (loaded: {have})")
        vouched = request.model in ("", UNVERIFIED) or request.model in self.known
        if not vouched and not self._archived(request.robot, request.model):
            raise StaleModel("model", f"the plan was verified by model {request.model}, which was never in use here")
        return method

    def _archived(self, robot: str, version: str) -> bool:
        if self.archive is None or not version.isalnum():
            return False
        if archive_path(self.archive, robot, version).exists():
            self.known.add(version)
            return True
        return False


def archive_path(archive: Path, robot: str, version: str) -> Path:
    """Where a version is kept."""
    return archive / robot / "models" / f"{version}.safetensors"


@dataclass
class ServiceCounts:
    decisions: int = 0
    errors: int = 0
    violations: int = 0
    compared: int = 0
    unverified: int = 0
    token_rejected: int = 0
    not_finite: int = 0  # decisions on proposals with NaN or infinity
    decide_ms: float = 0.0
    answering: float = 0.0  # s

    def figures(self) -> dict[str, float]:
        mean = self.decide_ms / max(self.decisions, 1)
        return {
            "decisions": self.decisions,
            "errors": self.errors,
            "compared": self.compared,
            "violations": self.violations,
            "unverified": self.unverified,
            "token_rejected": self.token_rejected,
            "not_finite": self.not_finite,
            "decide_ms": mean,
        }


def batch_handler(
    models: ModelRegistry, counts: ServiceCounts, authenticator: PlanAuthenticator | None = None
) -> Callable[[bytes], bytes]:
    """The service's core: bytes of a RequestBatch to bytes of a ReplyBatch. Raises BadRequest for no batch at all.

    notary: who knows which plans were verified; without one (in process, and when a log is replayed) what requests say
    of theirs is believed.
    """

    def one(message: pb.Request, received: int, shared: FleetReservations | None = None) -> pb.Reply:
        try:
            chosen = models.method_for(message)
            believed = authenticator is None or authenticator.is_authentic(message, chosen.robot)
            if not believed:
                counts.token_rejected += 1
                message.model = UNVERIFIED
            if shared is None:
                request = request_of(message, chosen.robot)
            else:
                own = shared.reservations[message.actor]
                request = request_of(message, chosen.robot, own, shared.to(message.actor))
            queue_ms = (perf_counter_ns() - received) * 1e-6
            decision = chosen.decide(request)
        except (BadRequest, UnknownRobot) as error:
            counts.errors += 1
            return error_reply(error)
        except Exception as error:  # whatever it is, the robot brakes on an error reply, and the service goes on
            counts.errors += 1
            log.exception("decide failed for %s", message.actor or message.robot)
            return error_reply(error)
        counts.decisions += 1
        counts.decide_ms += decision.time_ms
        counts.compared += decision.compared
        counts.unverified += not decision.verified
        counts.not_finite += not request.finite
        if not decision.contained:
            counts.violations += 1
            log.warning("%s, step %d: outside the predicted set", message.actor or message.robot, message.step)
        if shared is not None and decision.reservation is not None:
            shared.reservations[message.actor] = decision.reservation
        reply = decision_reply(decision, queue_ms)
        reply.robot, reply.decision.token_rejected = chosen.robot.name, not believed
        if authenticator is not None and decision.verified:
            reply.decision.plan_tokens.extend(authenticator.plan_tokens(message, reply.decision, chosen.robot))
        return reply

    def committed(message: pb.Request) -> Reservation:
        """What a fleet's robot has promised; one that stands and has not: to go on standing."""
        method = models.method_for(message)
        if not isinstance(method, Filter):
            raise BadRequest("fleet", "only our own filter makes promises: the rivals predict nothing")
        robot = method.robot
        if robot.late:
            raise BadRequest("fleet", f"{robot.name}: what is asked in real time is decided too late for promises")
        if message.HasField("reservation"):
            return reservation_of(message.reservation, robot)
        request = request_of(message, robot)
        check_for_filter(robot, request)
        if not request.still(robot):
            raise BadRequest("reservation", f"{message.actor} moves and has promised nothing: nobody can keep off it")
        return method.standing_reservation(request.state)

    def answer(payload: bytes) -> bytes:
        received = perf_counter_ns()
        batch = batch_of(payload)
        replies: list[pb.Reply] = [pb.Reply()] * len(batch.requests)
        for world in group_by_fleet(batch.requests):
            members = [batch.requests[i] for i in world]
            try:
                shared = joint_request(members, committed) if members[0].fleet else None
            except (BadRequest, UnknownRobot) as error:
                counts.errors += len(members)
                for i in world:
                    replies[i] = error_reply(error)
                continue
            for i, request in zip(world, members, strict=True):
                replies[i] = one(request, received, shared)
        reply = pb.ReplyBatch(replies=replies, request=digest(payload)).SerializeToString()
        counts.answering += (perf_counter_ns() - received) * 1e-9
        return reply

    return answer


@dataclass(frozen=True)
class SafetySettings:
    bus: BusSettings
    models: tuple[Path, ...]  # model files, one a robot; each says which method it is of
    archive: Path | None = None  # where versions that come over the bus are kept
    name: str = "safety"
    limits: Mapping[str, float] = field(default_factory=dict)  # as those of `ModelRegistry`
    accept_bound: float | None = None
    secrets: Path | None = None  # folder with the key of vouchers, where the bus has no keys


def main(settings: SafetySettings) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        BadModel: a file is no model, or with keys none that is signed: a service without one would only refuse.
    """
    import brakeline.safety.filter.kernels.halfspace_kernels  # noqa: F401  # compiled, which takes seconds the first time: before it is seen to live

    keys = settings.bus.keys
    models, counts = ModelRegistry(settings.archive, settings.limits, settings.accept_bound), ServiceCounts()
    with Process(settings.bus, settings.name) as process:
        trust = TrustedSigners.load(keys) if keys is not None else None
        authenticator = PlanAuthenticator.of(keys or settings.secrets)
        for path in settings.models:
            if trust is None:
                models.install(load(path))
            else:
                models.install(trust.load_model(path), SignedModel.load(path))

        def replace(sample: Sample) -> None:
            try:
                said = sample.message()
                if trust is None:
                    raise Untrusted("models are taken over the bus by a service with keys only: who signed it?")
                signed = SignedModel(said.file, said.claim, said.signature)
                models.install(trust.open(signed, said.robot), signed)
            except (BadModel, BusError) as error:
                log.error("a model was refused: %s", error)
            except OSError as error:
                log.error("a model is in use but could not be archived: %s", error)

        before = perf_counter_ns() * 1e-9, 0.0  # when figures were last told, and how long it had answered by then

        def refresh() -> None:
            nonlocal before
            now = perf_counter_ns() * 1e-9, counts.answering
            busy = (now[1] - before[1]) / max(now[0] - before[0], 1e-9)
            before = now
            process.figures.update(counts.figures() | {"busy": busy})
            process.notes.update({f"model {name}": method.version for name, method in models.filters.items()})

        process.refresh = refresh
        process.bus.subscribe(MODEL, replace)
        process.bus.serve(DECIDE, batch_handler(models, counts, authenticator))
        process.announce()
        log.info("ready")
        process.stop.wait()
