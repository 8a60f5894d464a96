"""Compare all methods from the same seeds (`brakeline compare`). Finished cells are not run again.

results/<robot>/<method>-s<seed>.json      one cell: configuration, figures, and one row per episode
results/<robot>/conservatism.json          every error bound and mode, with the stored policy and A*
results/<robot>/table.md table.json curves.png seeds.png      made from these files alone
runs/compare/<robot>/<cell>/               logs and policy of a cell (not in git)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brakeline.deploy.experiments import comparison_cells
from brakeline.deploy.experiments.comparison_cells import METHODS, CellConfig
from brakeline.messaging.task import robot_with_task

RESULTS, RUNS = Path("results"), Path("runs/compare")
EPISODES = 500
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class ComparisonJob:
    """One cell of the comparison as a job."""

    study: CellConfig

    @property
    def robot(self) -> str:
        return self.study.robot

    @property
    def name(self) -> str:
        return self.study.name

    def config(self) -> dict[str, Any]:
        return self.study.config()

    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        return comparison_cells.run(self.study, folder, say)


def cell_configs(robot: str, seeds: Iterable[int] = SEEDS, quick: bool = False) -> list[CellConfig]:
    """Return all cells of a robot, seed by seed, so that an interrupted comparison has complete seeds."""
    steps = robot_with_task(robot).task.steps
    wanted = [CellConfig(robot, method, seed, steps, EPISODES) for seed in seeds for method in METHODS]
    return [comparison_cells.quick(study) for study in wanted] if quick else wanted
