"""Run one cell of the comparison: train a method from a seed, then evaluate it on the shared fresh episodes."""

from __future__ import annotations

import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.data.simulated_recording import load_or_record
from brakeline.deploy.experiments.comparison_cells import LEARNING, NONE, CellConfig, Report, TrialConfig
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.experiments.experiment_jobs import configuration
from brakeline.deploy.experiments.trials import EpisodeTable, Trainer, TrialLog, run_trial
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED, policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import ResultError
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.figure_tables import analyse
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.methods import Model
from brakeline.safety.model.model_config import DDPC, SAILR
from brakeline.safety.rivals.pretrained import Pretrained

PACKAGES = ("brakeline", "mujoco", "proxsuite", "numpy", "torch")
POLICY = "policy.safetensors"
COUNTED = {"goals": "goal", "timeouts": "timeout", "contacts_moving": "contact_moving"}
COUNTED["contacts_standing"] = "contact_standing"  # figures of a log, and the columns that count the same
LOGGED = ("collisions", "interventions", "failsafes", "mean_speed", "max_speed", "mean_reward", "containment")


class CellRun:
    """The run of one cell in a folder."""

    def __init__(self, cell: CellConfig, folder: Path, say: Report) -> None:
        self.cell, self.folder, self.say = cell, folder, say
        self.robot = robot_with_task(cell.robot)
        methods = {cell.method, *(trial.method for trial in cell.trials())} - {NONE}
        self.models = {method: method_for(self.robot, method, cell.model_config) for method in methods}

    def result(self) -> dict[str, Any]:
        """Train and evaluate, and return the content of the cell's file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        training = self._train()
        evaluations = {trial.name: self._evaluate(trial) for trial in self.cell.trials()}
        model = self.models.get(self.cell.method)
        return {
            "study": configuration(self.cell),
            "model": None if model is None else {"version": model.version, **_cost(model, self.robot)},
            "policy": hashlib.sha256((self.folder / POLICY).read_bytes()).hexdigest()[:16],
            "versions": {name: version(name) for name in PACKAGES},
            "training": training,
            "evaluations": evaluations,
        }

    def _train(self) -> dict[str, Any]:
        cell = self.cell
        trial = TrialConfig(LEARNING, cell.method, cell.arenas[0], 0)
        config = LearnerConfig(td3=cell.td3, seed=cell.seed, steps=cell.steps)
        driver, ask = self._driver(trial, cell.seed, cell.name)
        trainer, table = Trainer(driver, ask, Learner(self.robot, config)), EpisodeTable()
        with self._log("training", trial) as log:
            for count, step in enumerate(trainer.run(log), 1):
                table.step(step)
                if count % 1000 == 0:
                    last = table.rows[-50:]
                    self.say(f"step {count}, goals {sum(row['goal'] for row in last) / max(len(last), 1):.0%}")
        trainer.policy.save(self.folder / POLICY)
        return _checked(table, log.path) | {"steps": cell.steps, "updates": trainer.learner.updates}

    def _evaluate(self, trial: TrialConfig) -> dict[str, Any]:
        self.say(trial.name)
        name = str(self.folder / POLICY) if trial.policy == TRAINED else UNTRAINED
        driver, ask = self._driver(trial, FRESH, trial.name)
        with self._log(trial.name, trial) as log:
            policy = policy_named(name, self.robot, self.cell.seed)
            table = run_trial(driver, policy, ask, trial.episodes, log)
        return _checked(table, log.path)

    def _driver(self, trial: TrialConfig, seed: int, actor: str) -> tuple[EpisodeRunner, Ask | None]:
        """Return the episode runner of a trial, and the function that asks its filter."""
        ask = None if trial.method == NONE else in_process(self.models[trial.method])
        # SAILR's training ends an episode at an intervention. An evaluation continues, else goals could not compare.
        cuts = trial.method == SAILR and trial.policy == LEARNING
        driver = EpisodeRunner(
            self.robot,
            environment(self.robot, trial.arena, seed),
            ActorIdentity(actor, 0, self.cell.seed),
            penalty=self.cell.penalty,
            filtered=ask is not None,
            ends_on_intervention=cuts,
        )
        return driver, ask

    def _log(self, name: str, trial: TrialConfig) -> TrialLog:
        about = {"method": trial.method, "policy": trial.policy, "arena": trial.arena, "seed": str(self.cell.seed)}
        if trial.method == DDPC:
            about["certificate"] = self.cell.model_config.certificate
        metadata = {"run": about, "configuration": {"json": json.dumps(configuration(self.cell))}}
        return TrialLog(self.folder / f"{name}.mcap", metadata)


def _cost(model: Model, robot: RobotWithTask) -> dict[str, str]:
    """Return the cost of pre-training. Our data are recorded in an empty yard, where no collision is possible."""
    if isinstance(model, Pretrained):
        return {name: model.about[name] for name in ("samples", "collisions", "seconds", "error")}
    return {"samples": str(load_or_record(robot).steady().periods), "collisions": "0"}


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
