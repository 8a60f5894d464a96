"""Who proposes a robot's actions, and says whether it may go on: a learner's pupil, or a policy that is what it is."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.learner_client import LearnerClient
from brakeline.safety.filter.backup_plan import Array
from brakeline.sim.scripted_policies import Policy, scripted

log = logging.getLogger("brakeline.actor")

Stop = Callable[[], bool]
PolicyFactory = Callable[[int], Policy]  # from a seed


class Proposer(Protocol):
    """Where a robot's proposals come from."""

    @property
    def version(self) -> int:
        """Of the weights that propose; 0: none do."""

    def join(self, index: int, episode: int, stop: Stop) -> int | None:
        """Before the first step: wait until there are proposals. The episode to begin with; None: told to stop."""

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """Wait until the step of that index may be taken; False: the end."""

    def begin(self, rng: np.random.Generator) -> None:
        """An episode begins, whose chance is this generator."""

    def propose(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        """A proposal (m,), whatever it may be."""


class LearnedPolicy:
    """Explores with the newest weights of a learner, and goes no further ahead than it allows."""

    def __init__(self, student: LearnerClient) -> None:
        self.student = student

    @property
    def version(self) -> int:
        """Of the newest weights."""
        return 0 if self.student.policy is None else self.student.policy.version

    def join(self, index: int, episode: int, stop: Stop) -> int | None:
        """Join the learner. Raises RefusedByLearner."""
        return self.student.join(index, episode, stop)

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """Wait for the learner's permission; False: the run is done, or told to stop."""
        return self.student.wait(index, episode, stop)

    def begin(self, rng: np.random.Generator) -> None:
        """An episode begins."""
        self._rng = rng
        self._random = scripted("random", self.student.robot, rng)

    def propose(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        """The exploring policy's action, at random during warm-up."""
        policy = self.student.policy
        if policy is None or self.student.warmup:
            return self._random(observation, info)
        return np.asarray(policy.explore(observation, self._rng), dtype=float)


class RealTimePolicy(LearnedPolicy):
    """A pupil that cannot stand and wait: it flies on with the weights that it has, and joins again meanwhile."""

    _joining: threading.Thread | None = None

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """False when the run is done. Does not wait."""
        if not self.student.welcome and (self._joining is None or not self._joining.is_alive()):
            arguments = (index - 1, episode, stop)
            self._joining = threading.Thread(target=self.student.join, args=arguments, name="join", daemon=True)
            self._joining.start()
        return not self.student.done


class FixedPolicy:
    """A policy that learns nothing; after so many steps it is done (0: never)."""

    version = 0

    def __init__(self, make: PolicyFactory, seed: int, steps: int = 0) -> None:
        self.policy, self._steps = make(seed), steps

    def join(self, index: int, episode: int, stop: Stop) -> int | None:
        """There is nobody to wait for."""
        return episode

    def ready(self, index: int, episode: int, stop: Stop) -> bool:
        """Until its steps are taken."""
        return not stop() and not 0 < self._steps < index

    def begin(self, rng: np.random.Generator) -> None:
        """Scripted policies notice by themselves."""

    def propose(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        """The policy's action."""
        return np.asarray(self.policy(observation, info), dtype=float)


def check(proposal: Array, version: int) -> None:
    """Log a proposal that holds NaN or infinity: the filter answers it with a failsafe."""
    if not np.isfinite(proposal).all():
        log.error("weights %d propose %s", version, proposal)
