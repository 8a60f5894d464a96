"""The one threshold that each rival has, tried in closed loop: how `rivals` in the tasks' files was found.

The rule, for both alike: of the values that cost the map's oracle (A*) no goal, the one with the fewest collisions of
the greedy driver, who goes straight for the goal; of equals the one with the greedy driver's most goals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.experiments.trials import evaluate
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.sailr import SAILR
from brakeline.safety.rivals.secas import SECAS

ORACLE, GREEDY = "astar", "greedy"
ADVANTAGES = (0.03, 0.05, 0.08, 0.15)  # η; its authors' is 0.08
SETTING = {SECAS: "clearance", SAILR: "threshold"}


@dataclass(frozen=True)
class ThresholdTrial:
    """A value of the threshold (SECAS: m beside the footprint; SAILR: η), and what came of `episodes` a driver."""

    value: float
    episodes: int
    oracle_goals: int
    oracle_interventions: float  # share of its steps
    greedy_goals: int
    greedy_collisions: int

    def figures(self) -> dict[str, float]:
        return asdict(self)


def values_for(model: Pretrained, robot: RobotWithTask) -> tuple[float, ...]:
    """The four that are tried."""
    return robot.task.rivals.margins if model.method == SECAS else ADVANTAGES


def try_threshold(
    model: Pretrained, robot: RobotWithTask, value: float, episodes: int, arena: str = "default"
) -> ThresholdTrial:
    """The model with another threshold, on fresh episodes."""
    setting = robot.footprint + value if model.method == SECAS else value
    question = in_process(replace(model, settings=dict(model.settings) | {SETTING[model.method]: setting}))
    found = {}
    for name in (ORACLE, GREEDY):
        driver = EpisodeRunner(robot, environment(robot, arena, FRESH), ActorIdentity("tune", 0, 0))
        found[name] = evaluate(driver, policy_named(name, robot, 0), question, episodes)
    oracle, greedy = found[ORACLE].columns(), found[GREEDY].columns()
    return ThresholdTrial(
        value,
        episodes,
        int(sum(oracle["goal"])),
        sum(oracle["interventions"]) / max(found[ORACLE].decisions, 1),
        int(sum(greedy["goal"])),
        int(sum(greedy["collision"])),
    )


def tune_threshold(
    model: Pretrained,
    robot: RobotWithTask,
    values: Sequence[float],
    episodes: int,
    say: Callable[[ThresholdTrial], object] = lambda row: None,
) -> list[ThresholdTrial]:
    """A row for each value, told as soon as it is known."""
    rows = []
    for value in values:
        rows.append(try_threshold(model, robot, value, episodes))
        say(rows[-1])
    return rows


def best_threshold(rows: Sequence[ThresholdTrial]) -> ThresholdTrial:
    """By the rule above."""
    most = max(row.oracle_goals for row in rows)
    unharmed = [row for row in rows if row.oracle_goals == most]
    return min(unharmed, key=lambda row: (row.greedy_collisions, -row.greedy_goals))
