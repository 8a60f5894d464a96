"""Search for the episodes in which the filter keeps the least distance: CMA-ES over obstacles and proposed inputs.

A candidate moves the obstacles next to the start, and lists the inputs that the policy proposes one after the other.
Its score is the least true distance between the robot and any obstacle. So the search uses the true state of the
simulator, which no policy gets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.experiments.campaign_episodes import CampaignDriver, Row
from brakeline.deploy.experiments.evaluate import FRESH, Evaluation
from brakeline.deploy.experiments.trials import TrialLog
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import NoArena
from brakeline.messaging.obstacle import WALL, Obstacle
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.scripted_policies import Policy

MOVED = 6  # obstacles that a candidate moves
PIECES = 10  # constant inputs that the policy proposes one after the other
PERIODS = 60  # of an episode
EPISODES_OF_AN_ARENA = 300  # candidates in one drawn arena, before the next one is drawn
MOST_ARENAS = 10  # the search gives up after so many arenas without an episode that counts
SPREAD = 0.5  # initial standard deviation of a candidate's numbers, each of which is within -1 and 1
MOST_SHIFT = 4.0  # largest shift of an obstacle, in radii of the robot's footprint
CONTACT_BONUS = 1.0  # m, subtracted from the score of a candidate with a contact, so that it is below all others
NOT_COUNTED = 10.0  # m, score of an episode that does not count, so that it is above all others


@dataclass(frozen=True)
class SearchedEpisode:
    """An episode of the search: a drawn arena, changed by numbers within -1 and 1.

    Attributes:
        number: of the drawn arena.
        values: shifts of the obstacles next to the start, then the pieces of the inputs.
    """

    number: int
    values: Array

    def arena(self, drawn: Arena, robot: Robot) -> Arena:
        """Return the drawn arena with its moved obstacles and a shorter time limit."""
        dim = drawn.dim
        shifts = MOST_SHIFT * robot.footprint * self.values[: MOVED * dim].reshape(MOVED, dim)
        inside = [o for o in drawn.obstacles if o.kind != WALL and len(o.position) == dim and _movable(o, drawn)]
        inside.sort(key=lambda o: float(np.linalg.norm(np.subtract(o.position, drawn.start[:dim]))))
        moved = {
            id(o): replace(o, position=tuple((np.asarray(o.position) + shift).tolist()))
            for o, shift in zip(inside, shifts, strict=False)
        }
        obstacles = tuple(moved.get(id(o), o) for o in drawn.obstacles)
        return replace(drawn, obstacles=obstacles, step_limit=PERIODS)

    def policy(self, robot: Robot) -> Policy:
        """Return the policy that proposes the inputs one after the other, each for the same time."""
        pieces = self.values[-PIECES * robot.action_dim :].reshape(PIECES, robot.action_dim)
        low, high = robot.low(), robot.high()
        inputs = low + 0.5 * (pieces + 1.0) * (high - low)

        def propose(observation: Any, info: dict[str, Any]) -> Array:
            period = round(info["time"] / robot.period)
            return np.asarray(inputs[min(period * PIECES // PERIODS, PIECES - 1)])

        return propose


def search(
    robot: RobotWithTask, evaluation: Evaluation, episodes: int, path: Path, say: Callable[[str], object]
) -> dict[str, Any]:
    """Drive as many episodes as given, and write the log of the worst one.

    Args:
        evaluation: gives arena, method, model set, conditions and seed.
        path: of the log.
        say: called with the progress, after each generation of candidates.

    Returns:
        `episodes`, `collisions`, `steps`, `closest` [m], `number` and `values` of the worst candidate, and `history`
        (the distance of the worst candidate so far, after each episode).

    Raises:
        NoArena: in no drawn arena does a candidate begin with room around the robot.
    """
    import cma

    progress = _Search(robot, evaluation)
    size = MOVED * robot.position_dim + PIECES * robot.action_dim
    number = 0
    while progress.episodes < episodes:
        options = {
            "bounds": [-1.0, 1.0],
            "seed": evaluation.seed + number + 1,
            "verbose": -9,  # prints nothing
            "maxfevals": EPISODES_OF_AN_ARENA,
        }
        strategy = cma.CMAEvolutionStrategy(np.zeros(size), SPREAD, options)
        while not strategy.stop() and progress.episodes < episodes:
            candidates = [SearchedEpisode(number, np.asarray(values)) for values in strategy.ask()]
            strategy.tell([one.values for one in candidates], list(map(progress.score, candidates)))
            say(f"{progress.episodes} of {episodes} episodes, closest {1e3 * progress.closest:.1f} mm")
        number += 1
        if not progress.episodes and number == MOST_ARENAS:
            raise NoArena(
                f"every candidate in {number} arenas {evaluation.arena!r} began too near to something: choose another "
                "arena, or increase its start_clearance"
            )
    progress.write_worst(path)
    return progress.figures()


class _Search:
    """Drives candidates, and remembers the worst one."""

    def __init__(self, robot: RobotWithTask, evaluation: Evaluation) -> None:
        self.episodes = 0
        self.closest = math.inf  # m, of the worst candidate
        self._robot, self._evaluation = robot, evaluation
        self._collisions = self._steps = 0
        self._least = math.inf  # the worst candidate's score
        self._worst: SearchedEpisode | None = None
        self._history: list[float] = []
        self._arena: Arena | None = None  # of the candidate that is driven
        env = environment(robot, evaluation.arena, FRESH + evaluation.seed, evaluation.conditions, draw=self._draw)
        self._driver = replace(CampaignDriver.of(robot, evaluation), env=env)

    def _draw(self, name: str, generator: np.random.Generator, robot: RobotWithTask) -> Arena:
        assert self._arena is not None
        return self._arena

    def _drive(self, candidate: SearchedEpisode, log: TrialLog | None = None) -> tuple[Row, Arena]:
        generator = np.random.default_rng((self._evaluation.seed, candidate.number))
        self._arena = arena = candidate.arena(draw_arena(self._evaluation.arena, generator, self._robot), self._robot)
        return self._driver.row(candidate.number, log, candidate.policy(self._robot)), arena

    def score(self, candidate: SearchedEpisode) -> float:
        """Drive a candidate and return its score, which CMA-ES minimizes."""
        row, arena = self._drive(candidate)
        free = float(arena.shapes.distance(np.asarray(arena.start[: arena.dim])).min()) - self._robot.footprint
        if free < self._robot.footprint:  # it began too near to something: no fault of the filter
            return NOT_COUNTED - free
        self.episodes, self._steps = self.episodes + 1, self._steps + int(row["steps"])
        touched = bool(row["collision"] or row["contact_moving"])
        self._collisions += touched
        value = float(row["closest"]) - CONTACT_BONUS * touched
        if value < self._least:
            self._least, self.closest, self._worst = value, float(row["closest"]), candidate
        self._history.append(round(self.closest, 5))
        return value

    def write_worst(self, path: Path) -> None:
        """Drive the worst candidate again, and write its log."""
        if self._worst is not None:
            with self._driver.log(path, episode=str(self._worst.number), policy="worst-case search") as log:
                self._drive(self._worst, log)

    def figures(self) -> dict[str, Any]:
        """Return what `search` returns."""
        worst = self._worst
        return {
            "episodes": self.episodes,
            "collisions": self._collisions,
            "steps": self._steps,
            "closest": self.closest,
            "number": None if worst is None else worst.number,
            "values": [] if worst is None else worst.values.round(6).tolist(),
            "history": self._history,
        }


def _movable(obstacle: Obstacle, arena: Arena) -> bool:
    """Return whether an obstacle is smaller than the arena, as all obstacles but its floor and ceiling are."""
    low, high = arena.bounds[0]
    return not obstacle.size or max(obstacle.size) < high - low
