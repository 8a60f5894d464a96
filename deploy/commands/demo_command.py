"""Implement `brakeline demo`: show what the filter does, then train the ground robot for some minutes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from brakeline.deploy.commands.command_output import console, errors
from brakeline.deploy.commands.common_options import Json, Quiet, RunBusOptions, RunFolder, Seed, Verbose
from brakeline.deploy.commands.train_command import run_folder, train
from brakeline.deploy.progress import under_way
from brakeline.deploy.run.run_config import EXPERIMENTS
from brakeline.safety.model.model_config import AUTO, ModelConfig

EPISODES, ARENA = 20, "dense"  # of the stored policy


@dataclass(frozen=True)
class DemoCommand:
    """The options of `brakeline demo`."""

    steps: int = EXPERIMENTS["demo"].steps
    """Train for this many steps."""
    seed: Seed = 0
    out: RunFolder = None
    verbose: Verbose = False
    quiet: Quiet = False
    json: Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "train", "logs")
    least: ClassVar[dict[str, float]] = {"steps": 1}

    def run(self) -> int:
        """Drive the stored policy without and with the filter, then run the training. Returns the exit status."""
        self._driven("none", "the stored policy alone, among dense obstacles")
        filtered = self._driven("ddpc", "the same episodes behind the filter")
        share = filtered["interventions"] / max(filtered["steps"], 1)
        shown = errors if self.json else console
        shown.print(f"{share:.0%} of its inputs were corrected. Now a policy learns behind the filter, from nothing:")
        config = replace(EXPERIMENTS["demo"], steps=self.steps, seed=self.seed)
        with run_folder(self.out) as folder:
            return train(config, folder, False, RunBusOptions(), self.json, self.verbose, watch=True, browser=False)

    def _driven(self, method: str, what: str) -> dict[str, Any]:
        """Drive the stored policy, print how the episodes ended, and return the figures."""
        with under_way(what, EPISODES) as advance:
            from brakeline.deploy.experiments.evaluate import Evaluation, evaluate
            from brakeline.messaging.task import robot_with_task

            settings = Evaluation(
                policy="trained", method=method, model_config=ModelConfig(mode=AUTO), arena=ARENA, episodes=EPISODES
            )
            figures = evaluate(robot_with_task("ground"), settings, lambda stats: advance())
        colour = "red" if figures["collisions"] else "green"
        counts = f"{figures['goals']} of {EPISODES} goals, [{colour}]{figures['collisions']} collisions[/]"
        (errors if self.json else console).print(f"{what}: {counts}")
        return figures
