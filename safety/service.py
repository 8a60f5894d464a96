"""PROCESS: answers `decide` queries; keeps nothing about any robot, so several may run side by side."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from time import perf_counter_ns

from messaging import brakeline_pb2 as pb
from messaging.bus import BusError, BusSettings, Sample
from messaging.process import Process
from messaging.robots import UnknownRobot, robot_named
from messaging.topics import DECIDE, MODEL
from safety.commitment import UNVERIFIED
from safety.methods import Method, Model, decode, load, ready
from safety.model_set import BadModel
from safety.request import BadRequest, StaleModel
from safety.wire import batch_of, error_of, message_of, request_of

log = logging.getLogger("brakeline.safety")


class NoModel(BadRequest):
    """No model of this robot is loaded."""


@dataclass
class Models:
    """The method in use for each robot, and every version there has been, with an archive folder if given."""

    archive: Path | None = None
    filters: dict[str, Method] = field(default_factory=dict)
    known: set[str] = field(default_factory=set)
    _lock: Lock = field(default_factory=Lock)

    def install(self, model: Model) -> None:
        """Put a model to use; requests in hand finish with the one before.

        Raises:
            BadModel: it does not fit its robot.
        """
        method = ready(model)
        with self._lock:
            self.filters[model.robot.name] = method
            self.known.add(method.version)
        log.info("%s: model %s in use (%s)", model.robot.name, method.version, type(method).__name__)
        if self.archive is not None:
            model.save(self.archive / model.robot.name / "models" / f"{method.version}.safetensors")

    def filter_for(self, request: pb.Request) -> Method:
        """Raises UnknownRobot, NoModel or StaleModel."""
        robot = robot_named(request.robot)
        method = self.filters.get(robot.name)
        if method is None:
            have = ", ".join(self.filters) or "none"
            raise NoModel("robot", f"no model of {robot.name} is loaded (loaded: {have})")
        vouched = request.model in ("", UNVERIFIED) or request.model in self.known
        if not vouched and not self._archived(robot.name, request.model):
            raise StaleModel("model", f"the plan was verified by model {request.model}, which was never in use here")
        return method

    def _archived(self, robot: str, version: str) -> bool:
        if self.archive is None or not version.isalnum():
            return False
        if (self.archive / robot / "models" / f"{version}.safetensors").exists():
            self.known.add(version)
            return True
        return False


@dataclass
class Counts:
    decisions: int = 0
    errors: int = 0
    violations: int = 0
    compared: int = 0
    unverified: int = 0
    decide_ms: float = 0.0

    def figures(self) -> dict[str, float]:
        mean = self.decide_ms / max(self.decisions, 1)
        return {
            "decisions": self.decisions,
            "errors": self.errors,
            "compared": self.compared,
            "violations": self.violations,
            "unverified": self.unverified,
            "decide_ms": mean,
        }


def answerer(models: Models, counts: Counts) -> Callable[[bytes], bytes]:
    """The service's core: bytes of a RequestBatch to bytes of a ReplyBatch. Raises BadRequest for no batch at all."""

    def one(message: pb.Request, received: int) -> pb.Reply:
        try:
            chosen = models.filter_for(message)
            request = request_of(message, chosen.robot)
            queue_ms = (perf_counter_ns() - received) * 1e-6
            decision = chosen.decide(request)
        except (BadRequest, UnknownRobot) as error:
            counts.errors += 1
            return error_of(error)
        except Exception as error:  # whatever it is, the robot brakes on an error reply, and the service goes on
            counts.errors += 1
            log.exception("decide failed for %s", message.actor or message.robot)
            return error_of(error)
        counts.decisions += 1
        counts.decide_ms += decision.time_ms
        counts.compared += decision.compared
        counts.unverified += not decision.verified
        if not decision.contained:
            counts.violations += 1
            log.warning("%s, step %d: outside the predicted set", message.actor or message.robot, message.step)
        return message_of(decision, queue_ms)

    def answer(payload: bytes) -> bytes:
        received = perf_counter_ns()
        batch = batch_of(payload)
        return pb.ReplyBatch(replies=[one(request, received) for request in batch.requests]).SerializeToString()

    return answer


@dataclass(frozen=True)
class SafetySettings:
    bus: BusSettings
    models: tuple[Path, ...]  # model files, one a robot; each says which method it is of
    archive: Path | None = None  # where versions that come over the bus are kept
    name: str = "safety"


def main(settings: SafetySettings) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        BadModel: a file is no model: a service without one would only refuse.
    """
    models, counts = Models(settings.archive), Counts()
    with Process(settings.bus, settings.name) as process:
        for path in settings.models:
            models.install(load(path))

        def replace(sample: Sample) -> None:
            try:
                models.install(decode(sample.message().file))
            except (BadModel, BusError) as error:
                log.error("a model was refused: %s", error)
            except OSError as error:
                log.error("a model is in use but could not be archived: %s", error)

        def refresh() -> None:
            process.figures.update(counts.figures())
            process.notes.update({f"model {name}": method.version for name, method in models.filters.items()})

        process.refresh = refresh
        process.bus.subscribe(MODEL, replace)
        process.bus.serve(DECIDE, answerer(models, counts))
        log.info("ready")
        process.stop.wait()
