"""Implement `brakeline pretrain`: drive and fit what a rival method must know of a robot."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from brakeline.deploy.commands.command_output import console, errors, print_result
from brakeline.deploy.commands.common_options import Json, Quiet, Robot

if TYPE_CHECKING:
    from brakeline.deploy.experiments.tuning_trials import ThresholdTrial
    from brakeline.messaging.task import RobotWithTask
    from brakeline.safety.rivals.pretrained import Pretrained


@dataclass(frozen=True)
class PretrainCommand:
    """The options of `brakeline pretrain`."""

    method: Annotated[Literal["secas", "sailr", "cbf", "psf"], tyro.conf.Positional]
    """Pre-train this rival method, or choose the settings of one that knows its model by hand."""
    robot: Robot = "ground"
    samples: int | None = None
    """Drive this many steps. Defaults to the number that the comparison uses."""
    seed: int | None = None
    """Draw the driving from this seed. Defaults to the one that the comparison uses."""
    tune: bool = False
    """Try values of the method's threshold in closed loop, and name the best. This stores nothing."""
    episodes: int = 60
    """With --tune, drive this many episodes for each policy and value."""
    quiet: Quiet = False
    json: Json = False

    def run(self) -> int:
        """Pretrain or tune the method. Returns the exit status."""
        from brakeline.deploy.data.data_paths import method_path
        from brakeline.deploy.data.model_store import pretrained
        from brakeline.deploy.data.rival_pretraining import config_for
        from brakeline.messaging.task import robot_with_task
        from brakeline.safety.model.model_config import ModelConfig

        robot = robot_with_task(self.robot)
        config = config_for(self.method, robot)
        changed = {name: value for name in ("samples", "seed") if (value := getattr(self, name)) is not None}
        if changed and not hasattr(config, "samples"):
            raise ValueError(
                f"{self.method} knows its model by hand and drives nothing: leave out --samples and --seed"
            )
        model = pretrained(robot, self.method, replace(config, **changed), again=not self.tune)
        if self.tune:
            return self._tune(model, robot)
        path = method_path(robot, self.method, ModelConfig())
        figures = {"path": str(path), "version": model.version, "settings": dict(model.settings)} | model.about
        print_result(self.json, figures, f"{path}: {model.version}")
        return 0

    def _tune(self, model: Pretrained, robot: RobotWithTask) -> int:
        from brakeline.deploy.experiments.tuning_trials import best_threshold, tune_threshold, values_of

        rows = tune_threshold(model, robot, values_of(self.method, robot), self.episodes, self._print_row)
        chosen = best_threshold(rows)
        best = f"best: {chosen.value:g}, which has the fewest collisions of the values at which A* loses no goal"
        print_result(self.json, {"tried": [asdict(row) for row in rows], "best": chosen.value}, best)
        return 0

    def _print_row(self, row: ThresholdTrial) -> None:
        (errors if self.json else console).print(
            f"{row.value:g}: A* {row.oracle_goals} goals of {row.episodes}, {row.oracle_interventions:.1%} "
            f"interventions; greedy {row.greedy_goals} goals, {row.greedy_collisions} collisions"
        )
