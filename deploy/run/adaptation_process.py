"""PROCESS: the certifier. It receives the steps of all robots, and publishes a new model set after they changed."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import connection
from pathlib import Path

from brakeline.deploy.interpreter import ONE_THREAD, end_with_spawner, spawning
from brakeline.deploy.run.adaptation import WAITING, Adaptation, Recertification
from brakeline.deploy.run.processes import CERTIFIER, UNFINISHED
from brakeline.errors import BadModel, BrakelineError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.messaging.topics import EXCHANGE, MODEL, STEP
from brakeline.safety.methods import archive_path
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.signature import ModelSigner

log = logging.getLogger("brakeline.certifier")

PERIOD = 0.5  # s between two checks for messages
MOST_TAKING = 10.0  # s, the longest time in which it takes in the messages that waited during a fit
START_ALLOWANCE, TERMINATION_TIMEOUT = 60.0, 10.0  # s, of a certifier beside a safety service
NOTE = "adaptation"  # of Health, with the robot's name: the result of the last attempt


@dataclass(frozen=True)
class CertifierSettings:
    """Settings of the process.

    Attributes:
        bus: how to join the bus. Its folder of keys has the key that signs models.
        robots: names, or paths of robot descriptions.
        archive: folder in which the safety services keep every version.
        accept_bound: of `Adaptation`.
    """

    bus: BusSettings
    robots: tuple[str, ...]
    archive: Path
    accept_bound: float | None = None
    name: str = CERTIFIER


def main(settings: CertifierSettings) -> None:
    """Follow the robots until SIGINT or SIGTERM. After a failure, the robots keep the model set in use.

    Raises:
        Untrusted: there is no key to sign with.
    """
    signer = ModelSigner.load(settings.bus.keys or Path())
    with Process(settings.bus, settings.name) as process:
        robots = [robot_maybe_with_task(name) for name in settings.robots]
        kinds = {robot.name: _adaptation(robot, settings) for robot in robots}
        inbox = Inbox()
        for topic in (STEP, EXCHANGE):
            process.bus.subscribe(topic, inbox.put)
        # In a thread, so that a fit does not delay the end of the process.
        worker = threading.Thread(target=_run, args=(inbox, kinds, signer, process), name="certifier", daemon=True)
        worker.start()
        process.announce()
        log.info("ready")
        process.stop.wait()
    _end(worker)


def _end(worker: threading.Thread) -> None:
    """Wait for the worker. If it is in a fit, end the process at once.

    If the interpreter shut down while compiled code runs, it could abort the process and print what the code leaks.
    """
    worker.join(PERIOD)
    if worker.is_alive():
        logging.shutdown()
        os._exit(UNFINISHED)


def _adaptation(robot: Robot, settings: CertifierSettings) -> Adaptation:
    def in_use(version: str) -> ModelSet:
        if not version.isalnum():
            raise BadModel(f"no version is called {version!r:.40}")
        return ModelSet.load(archive_path(settings.archive, robot.name, version))

    return Adaptation(robot, in_use, settings.accept_bound)


def _run(inbox: Inbox, kinds: dict[str, Adaptation], signer: ModelSigner, process: Process) -> None:
    while not process.stop.wait(PERIOD):
        take_in = partial(_take_in, inbox, kinds, process)
        take_in()
        for kind in kinds.values():
            _attempt_if_due(kind, take_in, signer, process)


def _take_in(inbox: Inbox, kinds: dict[str, Adaptation], process: Process) -> None:
    """Give the received messages to the robot kinds that they are about."""
    for sample in inbox.drain(MOST_TAKING):
        with process.bus.rejected.skip_on_error(sample.key):
            message = sample.message()
            if isinstance(message, pb.Step) and message.robot in kinds:
                kinds[message.robot].step(message)
            elif isinstance(message, pb.Exchange) and message.request.robot in kinds:
                kinds[message.request.robot].exchange(message, time.monotonic())


def _attempt_if_due(kind: Adaptation, take_in: Callable[[], None], signer: ModelSigner, process: Process) -> None:
    """Make an attempt for a robot kind, if it is due. An error ends the attempt, and nothing else.

    take_in: gives the received messages to the kinds. After a fit, they show whether another set came into use.
    """
    name = kind.robot.name
    try:
        if (attempt := kind.attempt()) is not None:
            take_in()
            _report_result(kind.confirmed(attempt), kind.robot, signer, process)
        _report_progress(kind, process)
        process.figures[f"widening {name}"] = kind.widening
        process.figures[f"minutes since the change {name}"] = kind.since_change
    except Exception as error:
        process.notes[f"{NOTE} {name}"] = f"none: {type(error).__name__}: {error}"
        log.exception("%s: no new model set, because of an error", name)


def _report_progress(kind: Adaptation, process: Process) -> None:
    """Note how much driving since a change is missing, in place of the last attempt's note; log begin and end."""
    note, progress, name = f"{NOTE} {kind.robot.name}", kind.progress, kind.robot.name
    waited = process.notes.get(note, "").startswith(WAITING)
    if progress:
        process.notes[note] = progress
    elif waited:
        del process.notes[note]
    if bool(progress) != waited:
        log.info("%s: %s", name, progress or "no longer waiting for driving after a change")
    process.figures[f"plans since the change {name}"] = float(kind.plans_since_change)
    process.figures[f"plans needed {name}"] = float(kind.plans_needed)


def _report_result(attempt: Recertification, robot: Robot, signer: ModelSigner, process: Process) -> None:
    """Note and log the result of an attempt. Publish its model set, if it has one."""
    process.notes[f"{NOTE} {robot.name}"] = attempt.text
    count = f"{'refused' if attempt.model is None else 'published'} {robot.name}"
    process.figures[count] = process.figures.get(count, 0.0) + 1.0
    if attempt.model is not None:
        signed = signer.sign(attempt.model, attempt.data)
        message = pb.Model(robot=robot.name, version=attempt.model.version, file=signed.file)
        message.claim, message.signature = signed.claim, signed.signature
        process.bus.publisher(MODEL, robot=robot.name).put(message)
    log.info("%s: new model set: %s", robot.name, attempt.text)
    process.announce()


@contextmanager
def certifier_beside(settings: CertifierSettings) -> Iterator[None]:
    """Run the certifier in a process of its own until the end of the block, or of this process.

    settings: their `bus` is that of this process, which may be a router.
    """
    bus = settings.bus
    here = tuple(endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for endpoint in bus.listen)
    client = replace(bus, connect=bus.connect or here, listen=(), metrics="", patience=START_ALLOWANCE)
    os.environ |= ONE_THREAD  # of the certifier; NumPy of this process has its threads already
    process = spawning().Process(target=_start_beside, args=(replace(settings, bus=client),), daemon=True)
    process.start()
    leaving = threading.Event()
    threading.Thread(target=_report_end, args=(process.sentinel, leaving), name="certifier", daemon=True).start()
    try:
        yield
    finally:
        leaving.set()
        process.terminate()
        process.join(TERMINATION_TIMEOUT)
        process.kill()


def _report_end(sentinel: int, leaving: threading.Event) -> None:
    """Log an error if a certifier ends before the service beside it does: nothing starts it again.

    ^C in a terminal reaches both, and the service takes longer to end. So wait before you log.
    """
    connection.wait([sentinel])
    if not leaving.wait(TERMINATION_TIMEOUT):
        log.error("the certifier has ended: the robots keep the model set in use until you start this service again")


def _start_beside(settings: CertifierSettings) -> None:
    if not end_with_spawner():
        return
    os.nice(10)  # decisions of the service come first
    try:
        main(settings)
    except BrakelineError as error:
        print(f"{settings.name}: {type(error).__name__}: {error}", file=sys.stderr)
