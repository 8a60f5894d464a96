"""Implement `brakeline demo`: train the ground robot for some minutes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from brakeline.deploy.commands.common_options import Json, RunBusOptions, RunFolder, Seed, Verbose
from brakeline.deploy.commands.train_command import dated_folder, train
from brakeline.deploy.run.run_config import EXPERIMENTS


@dataclass(frozen=True)
class DemoCommand:
    """The options of `brakeline demo`."""

    steps: int = EXPERIMENTS["demo"].steps
    """Train for this many steps."""
    seed: Seed = 0
    out: RunFolder = None
    verbose: Verbose = False
    json: Json = False

    def run(self) -> int:
        """Run the training. Returns the exit status."""
        config = replace(EXPERIMENTS["demo"], steps=self.steps, seed=self.seed)
        return train(config, self.out or dated_folder(), False, RunBusOptions(), self.json, self.verbose)
