"""One cell of the comparison: a method trained from one seed, and its policy evaluated on the fresh episodes that all
methods share. Everything it found goes into one small JSON file, from which tables and figures are drawn.
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


class FigureMismatch(RuntimeError):
    """A run's log does not say what the run counted."""


@dataclass(frozen=True)
class TrialConfig:
    """An evaluation: whose policy, behind which filter, where, how often."""

    policy: str  # trained | untrained | learning
    method: str
    arena: str
    episodes: int

    @property
    def name(self) -> str:
        return f"{self.policy}-{self.method}-{self.arena}"


@dataclass(frozen=True)
class CellConfig:
    """What a cell depends on, besides the version of the code."""

    robot: str  # and its task, where that is another than the usual one: ground+tracks
    method: str
    seed: int
    steps: int
    episodes: int
    arenas: tuple[str, ...] = ("default", "dense")  # of the evaluation; training is in the first
    penalty: float = 1.0
    model_config: ModelConfig = field(default_factory=ModelConfig)
    td3: TD3Config = field(default_factory=TD3Config)
    untrained: int = 100  # episodes of the untrained policy, which take their full time

    @property
    def name(self) -> str:
        return f"{self.method}-s{self.seed}"

    def trials(self) -> list[TrialConfig]:
        """The table's, then those of deployment: with a filter that was not there in training, and the reverse."""
        first = self.arenas[0]
        table = [TrialConfig(TRAINED, self.method, arena, self.episodes) for arena in self.arenas]
        if self.method == DDPC:
            table.append(TrialConfig(TRAINED, NONE, first, self.episodes))
            table.append(TrialConfig(UNTRAINED, DDPC, first, self.untrained))
        if self.method == NONE:
            table.append(TrialConfig(TRAINED, DDPC, first, self.episodes))
        return table

    def config(self) -> dict[str, Any]:
        """As JSON gives it back."""
        config: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return config


Report = Callable[[str], object]


def run(study: CellConfig, folder: Path, say: Report = lambda text: None) -> dict[str, Any]:
    """Train, evaluate, and confirm the figures from the logs, which stay in `folder` with the policy.

    Raises:
        FigureMismatch: a log says something else than was counted.
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
    """What was driven beforehand, and how it went. Ours is recorded in an empty yard: there is nothing to touch."""
    if isinstance(model, Pretrained):
        return {name: model.about[name] for name in ("samples", "collisions", "seconds", "error")}
    return {"samples": str(load_or_record(robot).periods), "collisions": "0"}


def _driver(study: CellConfig, trial: TrialConfig, robot: RobotWithTask, seed: int, actor: str) -> EpisodeRunner:
    env = environment(robot, trial.arena, seed)
    identity, filtered = ActorIdentity(actor, 0, study.seed), trial.method != NONE
    # at an intervention training calls the episode off; an evaluation goes on, or its goal rate would mean nothing
    cuts = trial.method == SAILR and trial.policy == LEARNING
    return EpisodeRunner(robot, env, identity, penalty=study.penalty, filtered=filtered, ends_on_intervention=cuts)


def _question(models: dict[str, Model], method: str) -> Ask | None:
    return None if method == NONE else in_process(models[method])


def _train(
    study: CellConfig, robot: RobotWithTask, models: dict[str, Model], folder: Path, say: Report
) -> dict[str, Any]:
    trial = TrialConfig(LEARNING, study.method, study.arenas[0], 0)
    config = LearnerConfig(td3=study.td3, seed=study.seed, steps=study.steps)
    driver = _driver(study, trial, robot, study.seed, study.name)
    trainer = Trainer(driver, _question(models, study.method), Learner(robot, config))
    found, log_file = EpisodeTable(), folder / "training.mcap"
    with TrialLog(log_file, _metadata(study, trial)) as log:
        for count, step in enumerate(trainer.run(log), 1):
            found.step(step)
            if count % 1000 == 0:
                goals = sum(row[1] for row in found.rows[-50:]) / max(len(found.rows[-50:]), 1)
                say(f"step {count}, goals {goals:.0%}")
    trainer.policy.save(folder / "policy.safetensors")
    return _confirmed(found, log_file) | {"steps": study.steps, "updates": trainer.learner.updates}


def _evaluate(
    study: CellConfig, trial: TrialConfig, robot: RobotWithTask, models: dict[str, Model], folder: Path, say: Report
) -> dict[str, Any]:
    say(trial.name)
    name = str(folder / "policy.safetensors") if trial.policy == TRAINED else UNTRAINED
    driver = _driver(study, trial, robot, FRESH, trial.name)
    log_file = folder / f"{trial.name}.mcap"
    with TrialLog(log_file, _metadata(study, trial)) as log:
        policy = policy_named(name, robot, study.seed)
        found = evaluate(driver, policy, _question(models, trial.method), trial.episodes, log)
    return _confirmed(found, log_file)


def _metadata(study: CellConfig, trial: TrialConfig) -> dict[str, dict[str, str]]:
    certificate = {"certificate": study.model_config.certificate} if trial.method == DDPC else {}
    about = {"method": trial.method, "policy": trial.policy, "arena": trial.arena, "seed": str(study.seed)}
    return {"run": about | certificate, "configuration": {"json": json.dumps(study.config())}}


def _confirmed(found: EpisodeTable, log_file: Path) -> dict[str, Any]:
    """The counted figures, with those of the log beside them, which must agree."""
    columns, logged = found.columns(), analyse(log_file)
    for name, counted in (
        ("steps", found.decisions),
        ("episodes", len(found.rows)),
        ("goals", sum(columns["goal"])),
        ("timeouts", sum(columns["timeout"])),
        ("contacts_moving", sum(columns["contact_moving"])),
        ("contacts_standing", sum(columns["contact_standing"])),
    ):
        if logged[name] != counted:
            raise FigureMismatch(f"{log_file} says {logged[name]} {name}, the run counted {counted}")
    if logged["collisions"] < sum(columns["collision"]):
        raise FigureMismatch(f"{log_file} says {logged['collisions']} collisions, the run counted more")
    kept = ("collisions", "interventions", "failsafes", "mean_speed", "max_speed", "mean_reward", "containment")
    return {
        "episodes": columns,
        "decision_ms": found.decision_ms(),
        "logged": {name: logged[name] for name in kept},
    }


def quick(study: CellConfig) -> CellConfig:
    """The same in a minute: enough to see that everything works, not to learn anything."""
    td3 = replace(study.td3, hidden=(64, 64), batch=64, warmup=500)
    return replace(study, steps=2_000, episodes=10, untrained=5, td3=td3)
