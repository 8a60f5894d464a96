"""Implement `brakeline learner`: run a learner alone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

from brakeline.deploy.commands.command_output import errors
from brakeline.deploy.commands.common_options import BusOptions, Robot, Unprefixed, task_learner
from brakeline.deploy.commands.train_command import STOPPED
from brakeline.deploy.run.run_config import RunConfig
from brakeline.learner.learner_config import LearnerConfig
from brakeline.messaging.task import address


@dataclass(frozen=True)
class LearnerCommand:
    """The options of `brakeline learner`."""

    robot: Robot = "ground"
    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    out: Path = Path("runs/learner")
    """Store the checkpoint and the policy in this folder."""
    resume: bool = False
    """Resume from the checkpoint in the folder. It is an error if there is none."""
    resume_if_any: bool = False
    """Resume from the checkpoint in the folder if there is one. Use it if a supervisor restarts the process."""
    name: str = "learner"
    """Give the learner this name on the bus."""
    seed: int = 0
    """Draw weights and batches from this seed."""
    steps: int = 100_000
    """Train for this many steps."""
    learner: LearnerConfig = field(default_factory=lambda: RunConfig().learner)

    least: ClassVar[dict[str, float]] = {"steps": 1}

    @classmethod
    def defaults(cls, arguments: list[str]) -> Self:
        """Return the default options, with the settings of the learner that the task of the named robot has."""
        return cls(learner=task_learner(RunConfig().learner, arguments))

    def run(self) -> int:
        """Learn until the last step, SIGINT or SIGTERM.

        Returns:
            The exit status: 0, 1 if the policy was not saved, or `STOPPED` before the last step. So an engine that
            moves the process starts it again.
        """
        from brakeline.learner.checkpoint import CHECKPOINT, exists
        from brakeline.learner.learner_process import LearnerSettings, learn

        resume = self.resume or (self.resume_if_any and exists(self.out / CHECKPOINT))
        config = replace(self.learner, seed=self.seed, steps=self.steps)
        settings = LearnerSettings(self.endpoints.bus(), address(self.robot), self.out, resume, self.name, config)
        done, unsaved = learn(settings)
        if unsaved:
            errors.print(
                f"THE POLICY WAS NOT SAVED: {unsaved}. Free some space, and repeat the command with --resume-if-any",
                markup=False,
            )
        return int(bool(unsaved)) if done else STOPPED
