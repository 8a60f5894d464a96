"""Drive the episodes of a campaign. Each depends on its number alone, so any of them can be driven again and logged.

Many robots at once drive what a batch can simulate (`deploy/experiments/batch_evaluation.py`), one after the other the
rest. An episode that came too near to something is driven again, and its log kept: `brakeline replay` decides each of
its requests anew, `brakeline analyse --html` shows it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.batch_evaluation import batch_filter, drive_batch
from brakeline.deploy.experiments.episode_table import COLUMNS, Column, EpisodeTable
from brakeline.deploy.experiments.evaluate import FRESH, Evaluation, in_process, model_of
from brakeline.deploy.experiments.trials import TrialLog, take_step
from brakeline.deploy.policy_loading import driving, network_named, scripted_with_copies
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import NoBatch
from brakeline.logs.episode_stats import closest_of
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE
from brakeline.safety.methods import Model
from brakeline.sim.batch.batch_support import check_batch
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.scripted_policies import Policy

ACTOR = "campaign"
Row = dict[str, float]

ROWS: dict[str, Column] = {
    **{name: COLUMNS[name] for name in ("steps", "goal", "collision", "timeout", "interventions")},
    **{name: COLUMNS[name] for name in ("contact_moving", "contact_standing")},
    "failsafes": Column(lambda step: step.fallback or step.decision == pb.FAILSAFE, count=True),
    "compared": Column(lambda step: step.compared, count=True),
    "violations": Column(lambda step: step.compared and not step.contained, count=True),
    "closest": Column(closest_of, min, start=math.inf),  # m
}


@dataclass(frozen=True)
class CampaignDriver:
    """The robot, policy and filter of a cell.

    Attributes:
        evaluation: policy, method, model set, arena, conditions and seed.
        model, ask: of the filter; None without one.
    """

    robot: RobotWithTask
    evaluation: Evaluation
    model: Model | None
    ask: Ask | None
    env: NavigationEnv

    @staticmethod
    def of(robot: RobotWithTask, evaluation: Evaluation) -> CampaignDriver:
        """Load the model set and the environment. Raises what `in_process` and `environment` raise."""
        model = model_of(robot, evaluation)
        ask = None if model is None else in_process(model, evaluation.accept_bound)
        return CampaignDriver(
            robot,
            evaluation,
            model,
            ask,
            environment(robot, evaluation.arena, FRESH + evaluation.seed, evaluation.conditions),
        )

    def drive(self, first: int, episodes: int, after_episode: Callable[[], object]) -> list[Row]:
        """Drive episodes and return a row of each, in order. Calls `after_episode` after every one."""
        if self._in_a_batch():
            return self._drive_batch(first, episodes, after_episode)
        rows = []
        for number in range(first, first + episodes):
            rows.append(self.row(number))
            after_episode()
        return rows

    def row(self, number: int, log: TrialLog | None = None, policy: Policy | None = None) -> Row:
        """Drive an episode, which a log may record with all requests. policy: instead of the cell's."""
        runner = EpisodeRunner(
            self.robot, self.env, ActorIdentity(ACTOR, 0, self.evaluation.seed), filtered=bool(self.ask)
        )
        policy, table = policy or self.policy(number), EpisodeTable(ROWS)
        message = runner.begin(number)
        if log is not None:
            log.put(EPISODE, message)
        while runner.running:
            step = take_step(runner, policy, self.ask, requests=log)
            if log is not None:
                log.put_step(step)
            table.step(step)
        return table.rows[0]

    def policy(self, number: int) -> Policy:
        """Return the policy of an episode. A scripted one draws from the episode's own seed."""
        name = self.evaluation.policy
        if name in self.robot.task.policies:
            return scripted_with_copies(name, self.robot, np.random.default_rng((self.evaluation.seed, number)))
        return driving(network_named(name, self.robot, self.evaluation.seed))

    def log(self, path: Path, **about: str) -> TrialLog:
        """Open the log of an episode, with all that a replay needs. about: further entries of its `run`."""
        evaluation, files = self.evaluation, {}
        run = {
            "method": evaluation.method,
            "policy": evaluation.policy,
            "arena": evaluation.arena,
            "seed": str(evaluation.seed),
        } | about
        if self.model is not None:
            files[model_attachment_name(self.robot.name, self.model.version)] = self.model.encode()
            run |= {"certificate": evaluation.model_config.certificate, "mode": evaluation.model_config.mode}
        metadata = {"run": run | {"robots": self.robot.name}, "conditions": evaluation.conditions.describe()}
        metadata["robots"] = {self.robot.kind: json.dumps(self.robot.description)}
        path.parent.mkdir(parents=True, exist_ok=True)
        return TrialLog(path, metadata, files)

    def record(self, number: int, path: Path) -> Row:
        """Drive an episode again, write its log, and return its row."""
        with self.log(path, episode=str(number)) as log:
            return self.row(number, log)

    def _in_a_batch(self) -> bool:
        try:
            check_batch(self.robot, self.evaluation.arena, self.evaluation.conditions)
            batch_filter(self.robot, self.evaluation)
        except NoBatch:
            return False
        return True

    def _drive_batch(self, first: int, episodes: int, after_episode: Callable[[], object]) -> list[Row]:
        table, rows = EpisodeTable(ROWS), dict[int, Row]()

        def take(step: pb.Step) -> None:
            table.step(step)
            if step.terminated or step.truncated:
                rows[step.episode] = table.pop()
                after_episode()

        drive_batch(self.robot, replace(self.evaluation, backend="batch"), first, episodes, take, independent=True)
        return [rows[number] for number in range(first, first + episodes)]


def too_near(row: Row, near: float) -> bool:
    """Return whether an episode touched something, or came nearer than `near` [m] to something."""
    touched = row["collision"] or row["contact_moving"]
    return bool(touched or not row["closest"] >= near)
