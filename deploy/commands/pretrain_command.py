"""Implement `brakeline pretrain`: drive and fit what a rival method must know of a robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import tyro

from brakeline.deploy.commands.command_output import print_result
from brakeline.deploy.commands.common_options import Json, Quiet, Robot


@dataclass(frozen=True)
class PretrainCommand:
    """The options of `brakeline pretrain`."""

    method: Annotated[Literal["secas", "sailr", "cbf", "psf"], tyro.conf.Positional]
    """Pre-train this rival method. The equations of cbf and psf are written by hand: for these, the command only
    chooses the settings."""
    robot: Robot = "ground"
    samples: int | None = None
    """Drive this many steps. Defaults to the number that the comparison uses."""
    seed: int | None = None
    """Draw the driving from this seed. Defaults to the one that the comparison uses."""
    quiet: Quiet = False
    json: Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "train")
    least: ClassVar[dict[str, float]] = {"samples": 1}

    def run(self) -> int:
        """Pretrain the method. Returns the exit status."""
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
                f"{self.method} has equations written by hand and needs no driving: leave out --samples and --seed"
            )
        model = pretrained(robot, self.method, replace(config, **changed), again=True)
        path = method_path(robot, self.method, ModelConfig())
        figures = {"path": str(path), "version": model.version, "settings": dict(model.settings)} | model.about
        print_result(self.json, figures, f"{path}: {model.version}")
        return 0
