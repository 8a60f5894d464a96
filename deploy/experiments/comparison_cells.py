"""Compare all methods from the same seeds: train a method from a seed, then evaluate it on the shared fresh episodes.

One cell of the comparison is one method with one seed. `brakeline compare` makes the tables from these files alone:

results/<robot>/<method>-s<seed>.json      one cell: configuration, figures, and one row per episode
results/<robot>/conservatism.json          every error bound and mode, with the stored policy and A*
results/<robot>/tuning-<method>-<value>.json   what came of a value of a rival's setting
results/<robot>/table.md table.json curves.png seeds.png profiles.png
results/README.md                          the page about all robots
runs/compare/<robot>/<cell>/               logs and policy of a cell (not in git)
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brakeline.deploy.experiments.compared_methods import (
    BATCHES,
    EVERY,
    METHODS,
    NONE,
    TD3_LEARNER,
    compared,
    short_name,
)
from brakeline.deploy.experiments.experiment_jobs import task_hash
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED
from brakeline.learner.learner_config import TD3Config
from brakeline.messaging.task import STUDIED
from brakeline.safety.model.model_config import AUTO, DDPC, SAILR, SECAS, ModelConfig

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Backend

RESULTS, RUNS = Path("results"), Path("runs/compare")
LEARNING = "learning"
SEEDS: dict[str, int] = {"batch": 10, "single": 3}  # how many, by backend
EPISODES = 500  # of each evaluation
AT_PENALTY_1 = (NONE, SECAS, SAILR)  # no task's penalty was chosen with these filters, or there is no filter
TIMED = 10  # episodes that time single decisions, where a batch makes the others

Report = Callable[[str], object]


@dataclass(frozen=True)
class TrialConfig:
    """One evaluation: policy, method of the filter, arena and number of episodes."""

    policy: str  # trained | untrained | learning
    method: str
    arena: str
    episodes: int

    @property
    def name(self) -> str:
        """The name of its log, and of its figures in the cell's file."""
        return f"{self.policy}-{short_name(self.method)}-{self.arena}"


@dataclass(frozen=True)
class CellConfig:
    """The configuration of a cell. With the version of the code, it determines the results."""

    robot: str  # ROBOT, or ROBOT+TASK for another task than the default: ground+tracks
    method: str  # of `compared_methods`
    seed: int
    steps: int
    episodes: int
    arenas: tuple[str, ...] = STUDIED  # for the evaluation; training uses the first
    penalty: float = 1.0  # for corrections
    model_config: ModelConfig = field(default_factory=ModelConfig)
    td3: TD3Config = field(default_factory=TD3Config)
    backend: Backend = "single"  # batch: trains and evaluates many robots at once
    robots: int = 64  # of a batch that trains
    physics: int = 1  # version of the simulator (`Task.simulator_version`); results of different ones do not compare
    untrained: int = 100  # episodes of the untrained policy; few, because they last until the time limit
    task: str = ""  # see `experiment_jobs.task_hash`
    # Version of the model set that filters. Empty: no trial needs one, or it is of the usual mode of a robot of ours.
    model_set: str = ""
    code: str = ""  # version of a filter of your own (`OwnCode`); empty: no such filter

    def __post_init__(self) -> None:
        from brakeline.messaging.task import check_penalty

        check_penalty(self.penalty)

    @property
    def name(self) -> str:
        return f"{short_name(self.method)}-s{self.seed}"

    def of_shipped_set(self) -> bool:
        """Return whether our filter has the usual settings for a robot that comes with Brakeline."""
        return not self.task and self.model_config == ModelConfig()

    def trials(self) -> list[TrialConfig]:
        """Return the evaluations for the table, then those that add or remove the filter after training."""
        first = self.arenas[0]
        table = [TrialConfig(TRAINED, compared(self.method).filter, arena, self.episodes) for arena in self.arenas]
        if self.method == DDPC:
            table.append(TrialConfig(TRAINED, NONE, first, self.episodes))
            table.append(TrialConfig(UNTRAINED, DDPC, first, self.untrained))
        if self.method == NONE:
            table.append(TrialConfig(TRAINED, DDPC, first, self.episodes))
        return table

    def filters(self) -> set[str]:
        """Return the methods that filter in the training and in the evaluations."""
        return {compared(self.method).filter, *(trial.method for trial in self.trials())} - {NONE}

    def run(self, folder: Path, say: Report = lambda text: None) -> dict[str, Any]:
        """Train, evaluate, and check the figures against the logs. Logs and policy stay in `folder`.

        Raises:
            ResultError: a log does not agree with the figures.
        """
        from brakeline.deploy.experiments.cell_run import CellRun  # brings simulators and learner

        return CellRun(self, folder, say).result()


def backend_for(robot: str, arenas: Iterable[str]) -> Backend:
    """Return the backend of a robot's cells: batch, where the robot and all arenas allow it."""
    from brakeline.errors import NoBatch
    from brakeline.messaging.task import robot_with_task
    from brakeline.sim.batch.batch_support import check_batch
    from brakeline.sim.sim_conditions import Conditions

    try:
        for arena in arenas:
            check_batch(robot_with_task(robot), arena, Conditions())
    except NoBatch:
        return "single"
    return "batch"


def learning(
    td3: TD3Config, method: str, robot: str, settings: Mapping[str, Any], given: Collection[str] = ()
) -> TD3Config:
    """Return the learner's settings, with those of the method and of the robot's task in place of the defaults.

    Args:
        robot: its name: a method may have settings that were tuned on it.
        settings: `Task.learner`, for TD3 behind a filter that replaces single inputs. SAILR ends an episode instead.
        given: names of settings that stay as they are in `td3`.

    A batch keeps an update for each step. With an update for every fourth one, as `train --backend batch` makes, TD3
    without a filter stood still after 60,000 steps (seed 0); with one for each it reached 493 of 500 goals.
    """
    row = compared(method)
    with_task = row.filter not in (NONE, SAILR) and row.learner == TD3_LEARNER
    return td3.with_settings({**(settings if with_task else {}), **row.learner_settings(robot)}, given)


def compared_on(robot: str, arenas: Iterable[str]) -> tuple[str, ...]:
    """Return the methods that are compared on a robot in these arenas."""
    kinds = {EVERY, BATCHES} if backend_for(robot, arenas) == "batch" else {EVERY}
    return tuple(name for name, method in METHODS.items() if method.robots in kinds)


def quick(cell: CellConfig, given: Collection[str] = ()) -> CellConfig:
    """Return a cell that runs in a minute: enough to test the code and end an episode, too short to learn.

    The settings of the learner that are `given` stay.
    """
    small: dict[str, Any] = {"hidden": (64, 64), "batch": 64, "warmup": 500}
    td3 = replace(cell.td3, **{name: value for name, value in small.items() if name not in given})
    return replace(cell, steps=4_000, robots=8, episodes=10, untrained=5, td3=td3)


def cell_configs(
    robot: str,
    methods: Iterable[str],
    seeds: Iterable[int] | None = None,
    arenas: tuple[str, ...] = CellConfig.arenas,
    backend: Backend | None = None,
) -> list[CellConfig]:
    """Return the cells of a robot, seed by seed, so that an interrupted comparison has complete seeds."""
    from brakeline.messaging.task import robot_with_task

    methods, task, backend = tuple(methods), robot_with_task(robot).task, backend or backend_for(robot, arenas)
    others: dict[str, Any] = {"backend": backend, "robots": task.at_once, "physics": task.simulator_version}
    if own := task_hash(robot):  # its model set is the one in use; the stored cells of the others have mode direct
        others |= {"task": own, "model_config": ModelConfig(mode=AUTO)}
    seeds = range(SEEDS[backend]) if seeds is None else seeds
    penalties = {
        name: 1.0 if compared(name).filter in AT_PENALTY_1 else task.reward.correction_penalty for name in methods
    }
    return [
        CellConfig(robot, method, seed, task.steps, EPISODES, arenas, penalty=penalties[method], **others)
        for seed, method in itertools.product(seeds, methods)
    ]
