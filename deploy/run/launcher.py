"""Starts the processes of a run on this machine, watches and restarts them, shows what happens, and ends them all."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.run.processes import CONFIG, LOG, places, say_where
from brakeline.deploy.run.run_config import RunConfig, encode
from brakeline.deploy.run.run_keys import KEYS, seal_models
from brakeline.deploy.run.run_view import View
from brakeline.deploy.run.supervisor import LaunchError, SupervisedProcess, last_line
from brakeline.logs.metrics import Metrics
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.watch.run_totals import run_totals, totals_to_health
from brakeline.messaging.bus import BusError, BusSettings, Sample
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import RejectedMessages, headline
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.messaging.topics import RECORDED
from brakeline.safety.service.plan_token import write_key

log = logging.getLogger("brakeline.launcher")

TURN = 0.1  # s
END_PATIENCE = 10.0  # s from SIGTERM to SIGKILL: a checkpoint may be in progress
RECORDER_PATIENCE = 30.0  # s until the run starts without a recorder: its disk may be full
HEARD_OUT = 2.0  # s that is waited for the last message at most
QUIET = 0.5  # s without a message after which the last one has come
FIGURES = "figures.json"


def prepare(config: RunConfig, folder: Path, resume: bool) -> None:
    """See that the folder can take the run, and that there are model sets.

    Raises:
        LaunchError: the folder holds another run; TooLoose: a model set states more than is used without a question.
    """
    if not resume and (folder / CONFIG).exists():
        raise LaunchError(f"{folder} holds a run already: give --resume {folder}, or another --out")
    if config.filtered:
        for robot in config.robots:
            method_for(robot_maybe_with_task(robot), config.method, config.model_config, config.accept_bound)
    folder.mkdir(parents=True, exist_ok=True)


class Launcher:
    """A run from its first process to its last."""

    def __init__(self, config: RunConfig, folder: Path, bus: BusSettings) -> None:
        """bus: where it listens, and the keys of all processes, if they have any."""
        self.config, self.folder, self.bus = config, folder, bus
        self.children = [SupervisedProcess(place, folder) for place in places(config)]
        self.metrics = Metrics(robots=RecordedRobots(robot_named(name) for name in config.robots))
        self.lines: deque[str] = deque(maxlen=200)
        self._inbox: deque[Sample] = deque()
        self._rejected = RejectedMessages()  # the bus's, once there is one

    def run(self, show: Callable[[View], Any] = lambda view: None) -> dict[str, Any]:
        """Until the learners are done or SIGINT or SIGTERM; returns the figures, also saved in the run's folder.

        Raises:
            LaunchError: a process fails again and again; the others were ended in order.
            Unreachable: the endpoint cannot be listened on.
        """
        view = View(self.config, self.folder, self.metrics, self.children, self.lines)
        failure: LaunchError | None = None
        with Process(self.bus, "launcher", stderr=False, reserved=True) as process:
            self._rejected = process.bus.rejected
            self._claim_folder()
            for topic in RECORDED:
                process.bus.subscribe(topic, self._inbox.append)
            process.refresh = lambda: self._tell(process)
            try:
                if self.config.record:
                    self._start_recorder(process, lambda: show(view))
                process.announce()
                while not process.stop.is_set() and not self.finished:
                    for child in self.children:
                        if not self._must_wait(child):
                            child.watch()
                    self._drain()
                    show(view)
                    process.stop.wait(TURN)
            except LaunchError as error:
                failure = error
                log.error("%s", error)
            finally:
                view.ending = True
                show(view)
                self._end()
                self._drain()
                outcome = "finished" if self.finished else "stopped before its last step"
                process.notes["outcome"] = f"failed: {failure}" if failure is not None else outcome
        self._drain()
        figures = self.figures()
        (self.folder / FIGURES).write_text(json.dumps(figures, indent=2))
        if failure is not None:
            raise failure
        return figures

    def _tell(self, process: Process) -> None:
        """Of the whole run, with each sign of life: who watches may have come in its middle."""
        config = self.config
        process.figures.update({f"restarts {child.place.name}": child.restarts for child in self.children})
        process.figures.update(totals_to_health(run_totals(self.metrics)))
        process.notes.update(
            {
                "run": self.folder.name,
                "method": config.method,
                "arena": config.arena,
                "seed": str(config.seed),
                "steps": str(config.steps * len(config.robots)),
            }
        )

    def figures(self) -> dict[str, Any]:
        """As `analyse` would give them for the log, with what only the launcher knows."""
        setup = {
            "method": self.config.method,
            "certificate": self.config.model_config.certificate if self.config.method == "ddpc" else None,
            "policy": self.config.policy or "learning",
            "arena": self.config.arena,
            "seed": self.config.seed,
        }
        restarts = {child.place.name: child.restarts for child in self.children if child.restarts}
        log_path = str(self.folder / LOG) if self.config.record else None
        paths = {"folder": str(self.folder), "log": log_path, "policies": self.policies()}
        return (
            setup
            | self.metrics.figures()
            | {"finished": self.finished, "restarts": restarts}
            | self._from_logs()
            | paths
        )

    @property
    def finished(self) -> bool:
        """Have all learners done their work (where nobody learns, the robots)? Then nobody needs the others. Offline
        they may be a few steps short of it when the logs end: what a learner that was interrupted had not saved."""
        kinds = ("learner", "feeder", "actor")
        done = {kind: [c.finished for c in self.children if c.place.kind == kind] for kind in kinds}
        if self.config.policy:
            return all(done["actor"])
        return all(done["learner"]) or (self.config.actors == 0 and all(done["feeder"]))

    def _must_wait(self, child: SupervisedProcess) -> bool:
        """Robots start when what the logs hold of their kind was learned from."""
        feeders = (c for c in self.children if c.place.kind == "feeder" and c.place.robot == child.place.robot)
        return child.place.kind == "actor" and not all(feeder.finished for feeder in feeders)

    def _from_logs(self) -> dict[str, Any]:
        """What was learned from logs, if anything was to be."""
        if not self.config.from_logs:
            return {}
        fed: Counter[str] = Counter()
        for child in self.children:
            process = self.metrics.processes.get(child.place.name)
            if child.place.kind == "feeder" and process is not None:
                fed.update({name: int(count) for name, count in process.figures.items()})
        return {"from_logs": {"logs": list(self.config.from_logs)} | dict(fed)}

    def policies(self) -> list[str]:
        """The policy files that were saved."""
        return [str(path) for path in sorted(self.folder.glob("learner*/policy.safetensors"))]

    def _claim_folder(self) -> None:
        """Write what the processes read, and that this is the latest run."""
        (self.folder / CONFIG).write_text(encode(self.config))
        say_where(self.folder, self.bus)
        if self.bus.keys is None:
            write_key(self.folder / KEYS)  # a plan that one service verified is so for the next
        else:
            seal_models(self.config, self.folder, self.bus.keys)
        latest = self.folder.parent / "latest"
        if latest.is_symlink() or not latest.exists():
            latest.unlink(missing_ok=True)
            latest.symlink_to(self.folder.name)

    def _start_recorder(self, process: Process, show: Callable[[], Any]) -> None:
        """The recorder first, and not a word, of the launcher's either, before it listens: no message shall be missing
        in the log."""
        recorder = self.children[0]
        deadline = time.monotonic() + RECORDER_PATIENCE
        while not process.stop.is_set() and time.monotonic() < deadline:
            recorder.watch()
            self._drain()
            show()
            known = self.metrics.processes.get("recorder")
            if known is not None and known.notes.get("file"):
                break
            process.stop.wait(0.05)
        else:
            if not process.stop.is_set():
                log.error("the recorder does not record: %s", last_line(self.folder / "logs" / "recorder.log"))

    def _drain(self) -> None:
        while self._inbox:
            sample = self._inbox.popleft()
            with self._rejected.skip_on_error(sample.key):
                message = sample.message()
                self.metrics.add(sample.key, message)
                if sample.topic.name == "health":
                    for child in self.children:
                        if child.place.name == message.process:
                            child.heard(message.pid)
                if sample.topic.name == "log" and message.level in ("WARNING", "ERROR"):
                    self.lines.append(f"{message.process}: {headline(message.text)}")

    def _end(self) -> None:
        """Actors first, so that none is left without answers; the recorder last, so that all last words are logged."""
        recorders = [child for child in self.children if child.place.kind == "recorder"]
        actors = [child for child in self.children if child.place.kind == "actor"]
        others = [child for child in self.children if child not in (*recorders, *actors)]
        for group in filter(None, (actors, others, recorders)):
            for child in group:
                child.terminate()
            deadline = time.monotonic() + END_PATIENCE
            while any(child.alive for child in group) and time.monotonic() < deadline:
                self._drain()
                time.sleep(0.02)
            for child in group:
                child.end(deadline)
            self._hear_out()

    def _hear_out(self) -> None:
        """Wait for the last words of those who have ended; who still lives may go on talking."""
        now = time.monotonic()
        quiet, patience = now + QUIET, now + HEARD_OUT
        while time.monotonic() < min(quiet, patience):
            if self._inbox:
                quiet = time.monotonic() + QUIET
            self._drain()
            time.sleep(0.02)


__all__ = ["BusError", "LaunchError", "Launcher", "View", "prepare"]
