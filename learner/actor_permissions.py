"""Which actors have joined the learner, and how many steps each may publish."""

from __future__ import annotations

from collections.abc import Mapping

from brakeline.errors import BadStep
from brakeline.learner.learner_config import LearnerConfig
from brakeline.learner.step_ledger import StepLedger
from brakeline.learner.transition_reader import LATEST
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.identity import identity_of, speaks_for
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import AHEAD

MOST_ACTORS = 2048
MOST_ACTORS_OF_ONE = 256  # of one identity: so many robots of a process, or actors of a feeder's logs
FEEDER = "feeder"  # role that joins for the actors of logs


class ActorPermissions:
    """The actors of a learner, with the index up to which each may publish. A limit never falls.

    Attributes:
        limits: the index by actor.
    """

    def __init__(self, robot: RobotWithTask, config: LearnerConfig, ledger: StepLedger) -> None:
        self.limits: dict[str, int] = {}
        self._robot, self._config, self._ledger = robot, config, ledger
        self._present: set[str] = set()  # actors that joined by themselves, for which no feeder may speak

    def check_sender(self, step: pb.Step, logged: bool) -> None:
        """Raise BadStep if the actor, or a feeder for it, may not publish a step with this index."""
        place = self._ledger.places.get(step.actor)
        if place is None:
            raise BadStep("actor", f"{step.actor} never joined")
        if logged and step.actor in self._present:
            raise BadStep("actor", f"a feeder publishes for {step.actor}, which has joined by itself")
        if step.index > max(place.last_index, self.limits.get(step.actor, 0)) + AHEAD:
            raise BadStep("index", f"{step.index}, but {step.actor} is at {place.last_index}")

    def join(self, join: pb.Join, asker: str) -> pb.Error | int:
        """Accept an actor, and return the episode with which it continues; or return the reason for the refusal."""
        layout, known = self._robot.learning_layout(), join.actor in self.limits
        first, owner = next(iter(self.limits), ""), identity_of(join.actor)
        full = not known and sum(identity_of(name) == owner for name in self.limits) >= MOST_ACTORS_OF_ONE
        most = self._most_published(join.actor)
        refusals = (
            (join.robot != self._robot.name, "robot", f"{join.robot!r}, not {self._robot.name!r}"),
            (join.layout != layout, "layout", f"{join.layout!r}, but {self._robot.name} has {layout!r} here"),
            (not join.actor, "actor", "empty"),
            (not self._may_join(asker, join.actor), "actor", f"{join.actor!r}, but {asker!r} asks"),
            (max(join.index, join.episode) >= LATEST, "index", f"{join.index} steps, episode {join.episode}"),
            (join.index > most, "index", f"{join.index} steps, but {join.actor} may have published {most} at most"),
            (full, "actor", f"{join.actor!r} is one more of {owner} than {MOST_ACTORS_OF_ONE}"),
            (not known and len(self.limits) == MOST_ACTORS, "actor", f"{join.actor!r} is one more than {MOST_ACTORS}"),
            (
                self._config.lockstep and bool(self.limits.keys() - {join.actor}),
                "actor",
                f"{join.actor!r}, but lockstep allows one actor, {first!r}",
            ),
        )
        for refused, field, why in refusals:
            if refused:
                return pb.Error(type="Refused", field=field, message=why)
        if asker and not asker.startswith(FEEDER):
            self._present.add(join.actor)
        episode = self._ledger.join(join.actor, join.index, join.episode)
        self.limits[join.actor] = join.index
        return episode

    def _may_join(self, asker: str, actor: str) -> bool:
        """Return whether a process may join for an actor: for itself or its robot; a feeder for all that are absent."""
        if asker.startswith(FEEDER):
            return actor not in self._present
        return not asker or speaks_for(asker, actor)

    def _most_published(self, actor: str) -> int:
        """Return how many steps an actor can have published since its start, by the permissions of this run."""
        permitted = self.limits.get(actor)
        if permitted is None:  # it may have its permission from an earlier learner
            return LATEST if actor not in self._ledger.places else self._config.steps + AHEAD
        return permitted + AHEAD

    def flow_due(self, limits: Mapping[str, int]) -> bool:
        """Return whether an actor has used half of its window up to a limit, and may go on beyond it.

        Args:
            limits: of the learner's `flow` when it was published last.
        """
        half, places = self._config.window // 2, self._ledger.places
        known = {actor: limits.get(actor, 0) for actor, limit in self.limits.items() if limit > limits.get(actor, 0)}
        return any(limit - places[actor].last_index <= half for actor, limit in known.items())

    def grant(self, room: int) -> None:
        """Raise the limits so that the actors together publish about `room` more steps."""
        if room < 1 or not self.limits:
            return
        # No room is reserved, so a dead actor delays nobody; the band is exceeded by at most one actor's share.
        share = 1 if self._config.lockstep else max(1, min(self._config.window, room // len(self.limits)))
        for actor, limit in self.limits.items():
            self.limits[actor] = max(limit, self._ledger.places[actor].last_index + share)
