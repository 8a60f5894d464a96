"""An actor's side of learning: join the learner, hold its newest weights, and go no further ahead than it allows."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusError, Sample
from brakeline.messaging.message_checks import Implausible
from brakeline.messaging.policy_weights import MLP, BadWeights, decode
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import FLOW, JOIN, WEIGHTS

log = logging.getLogger("brakeline.actor")

JOIN_TIMEOUT = 2.0  # s
REJOIN_AFTER = 2.0  # s without permission: the learner may have missed our last step
LEAP = 1000  # versions that weights may be ahead of ours: who is farther behind asks the learner
MOST_AHEAD = 10_000  # steps that a learner may ever allow at once
SAY_EVERY = 10.0  # s between log lines while there is no learner


class RefusedByLearner(RuntimeError):
    """The learner does not take this actor: layouts differ, or it has enough."""


class LearnerClient:
    """The link of one actor name to the learner. `policy` is the newest, None before the first join."""

    def __init__(self, bus: Bus, robot: RobotWithTask, actor: str, lockstep: bool = False) -> None:
        self.bus, self.robot, self.actor, self.lockstep = bus, robot, actor, lockstep
        self.policy: MLP | None = None
        self.flow = pb.Flow()
        self.joins = 0
        self._joined = 0  # incarnation
        self._index = 0  # of the latest step that was asked for
        self._doubtful = False  # somebody said what our learner would not: ask it
        self._news = threading.Condition()
        self._subscriptions = (
            bus.subscribe(WEIGHTS, self._on_weights, robot=robot.name),
            bus.subscribe(FLOW, self._on_flow, robot=robot.name),
        )

    @property
    def done(self) -> bool:
        return self.flow.done

    @property
    def warmup(self) -> bool:
        return self.flow.warmup

    @property
    def welcome(self) -> bool:
        """The learner that took us in is still the one that there is, and nobody says otherwise."""
        return self.flow.incarnation == self._joined and not self._doubtful

    def join(self, index: int, episode: int, stop: Callable[[], bool]) -> int | None:
        """Wait until a learner takes us in; returns the episode to go on with, None if told to stop.

        Raises:
            RefusedByLearner: it says why.
        """
        message = pb.Join(
            robot=self.robot.name, actor=self.actor, layout=self.robot.learning_layout(), index=index, episode=episode
        )
        say_at = 0.0
        while not stop():
            try:
                payload = self.bus.ask(JOIN, message.SerializeToString(), JOIN_TIMEOUT, robot=self.robot.name)
            except BusError as error:
                if time.monotonic() >= say_at:
                    log.info("%s waits for a learner: %s", self.actor, error)
                    say_at = time.monotonic() + SAY_EVERY
                time.sleep(0.2)
                continue
            reply = pb.JoinReply.FromString(payload)
            if reply.error.type:
                raise RefusedByLearner(f"{reply.error.field}: {reply.error.message}")
            with self._news:
                self.flow, self._index, self._doubtful = reply.flow, index, False
                self._joined = reply.flow.incarnation
                self._take(reply.weights, joined=True)
            self.joins += 1
            return reply.episode
        return None

    def wait(self, index: int, episode: int, stop: Callable[[], bool]) -> bool:
        """Wait for permission to take the step of that index; False: the run is done, or told to stop."""
        asked, self._index = time.monotonic(), index
        while not stop() and not self.flow.done:
            with self._news:
                if self._may(index):
                    return True
                self._news.wait(0.1)
                rejoin = not self.welcome or time.monotonic() - asked > REJOIN_AFTER
            if rejoin:
                self.join(index - 1, episode, stop)
                asked = time.monotonic()
        return False

    def _may(self, index: int) -> bool:
        if self.policy is None or self.flow.limit.get(self.actor, 0) < index or self.flow.incarnation != self._joined:
            return False
        return not self.lockstep or self.policy.version == self.flow.weights_version

    def _on_flow(self, sample: Sample) -> None:
        flow = sample.message()
        with self._news:
            if flow.limit.get(self.actor, 0) > self._index + MOST_AHEAD:
                raise Implausible(f"{flow.limit[self.actor]} steps allowed, at {self._index}")
            if flow.incarnation == self._joined or not self._joined or flow.incarnation != self.flow.incarnation:
                self.flow = flow
            self._news.notify_all()

    def _on_weights(self, sample: Sample) -> None:
        with self._news:
            self._take(sample.message(), joined=False)
            self._news.notify_all()

    def _take(self, message: pb.Weights, joined: bool) -> None:
        """Weights that are a little newer, or, on joining, whatever the learner has; anything else is refused aloud.

        Raises:
            Implausible: they do not go on from ours.
        """
        if not joined:
            if self.policy is None:
                return  # another's: what to go on from comes with the learner's answer to our joining
            if message.version > self.policy.version + LEAP:
                self._doubtful = True
                raise Implausible(f"weights {message.version}, after {self.policy.version}")
        try:
            policy = decode(message.file, self.robot)
        except BadWeights as error:
            log.error("weights %d were refused: %s", message.version, error)
            return
        if policy.version != message.version:
            log.error("weights %d were refused: they are of version %d", message.version, policy.version)
            return
        if joined or self.policy is None or policy.version > self.policy.version:
            self.policy = policy
