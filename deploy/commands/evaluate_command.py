"""Implement `brakeline evaluate`: evaluate a policy behind the filter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import conditions_table, errors, print_result
from brakeline.deploy.experiments.task_engine import IN_THIS_PROCESS, Engine
from brakeline.deploy.progress import under_way

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Evaluation
    from brakeline.messaging.task import RobotWithTask


@dataclass(frozen=True)
class EvaluateCommand:
    """The options of `brakeline evaluate`."""

    robot: options.Robot = "ground"
    policy: str = "astar"
    """Evaluate this policy: trained, trained-by-scan (both stored in policies/), untrained, random, greedy, adversary,
    astar, careful (astar far from obstacles), the folder of a run, a weights file, FILE.py:NAME (a class or a
    function of your own), or a CSV file of inputs as `brakeline excite` prints them."""
    filtering: options.Unprefixed[options.EvaluatedFilter] = field(default_factory=options.EvaluatedFilter)
    physics: options.Unprefixed[options.SimulationOptions] = field(default_factory=options.SimulationOptions)
    arena: options.ArenaName = "default"
    episodes: int = 100
    """Drive this many episodes. A fleet counts those of all its robots, and completes each world."""
    fleet: int = 0
    """Let this many robots share one world and avoid each other. 0 evaluates one robot alone."""
    backend: Literal["single", "batch"] = "single"
    """Simulate one robot after the other, or many robots at once (batch: several times faster, for networks)."""
    seed: options.Seed = 0
    render: Path | None = None
    """Also draw an episode from above, with tube and plan, into this file (.png, .gif or .mp4)."""
    episode: int | None = None
    """With --render, draw the episode of this number. Defaults to 0."""
    beside: bool = False
    """With --render, draw the same episode without the filter beside it."""
    engine: options.Unprefixed[Engine] = field(default_factory=Engine)
    verbose: options.Verbose = False
    quiet: options.Quiet = False
    json: options.Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "logs")
    least: ClassVar[dict[str, float]] = {"episode": 0}

    def run(self) -> int:
        """Drive the episodes and print the figures. Returns the exit status."""
        from brakeline.deploy.experiments.evaluate import Evaluation
        from brakeline.logs.figure_tables import show
        from brakeline.messaging.task import robot_with_task

        if self.beside and self.render is None:
            raise ValueError("--beside draws an episode: give --render FILE too")
        if self.episode is not None and self.render is None:
            raise ValueError("--episode chooses the episode to draw: give --render FILE too. --seed changes the others")
        if self.render is not None:
            from brakeline.deploy.run.episode_render import check_ending

            check_ending(self.render)
            if self.fleet:
                raise ValueError("--render can't draw a fleet: leave out --render or --fleet")
        robot = robot_with_task(self.robot)
        evaluation = options.settings_from(
            Evaluation,
            self,
            **self.filtering.settings(),
            conditions=self.physics.conditions(),
        )
        if self.render is not None:
            self._draw(robot, evaluation, self.render)
        figures = self._figures(robot, evaluation)
        print_result(
            self.json, figures, show(figures), *([conditions_table(figures["conditions"])] if self.verbose else [])
        )
        return 0

    def _figures(self, robot: RobotWithTask, evaluation: Evaluation) -> dict[str, Any]:
        from brakeline.deploy.experiments.evaluate import evaluate, evaluate_with, progress_line

        with under_way("driving episodes", self.episodes) as advance:
            if self.engine == IN_THIS_PROCESS:
                return evaluate(robot, evaluation, lambda stats: advance(what=progress_line(stats)))
            return evaluate_with(self.engine, robot, evaluation, lambda name, text: advance(0, f"{name}: {text}"))

    def _draw(self, robot: RobotWithTask, evaluation: Evaluation, path: Path) -> None:
        from brakeline.deploy.experiments.evaluate import prepare_evaluation
        from brakeline.deploy.run.episode_render import record, save

        films, number = [], self.episode or 0
        for method in (evaluation.method, "none") if self.beside else (evaluation.method,):
            driver, policy, ask = prepare_evaluation(robot, replace(evaluation, method=method))
            film = record(driver, policy, ask, number)
            films.append(film)
            outcome = f"{film.end} after {len(film.frames) * robot.period:.1f} s"
            errors.print(f"{path}: episode {number}, method {method}, {outcome}")
        save(films, path)
