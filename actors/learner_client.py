"""An actor's link to the learner: join it, hold its newest weights, and take no more steps than it permits."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from google.protobuf.message import DecodeError

from brakeline.errors import BadMessage, BadWeights, BusError, Implausible, RefusedByLearner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, Sample
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import FLOW, JOIN, WEIGHTS

log = logging.getLogger("brakeline.actor")

JOIN_TIMEOUT = 2.0  # s
REJOIN_AFTER = 2.0  # s without permission: the learner may have missed the last step
MOST_VERSIONS_AHEAD = 1000  # of published weights; an actor that is farther behind joins the learner again
MOST_STEPS_AHEAD = 10_000  # that a learner may permit at once
LOG_INTERVAL = 10.0  # s between two log lines while there is no learner


class LearnerClient:
    """The link of one actor to the learner."""

    def __init__(self, bus: Bus, robot: RobotWithTask, actor: str, lockstep: bool = False) -> None:
        """lockstep: whether each step needs the very weights that the learner names."""
        self.bus, self.robot, self.actor, self.lockstep = bus, robot, actor, lockstep
        self.policy: MLP | None = None  # the newest; None before the first join
        self.flow = pb.Flow()  # the learner's latest message about permissions
        self.earlier_steps = 0  # of this actor before its restart, as the learner counted them
        self._incarnation = 0  # of the learner that accepted this actor; 0: none
        self._index = 0  # of the latest step that this actor waited for
        self._doubtful = False  # whether a message contradicts our learner, so that we have to join again
        self._changed = threading.Condition()
        bus.subscribe(WEIGHTS, self._on_weights, robot=robot.name)
        bus.subscribe(FLOW, self._on_flow, robot=robot.name)

    @property
    def done(self) -> bool:
        return self.flow.done

    @property
    def joined(self) -> bool:
        """Whether the learner that accepted this actor still runs, and no message contradicts that."""
        return self.flow.incarnation == self._incarnation and not self._doubtful

    def join(self, index: int, episode: int, stop: Callable[[], bool]) -> int | None:
        """Wait until a learner accepts this actor.

        Args:
            index: number of steps so far.
            episode: the next episode by the actor's own count.
            stop: ends the wait when it returns true.

        Returns:
            The episode to go on with; None after a stop.

        Raises:
            RefusedByLearner: with the learner's reason.
        """
        message = pb.Join(
            robot=self.robot.name, actor=self.actor, layout=self.robot.learning_layout(), index=index, episode=episode
        )
        log_at = 0.0
        while not stop():
            try:
                reply = self._ask_to_join(message)
            except (BusError, BadMessage) as error:
                if time.monotonic() >= log_at:
                    log.info("%s waits for a learner: %s", self.actor, error)
                    log_at = time.monotonic() + LOG_INTERVAL
                time.sleep(0.2)
                continue
            with self._changed:
                if not self._incarnation:
                    self.earlier_steps = max(reply.steps - index, 0)
                self.flow, self._index, self._doubtful = reply.flow, index, False
                self._incarnation = reply.flow.incarnation
                self._take(reply.weights, joining=True)
            return reply.episode
        return None

    def _ask_to_join(self, join: pb.Join) -> pb.JoinReply:
        """Return a learner's reply.

        Raises:
            BusError: no learner answers.
            BadMessage: the reply is damaged. Ask again: the learner answers the same join twice.
            RefusedByLearner: with the learner's reason.
        """
        payload = self.bus.ask(JOIN, join.SerializeToString(), JOIN_TIMEOUT, robot=self.robot.name)
        try:
            reply = pb.JoinReply.FromString(payload)
        except DecodeError as error:
            raise BadMessage(f"its reply cannot be read ({error})") from error
        if reply.HasField("error"):
            raise RefusedByLearner(f"{reply.error.field}: {reply.error.message}")
        if not (reply.HasField("flow") and reply.HasField("weights")):
            raise BadMessage("its reply has no weights, or no permissions")
        return reply

    def wait(self, index: int, episode: int, stop: Callable[[], bool]) -> bool:
        """Wait for permission for step number `index`. Return False if the run is over or `stop` returned true."""
        since, self._index = time.monotonic(), index
        if not self._permitted(index):
            self.bus.flush()  # the learner permits further steps when it has these
        while not stop() and not self.flow.done:
            with self._changed:
                if self._permitted(index):
                    return True
                self._changed.wait(0.1)
                rejoin = not self.joined or time.monotonic() - since > REJOIN_AFTER
            if rejoin:
                self.join(index - 1, episode, stop)
                since = time.monotonic()
        return False

    def _permitted(self, index: int) -> bool:
        flow = self.flow
        if self.policy is None or flow.limit.get(self.actor, 0) < index or flow.incarnation != self._incarnation:
            return False
        return not self.lockstep or self.policy.version == flow.weights_version

    def _on_flow(self, sample: Sample) -> None:
        flow = sample.message()
        with self._changed:
            if flow.limit.get(self.actor, 0) > self._index + MOST_STEPS_AHEAD:
                raise Implausible(f"a learner permits {flow.limit[self.actor]} steps at step {self._index}")
            ours = not self._incarnation or flow.incarnation == self._incarnation
            if ours or flow.incarnation != self.flow.incarnation:
                self.flow = flow
            self._changed.notify_all()

    def _on_weights(self, sample: Sample) -> None:
        with self._changed:
            self._take(sample.message(), joining=False)
            self._changed.notify_all()

    def _take(self, message: pb.Weights, joining: bool) -> None:
        """Take newer weights; when joining, any. Log invalid weights. Raises Implausible: they are too far ahead."""
        if not joining:
            if self.policy is None:
                return  # for another actor: ours come with the learner's reply to our join
            if message.version > self.policy.version + MOST_VERSIONS_AHEAD:
                self._doubtful = True
                raise Implausible(f"weights {message.version} after weights {self.policy.version}")
        try:
            policy = decode(message.file, self.robot)
            if policy.version != message.version:
                raise BadWeights(f"the file has version {policy.version}")
        except BadWeights as error:
            log.error("weights %d are not valid: %s", message.version, error)
            return
        if joining or self.policy is None or policy.version > self.policy.version:
            self.policy = policy
