"""Start the processes of a run on this machine, supervise them, and end them in order."""

from __future__ import annotations

import json
import logging
import os
import time
from collections import Counter, deque
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from brakeline.deploy.run.processes import CONFIG, LOG, process_specs, write_endpoint
from brakeline.deploy.run.resumption import check_resumable
from brakeline.deploy.run.run_config import RunConfig, encode
from brakeline.deploy.run.run_keys import KEYS, check_adaptable, check_signer, sign_models
from brakeline.deploy.run.run_lock import only_launcher
from brakeline.deploy.run.run_models import models_of_new_run, models_of_resumed_run
from brakeline.deploy.run.supervisor import SupervisedProcess, last_line
from brakeline.deploy.run.verdict import LatestEpisodes
from brakeline.errors import LaunchError, LogError
from brakeline.logs.json_values import finite
from brakeline.logs.metrics import Metrics
from brakeline.logs.reader import count_by_key
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.run_figures import FIGURES
from brakeline.logs.watch.run_history import NOTE, RunHistory, history_to_note, run_totals, totals_to_health
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import RejectedMessages, headline
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import robot_with_task
from brakeline.messaging.topics import HEALTH, RECORDED
from brakeline.messaging.topics import LOG as LOG_LINES
from brakeline.safety.methods import Model
from brakeline.safety.service.plan_token import write_key

log = logging.getLogger("brakeline.launcher")

PERIOD = 0.1  # s between two looks at the processes
TERMINATION_TIMEOUT = 10.0  # s from SIGTERM to SIGKILL: a process may be writing a checkpoint
RECORDER_TIMEOUT = 30.0  # s after which the run starts without a recorder, whose disk may be full
UNBEGUN_TIMEOUT = 0.5  # s, the same for a run in which nothing has begun
LAST_MESSAGES_TIMEOUT = 2.0  # s, longest wait for the last messages of processes that have ended
SILENCE = 0.5  # s without a message after which the launcher takes the last message to have arrived
SEGMENTS = f"{Path(LOG).stem}*{Path(LOG).suffix}"  # the files of a log


def prepare(config: RunConfig, folder: Path, resume: bool) -> RunConfig:
    """Make the run's folder, with the models that the run begins with, and those models if there are none.

    Returns:
        The configuration to run: of a new run, with the mode of its model sets.

    Raises:
        LaunchError: the folder holds another run. Or the run to resume has lost its checkpoint, or has more steps than
            `config`.
        DamagedPart: the checkpoint of the run to resume is lost in part.
        BadModel: the folder of a resumed run lacks a model, or a vehicle that is not simulated here has no model set.
        TooLoose: the stated bound of a model set is above the accepted one.
        ModuleNotFoundError: a process of the run needs a package that is not installed.
        ValueError: the run adapts, and a model set is of mode recursion or of a rival. Or a robot's simulator does not
            have one of the conditions.
    """
    _check_packages(config)
    if not resume and (folder / CONFIG).exists():
        raise LaunchError(f"{folder} holds a run already: give --resume {folder}, or another --out")
    if resume and not config.policy:
        check_resumable(config, folder)
    if config.conditions.unusual:
        _check_conditions(config)
    models: list[Model] = []
    if config.filtered and resume:
        models = models_of_resumed_run(config, folder)
    elif config.filtered:
        config, models = models_of_new_run(config, folder)
    for model in models if config.adapt else ():
        check_adaptable(model)
    folder.mkdir(parents=True, exist_ok=True)
    return config


def _check_packages(config: RunConfig) -> None:
    """Raise ModuleNotFoundError if a process of the run would end for lack of a package."""
    for package, used in (("torch", not config.policy), ("pymavlink", bool(config.flights))):
        if used and find_spec(package) is None:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)


def _check_conditions(config: RunConfig) -> None:
    """Raise ValueError if the simulator of a robot would ignore one of the conditions."""
    if config.flights and config.autopilot is None:
        config.conditions.check()  # nothing of a vehicle behind a link is simulated here
    from brakeline.sim.delayed_vehicle import simulated_vehicle  # brings the simulator: only where it is asked

    for robot in config.robots:
        simulated_vehicle(robot_with_task(robot), config.conditions)


class Launcher:
    """A run from its first process to its last.

    Attributes:
        metrics: the figures so far.
        lines: the latest warnings.
        ending: whether the launcher ends the processes.
    """

    def __init__(self, config: RunConfig, folder: Path, bus: BusSettings) -> None:
        """bus: the endpoint to listen on, and the folder with the keys of all processes, if they have any."""
        if config.adapt:
            check_signer(bus.keys)
        self.config, self.folder, self.bus = config, folder, bus
        self.processes = [SupervisedProcess(spec, folder) for spec in process_specs(config)]
        self.latest = LatestEpisodes()
        self.metrics = Metrics(robots=RecordedRobots(robot_named(name) for name in config.robots))
        self.lines: deque[str] = deque(maxlen=200)
        self.ending = False
        self._history = RunHistory()
        self._earlier: set[Path] = set()  # files of the log from before a resumption
        self._resumed = False  # then the figures count from the resumption on
        self._inbox = Inbox()
        self._lacks_messages = False  # because the inbox was full
        self._rejected = RejectedMessages()  # replaced by that of the bus when the run starts

    def run(self, show: Callable[[Launcher], Any] = lambda run: None) -> dict[str, Any]:
        """Run until the learners are done, SIGINT or SIGTERM. Returns the figures, and saves them in the run's folder.

        Args:
            show: is called several times a second with this launcher.

        Raises:
            LaunchError: the run is running already. Or a process failed several times in a row, or cannot go on; the
                launcher has ended the others.
            Unreachable: the launcher can't listen on the endpoint.
        """
        failure: LaunchError | None = None
        with (
            only_launcher(self.folder),
            Process(self.bus, "launcher", stderr=False, reserved=True) as process,
        ):
            self._rejected = process.bus.rejected
            self._claim_folder()
            for topic in RECORDED:
                process.bus.subscribe(topic, self._inbox.put)
            process.refresh = lambda: self._update_health(process)
            try:
                if self.config.record:
                    self._start_recorder(process, lambda: show(self))
                process.announce()
                while not process.stop.is_set() and not self.finished:
                    for child in self.processes:
                        if not self._must_wait(child):
                            child.supervise()
                    self._drain()
                    if not self._inbox:
                        for child in self.processes:
                            child.end_if_silent()
                    show(self)
                    process.stop.wait(PERIOD)
            except LaunchError as error:
                failure = error
                log.error("%s", error)
            finally:
                self.ending = True
                show(self)
                self._end()
                self._drain()
                outcome = "finished" if self.finished else "stopped before its last step"
                process.notes["outcome"] = f"failed: {failure}" if failure is not None else outcome
        self._drain(LAST_MESSAGES_TIMEOUT)
        figures = self.figures()
        self._save(figures)
        if failure is not None:
            raise failure
        return figures

    def _save(self, figures: dict[str, Any]) -> None:
        """Save the figures in the run's folder. A number that is not finite, such as a diverged loss, becomes null."""
        try:
            write_atomically(self.folder / FIGURES, json.dumps(finite(figures), indent=2, allow_nan=False).encode())
        except OSError as error:  # the caller shows them all the same
            log.error("the figures were not saved: %s", error)

    def _update_health(self, process: Process) -> None:
        """Put the totals of the run into each health message, for viewers that connect in its middle."""
        config, steps = self.config, self.config.steps * len(self.config.robots)
        process.figures.update({f"restarts {child.spec.name}": child.restarts for child in self.processes})
        totals = run_totals(self.metrics)
        self._history.add(totals)
        process.figures.update(totals_to_health(totals))
        process.notes[NOTE] = history_to_note(self._history.rows)
        process.notes.update(run=self.folder.name, method=config.method, arena=config.arena)
        process.notes.update(seed=str(config.seed), steps=str(steps))

    def figures(self) -> dict[str, Any]:
        """Return the figures that `analyse` computes from the log, and those that only the launcher knows.

        Those of a resumed run count from the resumption on; `analyse` counts the whole run.
        """
        setup = {
            "method": self.config.method,
            "certificate": self.config.model_config.certificate if self.config.method == "ddpc" else None,
            "policy": self.config.policy or "learning",
            "arena": self.config.arena,
            "seed": self.config.seed,
        }
        restarts = {child.spec.name: child.restarts for child in self.processes if child.restarts}
        outcome = {"finished": self.finished, "resumed": self._resumed, "restarts": restarts} | self._from_logs()
        paths = {
            "folder": str(self.folder),
            "log": str(self.folder / LOG) if self.config.record else None,
            "log_messages": self._log_messages() if self.config.record else None,
            "policies": [str(path) for path in sorted(self.folder.glob("learner*/policy.safetensors"))],
        }
        return setup | self.metrics.figures() | {"latest": self.latest.figures()} | outcome | paths

    def _log_messages(self) -> dict[str, Any]:
        """Return how many messages the log of this start of the run has, and how many more were published.

        The signs of life and log lines of the recorder and the launcher do not count: they go on after the log's end.
        """
        recorded: Counter[str] = Counter()
        recorder = self.metrics.processes.get("recorder")
        failures = [] if recorder is None or not recorder.notes.get("failure") else [recorder.notes["failure"]]
        for path in sorted(set(self.folder.glob(SEGMENTS)) - self._earlier):
            try:
                recorded += count_by_key(path)
            except (LogError, OSError) as error:
                failures.append(str(error))
        published: Counter[str] = Counter()
        for (key, _), stream in self.metrics.streams.items():
            published[key] += stream.published
        own = {topic.at(source=name) for topic in (HEALTH, LOG_LINES) for name in ("recorder", "launcher")}
        missing = sum(max(0, count - recorded[key]) for key, count in published.items() if key not in own)
        return {"recorded": recorded.total(), "missing": missing, "failures": failures}

    @property
    def finished(self) -> bool:
        """Whether all learners, or with a fixed policy all actors, have done their work.

        A run from logs alone has also finished when the logs end. Its learner may then lack a few steps, which an
        interrupted learner had not saved.
        """

        def done(kind: str) -> bool:
            return all(child.finished for child in self._of(kind))

        if self.config.policy:
            return done("actor")
        return done("learner") or (self.config.actors == 0 and done("feeder"))

    def _of(self, kind: str) -> list[SupervisedProcess]:
        return [child for child in self.processes if child.spec.kind == kind]

    def _must_wait(self, child: SupervisedProcess) -> bool:
        """Whether a process is an actor whose learner still learns from logs."""
        feeders = (feeder for feeder in self._of("feeder") if feeder.spec.robot == child.spec.robot)
        return child.spec.kind == "actor" and not all(feeder.finished for feeder in feeders)

    def _from_logs(self) -> dict[str, Any]:
        """Return the figures of learning from logs; empty for a run without."""
        if not self.config.from_logs:
            return {}
        steps: Counter[str] = Counter()
        for feeder in self._of("feeder"):
            if (process := self.metrics.processes.get(feeder.spec.name)) is not None:
                steps.update({name: int(count) for name, count in process.figures.items()})
        return {"from_logs": {"logs": list(self.config.from_logs)} | dict(steps)}

    def _claim_folder(self) -> None:
        """Write the files that the processes read, and make runs/latest point to this run."""
        self._earlier, self._resumed = set(self.folder.glob(SEGMENTS)), (self.folder / CONFIG).exists()
        write_atomically(self.folder / CONFIG, encode(self.config).encode())
        write_endpoint(self.folder, self.bus)
        if self.bus.keys is None:
            write_key(self.folder / KEYS)  # so that each service accepts the plans that another one verified
        else:
            sign_models(self.config, self.folder, self.bus.keys)
        _link_latest(self.folder.resolve())  # it may be given as runs/latest, which must not point to itself

    def _start_recorder(self, process: Process, show: Callable[[], Any]) -> None:
        """Start the recorder and wait until it listens, so that the log misses no message, not even the launcher's.

        The other processes import meanwhile.
        """
        recorder, *others = self.processes
        deadline = time.monotonic() + RECORDER_TIMEOUT
        while not process.stop.is_set() and time.monotonic() < deadline:
            recorder.supervise()
            for child in others:
                if child.popen is None and not self._must_wait(child):
                    child.start(held=True)
            self._drain()
            show()
            known = self.metrics.processes.get("recorder")
            if known is not None and known.notes.get("file"):
                break
            process.stop.wait(0.05)
        else:
            if not process.stop.is_set():
                message = last_line(self.folder / "logs" / "recorder.log")
                log.error("no recorder, so the run starts without a log: %s", message)
        if not process.stop.is_set():
            for child in others:
                child.release()

    def _drain(self, seconds: float = PERIOD) -> None:
        """Take in the received messages, for at most so long: a flood must not keep the launcher from its processes."""
        self._report_drops()
        for sample in self._inbox.drain(seconds):
            with self._rejected.skip_on_error(sample.key):
                message = sample.message()
                if self.metrics.add(sample.key, message, sample.received) and isinstance(message, pb.Step):
                    self.latest.step(message)
                if sample.topic.name == "health":
                    for child in self.processes:
                        if child.spec.name == message.process:
                            child.record_sign_of_life(message.pid)
                if sample.topic.name == "log" and message.level in ("WARNING", "ERROR"):
                    self.lines.append(f"{message.process}: {headline(message.text)}")

    def _report_drops(self) -> None:
        """Log once that the figures of the launcher lack messages."""
        if self._inbox.dropped and not self._lacks_messages:
            self._lacks_messages = True
            keys = ", ".join(key for key, _ in self._inbox.dropped.most_common(3))
            log.error("messages come faster than the launcher counts them, most at %s: its figures lack some", keys)

    def _end(self) -> None:
        """End the actors first, so that none lacks answers, and the recorder last, so that it logs all messages.

        If nothing has begun, end all of them at once: they still import, and there is nothing to lose.
        """
        self._drain()  # the first steps may have come since
        others = [child for child in self.processes if child.spec.kind not in ("actor", "recorder")]
        groups, patience = [self._of("actor"), others, self._of("recorder")], TERMINATION_TIMEOUT
        if not self._begun():
            groups, patience = [self.processes], UNBEGUN_TIMEOUT
        for group in filter(None, groups):
            for child in group:
                child.terminate()
            deadline = time.monotonic() + patience
            while any(child.alive for child in group) and time.monotonic() < deadline:
                self._drain()
                time.sleep(0.02)
            for child in group:
                child.end(deadline)
            if patience == TERMINATION_TIMEOUT:
                self._await_last_messages()

    def _begun(self) -> bool:
        """Return whether a robot has driven or a learner has learned, here or before; a vehicle may fly at any time."""
        before = self.config.flights or self._earlier
        return bool(before or self.metrics.actors or any(one.steps for one in self.metrics.learners.values()))

    def _await_last_messages(self) -> None:
        """Wait for the last messages of ended processes. Others may go on to publish."""
        now = time.monotonic()
        silent, deadline = now + SILENCE, now + LAST_MESSAGES_TIMEOUT
        while time.monotonic() < min(silent, deadline):
            if self._inbox:
                silent = time.monotonic() + SILENCE
            self._drain()
            time.sleep(0.02)


def _link_latest(folder: Path) -> None:
    """Make the link `latest` beside a run's folder point to it, atomically: another run may start now.

    A run goes on without the link, as on a disk that has no links, or in a folder beside which you may not write.
    """
    latest, new = folder.parent / "latest", folder.parent / f".latest.{os.getpid()}"
    if latest.is_symlink() or not latest.exists():
        try:
            new.unlink(missing_ok=True)
            new.symlink_to(folder.name)
            new.replace(latest)
        except OSError as error:
            log.warning("%s does not point to this run: %s", latest, error)
