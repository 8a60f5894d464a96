"""Proposers of a robot's actions: the policy that a learner trains, or a policy that does not change.

A proposer also says whether the robot may go on.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.learner_client import LOG_INTERVAL, LearnerClient
from brakeline.errors import RefusedByLearner
from brakeline.messaging.robot import Array
from brakeline.sim.scripted_policies import Policy, scripted

log = logging.getLogger("brakeline.actor")

Stop = Callable[[], bool]  # whether to end
PolicyFactory = Callable[[int], Policy]  # makes a policy from a seed


class LearnedPolicy(LearnerClient):
    """Explores with a learner's newest weights, and takes no more steps than the learner permits."""

    @property
    def version(self) -> int:
        """The version of the newest weights; 0: none have arrived."""
        return 0 if self.policy is None else self.policy.version

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """Wait for the learner's permission for step number `index`. Return False at the end of the run."""
        return self.wait(index, episode, stop)

    def begin(self, rng: np.random.Generator) -> None:
        self._rng, self._random = rng, scripted("random", self.robot, rng)

    def propose(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        """Return the exploring policy's action; during warm-up, a random one."""
        if self.policy is None or self.flow.warmup:
            return self._random(observation, info)
        return np.asarray(self.policy.explore(observation, self._rng), dtype=float)


class RealTimePolicy(LearnedPolicy):
    """A learned policy of a robot that cannot wait: it uses the weights it has while it joins again."""

    _joining: threading.Thread | None = None

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """Return False at the end of the run. Never waits."""
        if not self.joined and (self._joining is None or not self._joining.is_alive()):
            self._joining = threading.Thread(target=self._rejoin, args=(index - 1, episode, stop), daemon=True)
            self._joining.start()
        return not self.done

    def _rejoin(self, index: int, episode: int, stop: Stop) -> None:
        try:
            self.join(index, episode, stop)
        except RefusedByLearner as error:
            log.error("the learner refuses %s, which goes on with its weights: %s", self.actor, error)
            time.sleep(LOG_INTERVAL)  # it may be started again, as it should be


class FixedPolicy:
    """A policy that does not learn, for a number of steps (0: without end)."""

    version = 0  # it has none
    earlier_steps = 0  # nobody counts its steps beyond a restart

    def __init__(self, make: PolicyFactory, seed: int, steps: int = 0) -> None:
        self.policy, self._steps = make(seed), steps

    def join(self, index: int, episode: int, stop: Stop) -> int | None:
        """Return the episode: there is no learner to wait for."""
        return episode

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        return not stop() and not 0 < self._steps < index

    def begin(self, rng: np.random.Generator) -> None:
        """Do nothing: scripted policies detect a new episode by themselves."""

    def propose(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return np.asarray(self.policy(observation, info), dtype=float)


Proposer = LearnedPolicy | FixedPolicy
