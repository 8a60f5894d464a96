"""One cell of the comparison: train a method from one seed, then evaluate its policy on the shared fresh episodes.

The results go to one small JSON file, from which tables and plots are made.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.data.simulated_recording import load_or_record
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.experiments.trials import EpisodeTable, Trainer, TrialLog, evaluate
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED, policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import FigureMismatch
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.logs.report import analyse
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.methods import DDPC, Model
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.sailr import SAILR
from brakeline.safety.rivals.secas import SECAS

NONE, LEARNING = "none", "learning"
METHODS = (DDPC, SAILR, SECAS, NONE)  # in the order of the paper's table
PACKAGES = ("brakeline", "mujoco", "proxsuite", "numpy", "torch")


@dataclass(frozen=True)
class TrialConfig:
    """One evaluation: policy, filter method, arena and number of episodes."""

    policy: str  # trained | untrained | learning
    method: str
    arena: str
    episodes: int

    @property
    def name(self) -> str:
        return f"{self.policy}-{self.method}-{self.arena}"


@dataclass(frozen=True)
class CellConfig:
    """The configuration of a cell. With the version of the code, it determines the results."""

    robot: str  # ROBOT, or ROBOT+TASK for another task than the default: ground+tracks
    method: str
    seed: int
    steps: int
    episodes: int
    arenas: tuple[str, ...] = ("default", "dense")  # for the evaluation; training uses the first
    penalty: float = 1.0
    model_config: ModelConfig = field(default_factory=ModelConfig)
    td3: TD3Config = field(default_factory=TD3Config)
    untrained: int = 100  # episodes of the untrained policy; few, because they last until the time limit

    @property
    def name(self) -> str:
        return f"{self.method}-s{self.seed}"

    def trials(self) -> list[TrialConfig]:
        """Return the evaluations for the table, then those that add or remove the filter after training."""
        first = self.arenas[0]
        table = [TrialConfig(TRAINED, self.method, arena, self.episodes) for arena in self.arenas]
        if self.method == DDPC:
            table.append(TrialConfig(TRAINED, NONE, first, self.episodes))
            table.append(TrialConfig(UNTRAINED, DDPC, first, self.untrained))
        if self.method == NONE:
            table.append(TrialConfig(TRAINED, DDPC, first, self.episodes))
        return table

    def config(self) -> dict[str, Any]:
        """Return the configuration as JSON values."""
        config: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return config


Report = Callable[[str], object]


def run(study: CellConfig, folder: Path, say: Report = lambda text: None) -> dict[str, Any]:
    """Train, evaluate, and check the figures against the logs. Logs and policy stay in `folder`.

    Raises:
        FigureMismatch: a log does not agree with the figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    robot = robot_with_task(study.robot)
    models: dict[str, Model] = {}
    for method in {study.method, *(trial.method for trial in study.trials())} - {NONE}:
        models[method] = method_for(robot, method, study.model_config)
    training = _train(study, robot, models, folder, say)
    evaluations = {trial.name: _evaluate(study, trial, robot, models, folder, say) for trial in study.trials()}
    model = models.get(study.method)
    return {
        "study": study.config(),
        "model": None if model is None else {"version": model.version, **_cost(model, robot)},
        "policy": hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()[:16],
        "versions": {name: version(name) for name in PACKAGES},
        "training": training,
        "evaluations": evaluations,
    }


def _cost(model: Model, robot: RobotWithTask) -> dict[str, str]:
    """Return the cost of pre-training. Our data are recorded in an empty yard, where no collision is possible."""
    if isinstance(model, Pretrained):
        return {name: model.about[name] for name in ("samples", "collisions", "seconds", "error")}
    return {"samples": str(load_or_record(robot).periods), "collisions": "0"}


def _episode_runner(
    study: CellConfig, trial: TrialConfig, robot: RobotWithTask, seed: int, actor: str
) -> EpisodeRunner:
    env = environment(robot, trial.arena, seed)
    identity, filtered = ActorIdentity(actor, 0, study.seed), trial.method != NONE
    # SAILR's training ends an episode at an intervention. An evaluation continues, else goal rates could not compare.
    cuts = trial.method == SAILR and trial.policy == LEARNING
    return EpisodeRunner(robot, env, identity, penalty=study.penalty, filtered=filtered, ends_on_intervention=cuts)


def _decision_service(models: dict[str, Model], method: str) -> Ask | None:
    return None if method == NONE else in_process(models[method])


def _train(
    study: CellConfig, robot: RobotWithTask, models: dict[str, Model], folder: Path, say: Report
) -> dict[str, Any]:
    trial = TrialConfig(LEARNING, study.method, study.arenas[0], 0)
    config = LearnerConfig(td3=study.td3, seed=study.seed, steps=study.steps)
    driver = _episode_runner(study, trial, robot, study.seed, study.name)
    trainer = Trainer(driver, _decision_service(models, study.method), Learner(robot, config))
    table, log_file = EpisodeTable(), folder / "training.mcap"
    with TrialLog(log_file, _metadata(study, trial)) as log:
        for count, step in enumerate(trainer.run(log), 1):
            table.step(step)
            if count % 1000 == 0:
                goals = sum(row[1] for row in table.rows[-50:]) / max(len(table.rows[-50:]), 1)
                say(f"step {count}, goals {goals:.0%}")
    trainer.policy.save(folder / "policy.safetensors")
    return _check_against_log(table, log_file) | {"steps": study.steps, "updates": trainer.learner.updates}


def _evaluate(
    study: CellConfig, trial: TrialConfig, robot: RobotWithTask, models: dict[str, Model], folder: Path, say: Report
) -> dict[str, Any]:
    say(trial.name)
    name = str(folder / "policy.safetensors") if trial.policy == TRAINED else UNTRAINED
    driver = _episode_runner(study, trial, robot, FRESH, trial.name)
    log_file = folder / f"{trial.name}.mcap"
    with TrialLog(log_file, _metadata(study, trial)) as log:
        policy = policy_named(name, robot, study.seed)
        table = evaluate(driver, policy, _decision_service(models, trial.method), trial.episodes, log)
    return _check_against_log(table, log_file)


def _metadata(study: CellConfig, trial: TrialConfig) -> dict[str, dict[str, str]]:
    certificate = {"certificate": study.model_config.certificate} if trial.method == DDPC else {}
    about = {"method": trial.method, "policy": trial.policy, "arena": trial.arena, "seed": str(study.seed)}
    return {"run": about | certificate, "configuration": {"json": json.dumps(study.config())}}


def _check_against_log(table: EpisodeTable, log_file: Path) -> dict[str, Any]:
    """Return the counted figures and those of the log. Raises FigureMismatch if they disagree."""
    columns, logged = table.columns(), analyse(log_file)
    for name, counted in (
        ("steps", table.decisions),
        ("episodes", len(table.rows)),
        ("goals", sum(columns["goal"])),
        ("timeouts", sum(columns["timeout"])),
        ("contacts_moving", sum(columns["contact_moving"])),
        ("contacts_standing", sum(columns["contact_standing"])),
    ):
        if logged[name] != counted:
            raise FigureMismatch(f"{log_file} has {logged[name]} {name}, but the run counted {counted}")
    if logged["collisions"] < sum(columns["collision"]):
        raise FigureMismatch(f"{log_file} has {logged['collisions']} collisions, but the run counted more")
    logged_names = ("collisions", "interventions", "failsafes", "mean_speed", "max_speed", "mean_reward", "containment")
    return {
        "episodes": columns,
        "decision_ms": table.decision_ms(),
        "logged": {name: logged[name] for name in logged_names},
    }


def quick(study: CellConfig) -> CellConfig:
    """Return a cell that runs in a minute: enough to test the code, too short to learn."""
    td3 = replace(study.td3, hidden=(64, 64), batch=64, warmup=500)
    return replace(study, steps=2_000, episodes=10, untrained=5, td3=td3)
