"""`brakeline evaluate`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from brakeline.deploy.commands.common_options import (
    Flags,
    Physics,
    Robot,
    Serving,
    conditions,
    console,
    errors,
    say_json,
)
from brakeline.deploy.experiments.evaluate import Evaluation, evaluate, prepared
from brakeline.deploy.progress import under_way
from brakeline.logs.metrics import EpisodeStats
from brakeline.logs.report import show
from brakeline.messaging.task import RobotWithTask, robot_with_task


@dataclass(frozen=True)
class Evaluate:
    robot: Robot = "ground"
    policy: str = "astar"
    """A policy file, inputs (.csv, as `excite` prints them), or trained | trained-by-scan (those in policies/) |
    untrained | random | greedy | adversary | astar | careful (astar with a wide berth)."""
    filtering: Flags[Serving] = field(default_factory=Serving)
    physics: Flags[Physics] = field(default_factory=Physics)
    arena: str = "default"
    """On the ground default | open | dense | few-walkers | walkers | many-walkers | crossing, in the air default |
    dense | tall | traffic; else those of the robot's task."""
    episodes: int = 100
    """Of a fleet: of all its robots, in whole worlds."""
    fleet: int = 0
    """So many robots in one world; 0: each is alone."""
    seed: int = 0
    render: Path | None = None
    """Also draw an episode from above, with tube and plan, into this file (.png, .gif, .mp4)."""
    episode: int = 0
    """Which one to draw."""
    beside: bool = False
    """Draw the same episode without the filter beside it."""
    verbose: bool = False
    """Say also the conditions: sensors' errors, wind, load."""
    json: bool = False

    def run(self) -> int:
        if self.render is not None:
            from brakeline.deploy.run.episode_render import check_ending

            check_ending(self.render)
        if self.beside and self.render is None:
            raise ValueError("--beside draws: give --render FILE too")
        robot = robot_with_task(self.robot)
        what = Evaluation(
            policy=self.policy,
            method=self.filtering.method,
            model_config=self.filtering.model_config(),
            accept_bound=self.filtering.accept_bound,
            arena=self.arena,
            episodes=self.episodes,
            seed=self.seed,
            conditions=self.physics.conditions(),
            fleet=self.fleet,
        )
        if self.render is not None and self.fleet:
            raise ValueError("a fleet is not drawn: leave out --render")
        if self.render is not None:
            self._draw(robot, what, self.render)
        with under_way("driving episodes", self.episodes) as advance:

            def each(tally: EpisodeStats) -> None:
                told = f"goals {tally.goals}, collisions {tally.collisions}, interventions {tally.interventions}"
                advance(what=told)

            figures = evaluate(robot, what, each)
        if self.json:
            say_json(figures)
        else:
            console.print(show(figures))
            if self.verbose:
                console.print(conditions(figures["conditions"]))
        return 0

    def _draw(self, robot: RobotWithTask, what: Evaluation, path: Path) -> None:
        from brakeline.deploy.run.episode_render import record, save

        films = []
        for method in (what.method, "none") if self.beside else (what.method,):
            driver, policy, question = prepared(robot, replace(what, method=method))
            film = record(driver, policy, question, self.episode)
            films.append(film)
            how = f"method {method}, {film.end} after {len(film.frames) * robot.period:.1f} s"
            errors.print(f"{path}: episode {self.episode}, {how}")
        save(films, path)
