"""`brakeline evaluate` and `brakeline analyse`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from deploy.commands.common import Filtering, Flags, Physics, Robot, console, errors, say_json
from deploy.evaluate import Evaluation, evaluate
from logs.figures import draw
from logs.metrics import Tally
from logs.report import analyse, show
from messaging.robots import robot_named


@dataclass(frozen=True)
class Evaluate:
    robot: Robot = "ground"
    policy: str = "astar"
    """A policy file, or untrained | random | greedy | adversary | astar."""
    filtering: Flags[Filtering] = field(default_factory=Filtering)
    physics: Flags[Physics] = field(default_factory=Physics)
    arena: str = "default"
    """default | open | dense."""
    episodes: int = 100
    seed: int = 0
    json: bool = False

    def run(self) -> int:
        robot = robot_named(self.robot)
        what = Evaluation(
            policy=self.policy,
            method=self.filtering.method,
            recipe=self.filtering.recipe(),
            arena=self.arena,
            episodes=self.episodes,
            seed=self.seed,
            conditions=self.physics.conditions(),
        )
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
            task = progress.add_task("episodes", total=self.episodes)

            def each(tally: Tally) -> None:
                told = f"goals {tally.goals}, collisions {tally.collisions}, interventions {tally.interventions}"
                progress.update(task, advance=1, description=told)

            figures = evaluate(robot, what, each)
        if self.json:
            say_json(figures)
        else:
            console.print(show(figures))
            console.print("[dim]conditions: " + ", ".join(f"{k} {v}" for k, v in figures["conditions"].items()) + "[/]")
        return 0


@dataclass(frozen=True)
class Analyse:
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (Path("runs/latest"),)
    """Log files, or run folders."""
    png: Path | None = None
    """Draw the learning curves into this file."""
    json: bool = False

    def run(self) -> int:
        figures: dict[str, Any] = analyse(list(self.logs))
        if self.png is not None:
            draw(list(self.logs), self.png)
            errors.print(f"learning curves: {self.png}")
        if self.json:
            say_json(figures)
        else:
            console.print(show(figures))
        return 0
