"""Tune one setting of every rival with the same budget, as jobs whose results the results page lists.

Each rival tries four values, TD3-Lagrange six. Among the values of a filter with which A* reaches the most goals,
choose the one with the fewest collisions of the greedy policy, which drives straight to the goal. Break ties by the
goals of the greedy policy, then by the interventions on A*. The results are the `rivals` of the task files.

A learner trains once with each value, from a seed that no comparison uses, and drives 120 episodes in the first
arena. Among the values whose goals come within `NEARLY` of the most, its best one has the fewest collisions, then the
most goals.

The episodes of a tuning evaluate nothing else, so the choice cannot favour a value by the rooms of the comparison.

results/<robot>/tuning-<method>-<value>.json
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from brakeline.deploy.experiments.compared_methods import METHODS, NONE, SAC_LEARNER
from brakeline.deploy.experiments.comparison_cells import CellConfig, cell_configs, learning
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.experiments.experiment_jobs import configuration, task_hash
from brakeline.deploy.experiments.trials import fresh_trial
from brakeline.learner.learner_config import TD3Config
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.task_code import is_own_code
from brakeline.safety.model.model_config import CBF, DDPC, PSF, SAILR, SECAS, ModelConfig
from brakeline.safety.rivals.pretrained import Pretrained

SEED = 1000  # of the trainings
EPISODES = 120  # of a learner, and of each of the two policies that try a filter
SEED_KEY = 2_000_000  # of the episodes of the tunings, which no training and no evaluation has
NEARLY = 0.05  # of the episodes
SETTINGS: dict[str, tuple[str, tuple[float, ...]]] = {  # of learners: field of `TD3Config`, values
    "lagrange": ("multiplier_rate", (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)),
    "sac": ("actor_rate", (1e-4, 3e-4, 1e-3, 3e-3)),
}

ORACLE, GREEDY = "astar", "greedy"
VALUES = {
    SAILR: (0.03, 0.05, 0.08, 0.15),  # η; its authors' is 0.08
    CBF: (0.5, 1.0, 2.0, 4.0),  # α [1/s]
    PSF: (0.0, 0.01, 0.02, 0.04),  # margin [m] of a unicycle
}
SETTING = {SECAS: "clearance", SAILR: "threshold", CBF: "rate", PSF: "margin"}


def values_of(method: str, robot: RobotWithTask) -> tuple[float, ...]:
    """Return the values of a method's setting to try."""
    in_metres = method == SECAS or (method == PSF and robot.heading is None)  # a vehicle needs more than a unicycle
    return robot.task.rivals.margins if in_metres else VALUES[method]


def try_threshold(model: Pretrained, robot: RobotWithTask, value: float, episodes: int) -> dict[str, Any]:
    """Return the figures of the model with another value of `SETTING` on the tuning's episodes, with each policy.

    value: of SECAS, its margin to the footprint. The interventions are a share of the steps.
    """
    setting = robot.footprint + value if model.method == SECAS else value
    ask = in_process(replace(model, settings=dict(model.settings) | {SETTING[model.method]: setting}))
    oracle, greedy = (fresh_trial(robot, "default", policy, ask, episodes, SEED_KEY) for policy in (ORACLE, GREEDY))
    reached, driven = oracle.columns(), greedy.columns()
    return {
        "value": value,
        "episodes": episodes,
        "oracle_goals": int(sum(reached["goal"])),
        "oracle_interventions": sum(reached["interventions"]) / max(oracle.decisions, 1),
        "greedy_goals": int(sum(driven["goal"])),
        "greedy_collisions": int(sum(driven["collision"])),
    }


def best_threshold(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the best row of a filter by the rule of this module."""
    most = max(row["oracle_goals"] for row in rows)
    rows = [row for row in rows if row["oracle_goals"] == most]
    return min(rows, key=lambda row: (row["greedy_collisions"], -row["greedy_goals"], row["oracle_interventions"]))


@dataclass(frozen=True)
class FilterTuning:
    """A value of a filter's setting."""

    robot: str
    method: str
    value: float
    physics: int
    episodes: int = EPISODES
    seed_key: int = SEED_KEY
    task: str = ""  # see `experiment_jobs.task_hash`

    @property
    def name(self) -> str:
        return f"tuning-{self.method}-{self.value:g}"

    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        """Drive the episodes, and return the figures."""
        from brakeline.deploy.data.model_store import method_for

        robot = robot_with_task(self.robot)
        model = method_for(robot, self.method, ModelConfig())
        assert isinstance(model, Pretrained)
        return {"study": configuration(self), **try_threshold(model, robot, self.value, self.episodes)}


@dataclass(frozen=True)
class LearnerTuning:
    """A value of a learner's setting."""

    robot: str
    method: str
    value: float
    cell: CellConfig
    seed_key: int = SEED_KEY

    @property
    def name(self) -> str:
        return f"tuning-{self.method}-{self.value:g}"

    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        """Train and evaluate, and return the figures."""
        from brakeline.deploy.experiments.cell_run import CellRun

        result = CellRun(self.cell, folder, say, self.seed_key).result()
        episodes = next(iter(result["evaluations"].values()))["episodes"]
        return {
            "study": configuration(self),
            "value": self.value,
            "episodes": len(episodes["goal"]),
            "goals": sum(episodes["goal"]),
            "collisions": sum(episodes["collision"]),
            "training_collisions": sum(result["training"]["episodes"]["collision"]),
        }


def value_in_use(cell: dict[str, Any], footprint: float) -> float | None:
    """Return the value of the tuned setting with which a cell was made; None if its file does not say."""
    method = cell["study"]["method"]
    if method in SETTINGS:
        return float(cell["study"]["td3"][SETTINGS[method][0]])
    value = ((cell["model"] or {}).get("settings") or {}).get(SETTING.get(method, ""))
    return None if value is None else round(value - (footprint if method == SECAS else 0.0), 9)


def tuning_jobs(robot: str, methods: Sequence[str], arenas: tuple[str, ...]) -> list[FilterTuning | LearnerTuning]:
    """Return the jobs that tune the rivals among some methods.

    Raises:
        ValueError: a method is code of your own, or the task lacks a scripted policy that the tuning drives by.
    """
    jobs: list[FilterTuning | LearnerTuning] = []
    task = robot_with_task(robot).task
    for method in methods:
        if is_own_code(method):
            raise ValueError(f"{method}: the tuning knows settings of the rivals in its table alone, not yours")
        rival = METHODS[method].filter
        if method in SETTINGS:
            name, values = SETTINGS[method]
            (cell,) = cell_configs(robot, (method,), (SEED,), arenas[:1])
            used = learning(TD3Config(), method, robot, task.learner)
            for value in values:
                changed: dict[str, Any] = {name: value}
                own = replace(cell, td3=replace(used, **changed), episodes=EPISODES)
                jobs.append(LearnerTuning(robot, method, value, own))
        elif rival not in (NONE, DDPC) and METHODS[method].learner != SAC_LEARNER:
            if missing := [name for name in (ORACLE, GREEDY) if name not in task.policies]:
                raise ValueError(f"the tuning drives by scripted policies, and the task of {robot} has no {missing[0]}")
            values = values_of(rival, robot_with_task(robot))
            own_task = task_hash(robot)
            jobs += [FilterTuning(robot, method, value, task.simulator_version, task=own_task) for value in values]
    return jobs


def best_learner(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the best row of a learner by the rule of this module."""
    most = max(row["goals"] / row["episodes"] for row in rows)
    near = [row for row in rows if row["goals"] / row["episodes"] >= most - NEARLY - 1e-9]
    return min(near, key=lambda row: (row["collisions"] / row["episodes"], -row["goals"]))
