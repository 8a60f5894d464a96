"""PROCESS: the safety service. It keeps nothing about a robot between two queries, so replicas may run side by side."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from time import perf_counter_ns

from brakeline.errors import BadModel, BadRequest, BusError, NoModel, StaleModel, UnknownRobot, Untrusted
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import REAL_TIME_SUFFIX, refuse_shipped_name, shipped_robots
from brakeline.messaging.topics import DECIDE, MODEL
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import check_for_filter
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.methods import Method, Model, load, ready
from brakeline.safety.model.stated_bound import check_bound
from brakeline.safety.service.joint_request import FleetReservations, group_by_fleet, joint_request
from brakeline.safety.service.plan_token import PlanAuthenticator
from brakeline.safety.service.request_digest import digest
from brakeline.safety.service.signature import SignedModel, TrustedSigners
from brakeline.safety.service.wire import batch_of, decision_reply, error_reply, request_of, reservation_of

log = logging.getLogger("brakeline.safety")


@dataclass
class ModelRegistry:
    """The method in use for each robot, and all versions that have been in use.

    Attributes:
        archive: folder for every installed version; None: no archive.
        limits: largest accepted bound of a validation report, by the robot's name. Defaults to the limit in the
            description that the model set holds.
        accept_bound: largest bound that the user accepts explicitly, in place of `limits`.
        filters: the method in use, by the robot's name.
        known: versions that have been in use.
    """

    archive: Path | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    accept_bound: float | None = None
    filters: dict[str, Method] = field(default_factory=dict)
    known: set[str] = field(default_factory=set)
    _lock: Lock = field(default_factory=Lock)

    def install(self, model: Model, signed: SignedModel | None = None) -> None:
        """Use a model from now on. Running decisions finish with the model before.

        Args:
            model: a model set or a rival's model.
            signed: the signed file that it comes from, for the archive.

        Raises:
            BadModel: the model does not fit its robot, or uses the name of another robot that Brakeline ships.
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
            self.filters[model.robot.name] = method
            self.known.add(method.version)
        log.info("%s: model %s in use (%s)", model.robot.name, method.version, type(method).__name__)
        if self.archive is not None:
            (signed or model).save(archive_path(self.archive, model.robot.name, method.version))

    def method_for(self, request: pb.Request) -> Method:
        """Return the method for a request. Raises UnknownRobot, NoModel or StaleModel."""
        method = self.filters.get(request.robot)
        if method is None:
            if request.robot.removesuffix(REAL_TIME_SUFFIX) not in shipped_robots():
                raise UnknownRobot(f"no robot is called {request.robot!r:.80} here")
            have = ", ".join(self.filters) or "none"
            raise NoModel("robot", f"no model of {request.robot} is loaded (loaded: {have})")
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


def archive_path(archive: Path, robot: str, version: str) -> Path:
    """Return the path of a version in the archive."""
    return archive / robot / "models" / f"{version}.safetensors"


@dataclass
class ServiceCounts:
    """Counters of a running service, for its health messages."""

    decisions: int = 0
    errors: int = 0
    violations: int = 0
    compared: int = 0
    unverified: int = 0
    token_rejected: int = 0
    not_finite: int = 0  # decisions on proposals with NaN or infinity
    decide_ms: float = 0.0
    busy_time: float = 0.0  # s

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
    """Return the service's core: a function from the bytes of a RequestBatch to the bytes of a ReplyBatch.

    The function raises BadRequest for bytes that are not a batch.

    Args:
        models: the methods in use.
        counts: to count in.
        authenticator: checks the plan tokens. Without one (in process, or when a log is replayed), every plan counts as
            verified by the model that the request names.
    """

    def decide(message: pb.Request, received: int, shared: FleetReservations | None = None) -> pb.Reply:
        try:
            method = models.method_for(message)
            authentic = authenticator is None or authenticator.is_authentic(message, method.robot)
            if not authentic:
                counts.token_rejected += 1
                message.model = UNVERIFIED
            if shared is None:
                request = request_of(message, method.robot)
            else:
                own = shared.reservations[message.actor]
                request = request_of(message, method.robot, own, shared.to(message.actor))
            queue_ms = (perf_counter_ns() - received) * 1e-6
            decision = method.decide(request)
        except (BadRequest, UnknownRobot) as error:
            counts.errors += 1
            return error_reply(error)
        except Exception as error:  # the robot brakes on the error reply, and the service goes on
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
        reply.robot, reply.decision.token_rejected = method.robot.name, not authentic
        if authenticator is not None and decision.verified:
            reply.decision.plan_tokens.extend(authenticator.plan_tokens(message, reply.decision, method.robot))
        return reply

    def current_reservation(message: pb.Request) -> Reservation:
        """Return the reservation of a fleet's robot. One that stands without it reserves the space it stands in."""
        method = models.method_for(message)
        if not isinstance(method, Filter):
            raise BadRequest("fleet", "only the filter makes reservations: the rivals predict nothing")
        robot = method.robot
        if robot.late:
            raise BadRequest(
                "fleet", f"{robot.name}: a robot in real time gets its decisions too late for reservations"
            )
        if message.HasField("reservation"):
            return reservation_of(message.reservation, robot)
        request = request_of(message, robot)
        check_for_filter(robot, request)
        if not request.still(robot):
            raise BadRequest(
                "reservation", f"{message.actor} moves without a reservation: no robot can keep away from it"
            )
        return method.standing_reservation(request.state)

    def answer(payload: bytes) -> bytes:
        received = perf_counter_ns()
        batch = batch_of(payload)
        replies: list[pb.Reply] = [pb.Reply()] * len(batch.requests)
        for world in group_by_fleet(batch.requests):
            members = [batch.requests[i] for i in world]
            try:
                shared = joint_request(members, current_reservation) if members[0].fleet else None
            except (BadRequest, UnknownRobot) as error:
                counts.errors += len(members)
                for i in world:
                    replies[i] = error_reply(error)
                continue
            for i, request in zip(world, members, strict=True):
                replies[i] = decide(request, received, shared)
        reply = pb.ReplyBatch(replies=replies, request=digest(payload)).SerializeToString()
        counts.busy_time += (perf_counter_ns() - received) * 1e-9
        return reply

    return answer


@dataclass(frozen=True)
class SafetySettings:
    """Settings of the process.

    Attributes:
        bus: how to join the bus.
        models: model files, one for each robot.
        archive, limits, accept_bound: of `ModelRegistry`.
        name: of the process.
        secrets: folder with the key of the plan tokens, on a bus without keys.
    """

    bus: BusSettings
    models: tuple[Path, ...]
    archive: Path | None = None
    name: str = "safety"
    limits: Mapping[str, float] = field(default_factory=dict)
    accept_bound: float | None = None
    secrets: Path | None = None


def main(settings: SafetySettings) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        BadModel: a file holds no model, or is not signed on a bus with keys.
    """
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
                models.install(trust.load_model(path), SignedModel.load(path))

        def replace(sample: Sample) -> None:
            try:
                message = sample.message()
                if trust is None:
                    raise Untrusted("without keys, a service takes no models over the bus: it cannot check signatures")
                signed = SignedModel(message.file, message.claim, message.signature)
                models.install(trust.open(signed, message.robot), signed)
            except (BadModel, BusError) as error:
                log.error("a model was refused: %s", error)
            except OSError as error:
                log.error("a model is in use but could not be archived: %s", error)

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
        process.bus.serve(DECIDE, batch_handler(models, counts, authenticator))
        process.announce()
        log.info("ready")
        process.stop.wait()
