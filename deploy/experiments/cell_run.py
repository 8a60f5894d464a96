"""Run one cell of the comparison: train a method from a seed, then evaluate it on the shared fresh episodes."""

from __future__ import annotations

import hashlib
import json
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.data.simulated_recording import load_or_record
from brakeline.deploy.experiments.batch_evaluation import batch_method, drive_episodes
from brakeline.deploy.experiments.compared_methods import NONE, SAC_LEARNER, compared
from brakeline.deploy.experiments.comparison_cells import (
    LEARNING,
    TIMED,
    CellConfig,
    Report,
    TrialConfig,
)
from brakeline.deploy.experiments.episode_table import EpisodeTable
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.experiments.experiment_jobs import configuration
from brakeline.deploy.experiments.trials import Begin, Take, TrialLog, run_trial, train_in_lockstep
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED, driving, network_named
from brakeline.deploy.run.batch_trainer import BatchTrainer
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import ResultError
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.figure_tables import analyse
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.policy_weights import MLP, POLICY, decode
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import EPISODE
from brakeline.safety.filter.batch.row_by_row import BatchMethod
from brakeline.safety.methods import Model
from brakeline.safety.model.model_config import DDPC, ONE_STEP, SAILR
from brakeline.safety.rivals.own_code import OwnCode
from brakeline.safety.rivals.pretrained import Pretrained

PACKAGES = ("brakeline", "mujoco", "proxsuite", "numpy", "torch")
# Figures of a log, and the columns of the table of episodes that count the same.
COUNTED = {
    "goals": "goal",
    "timeouts": "timeout",
    "contacts_moving": "contact_moving",
    "contacts_standing": "contact_standing",
}
LOGGED = ("collisions", "interventions", "failsafes", "mean_speed", "max_speed", "mean_reward", "containment")


def progress(table: EpisodeTable) -> str:
    """Return the number of steps so far, and the goals of the last episodes, as a line.

    The line states how many episodes these are: the first ones to end are the shortest, so a share would mislead.
    """
    goals = [row["goal"] for row in table.rows[-50:]]
    return f"step {table.decisions}, {sum(goals):g} of the last {len(goals)} episodes reached the goal"


class CellRun:
    """The run of one cell in a folder.

    seed_key: seeds the episodes of the evaluations.
    """

    def __init__(self, cell: CellConfig, folder: Path, say: Report, seed_key: int = FRESH) -> None:
        self.cell, self.folder, self.say, self.seed_key = cell, folder, say, seed_key
        self.robot = robot_with_task(cell.robot)
        self.models = {method: method_for(self.robot, method, cell.model_config) for method in cell.filters()}
        if cell.model_set and self.models[DDPC].version != cell.model_set:
            raise ResultError(f"the model set of {cell.robot} is no longer {cell.model_set}: run the comparison again")
        if cell.code and self.models[cell.method].version != cell.code:
            raise ResultError(f"{cell.method} has changed since the comparison began: run it again")

    def result(self) -> dict[str, Any]:
        """Train and evaluate, and return the content of the cell's file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        training = self._train()
        evaluations = {trial.name: self._evaluate(trial) for trial in self.cell.trials()}
        model = self.models.get(compared(self.cell.method).filter)
        return {
            "study": configuration(self.cell),
            "model": None if model is None else {"version": model.version, **_cost(model, self.robot)},
            "policy": hashlib.sha256((self.folder / POLICY).read_bytes()).hexdigest()[:16],
            "versions": {name: version(name) for name in PACKAGES},
            "training": training,
            "evaluations": evaluations,
        }

    def _train(self) -> dict[str, Any]:
        cell, table = self.cell, EpisodeTable()
        trial = TrialConfig(LEARNING, compared(cell.method).filter, cell.arenas[0], 0)
        train = self._train_batch if cell.backend == "batch" else self._train_single
        if compared(cell.method).learner == SAC_LEARNER:
            train = self._train_sac
        with self._log("training", trial) as log:

            def take(step: pb.Step) -> None:
                table.step(step)
                log.put_step(step)
                if table.decisions % 1000 == 0:
                    self.say(progress(table))

            policy, updates = train(trial, take, partial(log.put, EPISODE))
        policy.save(self.folder / POLICY)
        figures = _checked(table, log.path)
        figures["episodes"] |= table.span_columns()
        return figures | {"steps": cell.steps, "updates": updates}

    def _learner(self) -> Learner:
        cell = self.cell
        return Learner(self.robot, LearnerConfig(td3=cell.td3, seed=cell.seed, steps=cell.steps))

    def _train_single(self, trial: TrialConfig, take: Take, begin: Begin) -> tuple[MLP, int]:
        """Train with one robot and one learner in lockstep. Return the policy and the number of updates."""
        driver, ask = self._driver(trial, self.cell.seed, self.cell.name)
        learner = self._learner()
        return train_in_lockstep(driver, ask, learner, take, begin), learner.updates

    def _train_batch(self, trial: TrialConfig, take: Take, begin: Begin) -> tuple[MLP, int]:
        """Train with many robots at once. Return what `_train_single` returns."""

        def publish(number: int, message: pb.Step | pb.Episode) -> None:
            if isinstance(message, pb.Step):
                take(message)
            else:
                begin(message)

        cell, safety, learner = self.cell, self._safety(trial), self._learner()
        trainer = BatchTrainer(
            learner,
            safety,
            cell.robots,
            cell.name,
            publish,
            arena=trial.arena,
            seed=cell.seed,
            penalty=cell.penalty,
            ends_on_intervention=_ends_on_intervention(trial),
        )
        try:
            while not learner.done:
                trainer.period()
        finally:
            trainer.close()
        if learner.weights_due():
            learner.publish()
        return decode(learner.weights().file, self.robot), learner.updates

    def _train_sac(self, trial: TrialConfig, take: Take, begin: Begin) -> tuple[MLP, int]:
        """Train SAC with many robots at once. Return what `_train_single` returns."""
        from brakeline.deploy.experiments.sac_training import train_sac  # Stable-Baselines3 is an extra

        return train_sac(self.robot, self._safety(trial), self.cell, take, begin)

    def _evaluate(self, trial: TrialConfig) -> dict[str, Any]:
        self.say(trial.name)
        name = str(self.folder / POLICY) if trial.policy == TRAINED else UNTRAINED
        policy = network_named(name, self.robot, self.cell.seed)
        with self._log(trial.name, trial) as log:
            if self.cell.backend == "single":
                driver, ask = self._driver(trial, self.seed_key, trial.name)
                table = run_trial(driver, driving(policy), ask, trial.episodes, log)
            else:
                table = self._evaluate_batch(trial, policy, log)
        figures = _checked(table, log.path)
        if self.cell.backend == "batch":
            driver, ask = self._driver(trial, self.seed_key, trial.name)
            figures["decision_ms"] = run_trial(driver, driving(policy), ask, min(TIMED, trial.episodes)).decision_ms()
        return figures

    def _evaluate_batch(self, trial: TrialConfig, policy: MLP, log: TrialLog) -> EpisodeTable:
        """Drive the episodes of `run_trial`, many at once."""
        table = EpisodeTable()

        def take(step: pb.Step) -> None:
            table.step(step)
            log.put_step(step)

        begin, numbers = partial(log.put, EPISODE), range(trial.episodes)
        drive_episodes(self.robot, self._safety(trial), policy, trial.arena, self.seed_key, numbers, take, begin)
        return table

    def _safety(self, trial: TrialConfig) -> BatchMethod | None:
        """Return the filter or rival that decides for a batch; None for the method `none`."""
        return None if trial.method == NONE else batch_method(self.models[trial.method])

    def _driver(self, trial: TrialConfig, seed: int, actor: str) -> tuple[EpisodeRunner, Ask | None]:
        """Return the episode runner of a trial, and the function that asks its filter."""
        ask = None if trial.method == NONE else in_process(self.models[trial.method])
        driver = EpisodeRunner(
            self.robot,
            environment(self.robot, trial.arena, seed),
            ActorIdentity(actor, 0, self.cell.seed),
            penalty=self.cell.penalty,
            filtered=ask is not None,
            ends_on_intervention=_ends_on_intervention(trial),
        )
        return driver, ask

    def _log(self, name: str, trial: TrialConfig) -> TrialLog:
        method = self.cell.method if trial.policy == LEARNING else trial.method
        about = {"method": method, "policy": trial.policy, "arena": trial.arena, "seed": str(self.cell.seed)}
        if trial.method == DDPC:
            about["certificate"] = self.cell.model_config.certificate
        metadata = {"run": about, "configuration": {"json": json.dumps(configuration(self.cell))}}
        return TrialLog(self.folder / f"{name}.mcap", metadata)


def _ends_on_intervention(trial: TrialConfig) -> bool:
    """Return whether an intervention ends an episode.

    It does so in SAILR's training only: in an evaluation, the goals of all methods must be comparable.
    """
    return trial.method == SAILR and trial.policy == LEARNING


def _cost(model: Model, robot: RobotWithTask) -> dict[str, Any]:
    """Return the cost of pre-training, and a rival's settings.

    The data of our filter were recorded without obstacles, so no collision was possible.
    """
    if isinstance(model, Pretrained):
        about = {name: model.about[name] for name in ("samples", "collisions", "seconds", "error")}
        source = {"obstacles": model.ready().obstacles} if isinstance(model, OwnCode) else {}
        return about | source | {"settings": dict(model.settings)}
    data = load_or_record(robot)
    used = data if model.model_config.mode == ONE_STEP else data.steady()  # as `certify` uses them
    return {"samples": str(used.periods), "collisions": "0"}


def _checked(table: EpisodeTable, log_file: Path) -> dict[str, Any]:
    """Return the counted figures and those of the log. Raises ResultError if they disagree."""
    columns, logged = table.columns(), analyse(log_file)
    counted = {"steps": table.decisions, "episodes": len(table.rows)}
    counted |= {name: int(sum(columns[column])) for name, column in COUNTED.items()}
    for name, count in counted.items():
        if logged[name] != count:
            raise ResultError(f"{log_file} has {logged[name]} {name}, but the run counted {count}")
    if logged["collisions"] < sum(columns["collision"]):
        raise ResultError(f"{log_file} has {logged['collisions']} collisions, but the run counted more")
    return {
        "episodes": columns,
        "decision_ms": table.decision_ms(),
        "logged": {name: logged[name] for name in LOGGED},
    }
