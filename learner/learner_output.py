"""What a learner's process leaves behind: checkpoints, the policy's file, and metrics."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from brakeline.errors import CheckpointError
from brakeline.learner.checkpoint import CHECKPOINT, NOT_SAVED
from brakeline.learner.learner import Learner
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.policy_weights import POLICY
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.topics import LEARNER

log = logging.getLogger("brakeline.learner")

METRICS_PERIOD = 1.0  # [s]
RETRY = 30.0  # time to the next attempt after a failed checkpoint [s]


class LearnerOutput:
    """Writes the files of one learner to a folder, and publishes its metrics. A full disk does not end the run."""

    def __init__(self, process: Process, learner: Learner, out: Path) -> None:
        self._process, self._learner, self._out = process, learner, out
        self._metrics = process.bus.publisher(LEARNER, robot=learner.robot.name)
        self._metrics_at = self._retry_at = -1e9

    def save_if_due(self) -> None:
        """Write a checkpoint and the policy if it is time. Raises Diverged, as `save`."""
        if self._learner.checkpoint_due() and time.monotonic() > self._retry_at:
            self.save()

    def save(self) -> None:
        """Write a checkpoint and the policy; if that fails, log the reason and continue.

        Raises:
            Diverged: the weights are not finite; the files stay as they are.
        """
        try:
            place = self._learner.save(self._out / CHECKPOINT)
            self._process.notes["checkpoint"] = f"step {self._learner.steps}"
            log.info("checkpoint of step %d in %s", self._learner.steps, place)
        except CheckpointError as error:
            self._retry_at = time.monotonic() + RETRY
            self._process.notes["checkpoint"] = str(error)
            log.error("%s", error)
        self.write_policy()

    def write_policy(self) -> None:
        """Write the latest weights to the policy's file."""
        path = self._out / POLICY
        try:
            write_atomically(path, self._learner.weights().file)
            self._process.notes.pop(NOT_SAVED, None)
        except OSError as error:
            self._process.notes[NOT_SAVED] = f"{path}: {error}"
            log.error("the policy was not written: %s", error)

    def hurry(self) -> None:
        """Let the next metrics be due at once."""
        self._metrics_at = -1e9

    def publish_if_due(self, waiting: int = 0) -> None:
        """Publish the metrics if it is time. waiting: number of steps that the process has not taken in."""
        if time.monotonic() - self._metrics_at > METRICS_PERIOD:
            self.publish(waiting)

    def publish(self, waiting: int = 0) -> None:
        self._metrics_at = time.monotonic()
        metrics = self._learner.metrics()
        self._process.figures = {
            "steps": metrics.steps,
            "updates_per_s": metrics.updates_per_s,
            "missing": metrics.missing,
            "duplicates": metrics.duplicates,
            "refused": self._learner.rejected,
            "surplus": self._learner.surplus,
            "waiting": waiting,
        }
        self._metrics.put(metrics)
