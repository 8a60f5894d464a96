"""Compare all methods from the same seeds: train a method from a seed, then evaluate it on the shared fresh episodes.

One cell of the comparison is one method with one seed. `brakeline compare` makes the tables from these files alone:

results/<robot>/<method>-s<seed>.json      one cell: configuration, figures, and one row per episode
results/<robot>/conservatism.json          every error bound and mode, with the stored policy and A*
results/<robot>/table.md table.json curves.png seeds.png
runs/compare/<robot>/<cell>/               logs and policy of a cell (not in git)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brakeline.deploy.policy_loading import TRAINED, UNTRAINED
from brakeline.deploy.run.run_config import BATCH_TD3
from brakeline.learner.learner_config import TD3Config
from brakeline.safety.model.model_config import DDPC, SAILR, SECAS, ModelConfig

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Backend

RESULTS, RUNS = Path("results"), Path("runs/compare")
NONE, LEARNING = "none", "learning"
METHODS = (DDPC, SAILR, SECAS, NONE)  # in the order of the paper's table
SEEDS = (0, 1, 2)
EPISODES = 500  # of each evaluation
TIMED = 10  # episodes that time single decisions, where a batch makes the others
ROBOTS = 64  # of a batch that trains
PHYSICS = 2  # of the simulators; raise it with a change after which older results are not comparable

Report = Callable[[str], object]


@dataclass(frozen=True)
class TrialConfig:
    """One evaluation: policy, filter method, arena and number of episodes."""

    policy: str  # trained | untrained | learning
    method: str
    arena: str
    episodes: int

    @property
    def name(self) -> str:
        """The name of its log, and of its figures in the cell's file."""
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
    backend: Backend = "single"  # batch: trains and evaluates many robots at once
    physics: int = PHYSICS
    untrained: int = 100  # episodes of the untrained policy; few, because they last until the time limit

    @property
    def name(self) -> str:
        """The name of the cell's file."""
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
    from brakeline.sim.batch.batch_env import check_batch
    from brakeline.sim.sim_conditions import Conditions

    try:
        for arena in arenas:
            check_batch(robot_with_task(robot), arena, Conditions())
    except NoBatch:
        return "single"
    return "batch"


def learning(td3: TD3Config, backend: Backend) -> TD3Config:
    """Return the learner's settings with those of a batch in place of the defaults, if a batch trains."""
    default = TD3Config()
    changed = {name: value for name, value in BATCH_TD3.items() if getattr(td3, name) == getattr(default, name)}
    return replace(td3, **changed) if backend == "batch" else td3


def quick(cell: CellConfig) -> CellConfig:
    """Return a cell that runs in a minute: enough to test the code, too short to learn."""
    td3 = replace(cell.td3, hidden=(64, 64), batch=64, warmup=500)
    return replace(cell, steps=2_000, episodes=10, untrained=5, td3=td3)


def cell_configs(robot: str, seeds: Iterable[int] = SEEDS) -> list[CellConfig]:
    """Return all cells of a robot, seed by seed, so that an interrupted comparison has complete seeds."""
    from brakeline.messaging.task import robot_with_task

    steps = robot_with_task(robot).task.steps
    return [CellConfig(robot, method, seed, steps, EPISODES) for seed in seeds for method in METHODS]
