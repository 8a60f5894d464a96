"""The learner without a bus: it takes steps and gives weights, permissions to publish, and figures.

    insert ── ledger (duplicates, gaps) ── windows (n-step) ── replay ── TD3 ── weights
                                                         rate limiter ── flow

The learner and its checkpoint contain everything that determines the weights, so that a run in lockstep is repeatable
bit for bit. In lockstep, an actor may publish step i after all updates that step i − 1 made due.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from brakeline.errors import BadStep, CheckpointError, DamagedPart, Diverged
from brakeline.learner import checkpoint
from brakeline.learner.actor_permissions import ActorPermissions
from brakeline.learner.checkpoint import PartState
from brakeline.learner.lagrange import LagrangeMultiplier
from brakeline.learner.learner_config import LearnerConfig
from brakeline.learner.n_step import ActorStep, NStepWindows
from brakeline.learner.rate_limiter import RateLimiter
from brakeline.learner.replay import Batch, ReplayBuffer
from brakeline.learner.step_ledger import StepLedger
from brakeline.learner.symmetry import SymmetryAugmentation
from brakeline.learner.td3 import TD3
from brakeline.learner.transition_reader import StepReader
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging import policy_weights as policy
from brakeline.messaging.task import RobotWithTask


class Part(Protocol):
    """A part of the learner that is in the checkpoint."""

    def state(self) -> PartState: ...
    def restore(self, state: PartState) -> None: ...


class Learner:
    """The learner of one kind of robot. Not thread-safe."""

    def __init__(
        self,
        robot: RobotWithTask,
        config: LearnerConfig,
        incarnation: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without steps.

        Args:
            incarnation: is in every flow; actors join again when it changes, after a restart.
            clock: [s], for the rates in the metrics.
        """
        self._intake = StepReader(robot)
        td3, dims = config.td3, (robot.task.observation_dim, robot.action_dim)
        self.robot, self.config, self.incarnation = robot, config, incarnation
        networks, draws = np.random.SeedSequence(config.seed).spawn(2)
        self._td3 = TD3(*dims, td3, seed=int(networks.generate_state(1)[0]))
        self._draws = np.random.default_rng(draws)
        self._replay, self._batch = ReplayBuffer(config.capacity, *dims), Batch(td3.batch, *dims)
        self._images = SymmetryAugmentation(robot, td3.batch) if td3.symmetric else None
        self._windows, self._ledger = NStepWindows(td3.n_step, td3.gamma, td3.stored), StepLedger()
        ahead = 0.0 if config.lockstep else config.ahead
        self._limiter = RateLimiter(td3.updates_per_step * td3.batch, td3.batch, td3.warmup, ahead)
        limited = td3.cost_limit is not None
        self._multiplier = LagrangeMultiplier(td3.cost_limit or 0.0, td3.multiplier_rate) if limited else None
        self._permissions = ActorPermissions(robot, config, self._ledger)
        self._episode_ended = True  # whether the last step ended its episode
        self._saved_at = 0  # number of steps at the last checkpoint
        self.surplus = 0  # steps after the last one of the run
        self.rejected = 0
        self._version, self._published_updates = 0, 0
        self._clock = clock
        self._mark = (clock(), 0, 0)  # time, steps and updates at the last metrics
        self._ages: list[int] = []  # versions that each step was behind, since the last metrics
        self.publish()

    def insert(self, step: pb.Step, logged: bool = False) -> bool:
        """Insert a step. Return False if it is a duplicate, or comes after the end of the run.

        Args:
            logged: a feeder publishes it, not the actor itself.

        Raises:
            BadStep: a size or value is wrong, or the actor may not publish this step. The step is only counted.
        """
        try:
            self._permissions.check_sender(step, logged)
            move = self._read(step)
        except BadStep:
            self.rejected += 1
            raise
        if self._enough():
            self.surplus += 1
            self._ledger.refuse(step.actor, step.index)
            return False
        if not self._ledger.record(step.actor, step.episode, step.step, step.index):
            return False
        for transition in self._windows.push(step.actor, move):
            self._replay.insert(transition)
        self._limiter.insert()
        self._weigh_penalties()
        if self._multiplier is not None and (step.terminated or step.truncated):
            self._multiplier.end_episode(move.collision)
            self._td3.cost_weight = self._multiplier.value
        self._episode_ended = step.terminated or step.truncated
        self._ages.append(self._version - step.weights_version)
        return True

    def _read(self, step: pb.Step) -> ActorStep:
        """Return the step in a message. A wrong one has arrived, too: its actor gets permission for the next ones."""
        try:
            return self._intake.move(step)
        except BadStep:
            self._ledger.refuse(step.actor, step.index)
            raise

    def _weigh_penalties(self) -> None:
        """Let penalties grow with the share of the training, and never fall: a resumed one may have more steps."""
        factor = self.config.td3.penalty_factor(self.steps / self.config.steps)
        self._td3.penalty_factor = max(self._td3.penalty_factor, factor)

    def join(self, join: pb.Join, asker: str = "") -> pb.JoinReply:
        """Accept an actor, or give the reason for the refusal in `error`.

        Args:
            asker: name of the process that asks; empty: do not compare it with the actor's.
        """
        episode = self._permissions.join(join, asker)
        if isinstance(episode, pb.Error):
            return pb.JoinReply(error=episode)
        steps = self._ledger.steps_of(join.actor)
        return pb.JoinReply(weights=self.weights(), flow=self.flow(), episode=episode, steps=steps)

    def work(self, most: int) -> int:
        """Make at most `most` of the updates that are due. Return how many it made."""
        updates = 0
        while updates < most and self._update_due():
            self._replay.sample(self._draws, self._batch)
            if self._images is not None:
                self._images.apply(self._batch)
            self._td3.update(self._batch)
            self._limiter.sample()
            updates += 1
        return updates

    def _update_due(self) -> bool:
        """Return whether an update is due, and there is a step to learn from: windows of n steps fill late."""
        return self._limiter.may_sample() and len(self._replay) > 0

    def _enough(self) -> bool:
        """Return whether all steps of the run have arrived."""
        return self._limiter.inserts >= self.config.steps and (self._episode_ended or not self.config.lockstep)

    @property
    def done(self) -> bool:
        """Whether all steps have arrived and all updates are made."""
        return self._enough() and not self._update_due()

    @property
    def steps(self) -> int:
        return self._limiter.inserts

    @property
    def updates(self) -> int:
        return self._td3.updates

    @property
    def warming_up(self) -> bool:
        """Whether there are too few steps for updates; until then the actors act at random."""
        return self._limiter.warming_up

    def weights_due(self) -> bool:
        """Return whether it is time for `publish`."""
        new = self._td3.updates - self._published_updates
        if self.config.lockstep or self.done:
            return new > 0 and not self._update_due()
        return new >= self.config.publish_every

    def publish(self) -> pb.Weights:
        """Return the present weights as a new version, which `weights` and `flow` give from now on.

        Raises:
            Diverged: they are not finite. The last version stays.
        """
        self._check_finite()
        self._version += 1
        self._published_updates = self._td3.updates
        self._encode()
        return self._weights

    def _check_finite(self) -> None:
        """Raise Diverged if the training has diverged."""
        if not self._td3.finite(self._batch):
            td3 = self.config.td3
            raise Diverged(
                f"the training diverged by update {self.updates}, step {self.steps}: weights or losses are not finite. "
                "Checkpoint and policy, if there are any, stay as they were. Train anew with lower learning rates "
                f"(now --learner.td3.critic-rate {td3.critic_rate:g} --learner.td3.actor-rate {td3.actor_rate:g})"
            )

    def _encode(self) -> None:
        noise = self.config.td3.exploration_noise
        file = policy.encode(self.robot, self._td3.policy_layers(), self._version, noise)
        self._weights = pb.Weights(
            robot=self.robot.name, version=self._version, layout=self.robot.learning_layout(), file=file
        )

    def weights(self) -> pb.Weights:
        return self._weights

    def flow(self) -> pb.Flow:
        """Return up to which index each actor may publish. A limit never falls."""
        if not (self.config.lockstep and (self._update_due() or self.weights_due())):
            self._permissions.grant(self._room())
        return pb.Flow(
            robot=self.robot.name,
            incarnation=self.incarnation,
            limit=self._permissions.limits,
            weights_version=self._version,
            warmup=self._limiter.warming_up,
            done=self.done,
        )

    def flow_due(self, limits: Mapping[str, int]) -> bool:
        """Return whether an actor has used half of its window up to a limit: `ActorPermissions.flow_due`."""
        return self._permissions.flow_due(limits)

    def _room(self) -> int:
        """Return how many more steps the actors may publish together."""
        room = 0 if self._enough() else self._limiter.room()
        if not len(self._replay) and not self._enough():
            room = max(room, len(self._permissions.limits))  # no update can make room before the first window is full
        if not self.config.lockstep:
            room = min(room, self.config.steps - self._limiter.inserts)
        return room

    def metrics(self) -> pb.LearnerMetrics:
        """Return the metrics, with rates and staleness since the last call."""
        now, steps, updates = self._clock(), self._limiter.inserts, self._td3.updates
        then, steps_then, updates_then = self._mark
        elapsed = max(now - then, 1e-9)
        self._mark = (now, steps, updates)
        ages, self._ages = self._ages, []
        return pb.LearnerMetrics(
            robot=self.robot.name,
            steps=steps,
            updates=updates,
            weights_version=self._version,
            critic_loss=self._td3.losses.critic,
            actor_loss=self._td3.losses.actor,
            mean_q=self._td3.losses.mean_q,
            steps_per_s=(steps - steps_then) / elapsed,
            updates_per_s=(updates - updates_then) / elapsed,
            replay_size=len(self._replay),
            duplicates=self._ledger.duplicates,
            missing=self._ledger.missing,
            staleness=float(np.mean(ages)) if ages else 0.0,
            limiter_error=self._limiter.error,
            done=self.done,
            limit=self._permissions.limits,
            refused=self.rejected + self.surplus,
        )

    def may_save(self) -> bool:
        """Return whether a checkpoint is possible: in lockstep only between episodes, with no update due."""
        settled = self._episode_ended and not self._update_due() and not self.weights_due()
        return settled or not self.config.lockstep

    def checkpoint_due(self) -> bool:
        """Return whether it is time for `save`."""
        return self.steps - self._saved_at >= self.config.checkpoint_every and self.may_save()

    def save(self, root: Path) -> Path:
        """Write a checkpoint, and return its folder.

        Raises:
            CheckpointError: the checkpoint could not be written; the previous one is unchanged.
            Diverged: the weights are not finite; the previous checkpoint is unchanged.
        """
        self._check_finite()
        saved_before, self._saved_at = self._saved_at, self.steps
        parts = {name: part.state() for name, part in self._parts().items()} | {"run": self._run_state()}
        try:
            return checkpoint.save(root, parts, self._about())
        except CheckpointError:
            self._saved_at = saved_before
            raise

    def restore(self, root: Path) -> None:
        """Take over the state of the latest checkpoint. After an error, the learner is not usable.

        Raises:
            CheckpointError: there is no checkpoint, it is damaged, or it is of another run.
        """
        states, about = checkpoint.load(root, (*self._parts(), "run"))
        self._compare(root, about)
        restorers = {name: part.restore for name, part in self._parts().items()} | {"run": self._restore_run}
        for name, restore in restorers.items():
            try:
                restore(states[name])
            except Exception as error:  # of another version, for instance
                raise DamagedPart(name, root, f"damaged: {error}") from error
        if not self._td3.finite(self._batch):
            raise DamagedPart("td3", root, "not finite: an earlier version saved it after the training diverged")
        self._td3.cost_weight = 0.0 if self._multiplier is None else self._multiplier.value
        self._weigh_penalties()
        self._encode()
        if self._published_updates != self._td3.updates:
            self.publish()

    def _parts(self) -> dict[str, Part]:
        limited: dict[str, Part] = {} if self._multiplier is None else {"multiplier": self._multiplier}
        return limited | {
            "td3": self._td3,
            "replay": self._replay,
            "windows": self._windows,
            "ledger": self._ledger,
            "limiter": self._limiter,
        }

    def _about(self) -> dict[str, Any]:
        about = {"robot": self.robot.name, "layout": self.robot.learning_layout(), "steps": self.steps}
        return about | {"config": self.config.lasting()}

    def _compare(self, root: Path, about: dict[str, Any]) -> None:
        ours = self._about()
        for name in ("robot", "layout", "config"):
            theirs = about.get(name)
            if isinstance(theirs, dict):
                names = sorted(key for key in ours[name] | theirs if ours[name].get(key) != theirs.get(key))
            else:
                names = [name] if theirs != ours[name] else []
            if names:
                raise CheckpointError(f"{root}: the checkpoint differs from this run in {', '.join(names)}")

    def _run_state(self) -> PartState:
        values = {
            "draws": self._draws.bit_generator.state,
            "version": self._version,
            "published_updates": self._published_updates,
            "episode_ended": self._episode_ended,
            "saved_at": self._saved_at,
            "penalty_factor": self._td3.penalty_factor,
        }
        return PartState({}, values)

    def _restore_run(self, state: PartState) -> None:
        self._draws.bit_generator.state = state.value("draws")
        self._version, self._published_updates = state.integer("version"), state.integer("published_updates")
        self._episode_ended, self._saved_at = bool(state.value("episode_ended")), state.integer("saved_at")
        self._td3.penalty_factor = float(state.values.get("penalty_factor", 1.0))  # an earlier version saved none
        self._mark = (self._clock(), self.steps, self.updates)
