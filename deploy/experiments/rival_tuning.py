"""Tune the threshold of each rival in closed loop; the results are the `rivals` of the task files.

The rule is the same for both rivals. Among the values with which A* loses no goal, choose the one with the fewest
collisions of the greedy policy, which drives straight to the goal. Break ties by the goals of the greedy policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.experiments.trials import run_trial
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
    """A threshold (SECAS: margin to the footprint in m; SAILR: η) and its results over `episodes` per policy."""

    value: float
    episodes: int
    oracle_goals: int
    oracle_interventions: float  # share of its steps
    greedy_goals: int
    greedy_collisions: int

    def figures(self) -> dict[str, float]:
        """Return the figures by name."""
        return asdict(self)


def values_for(model: Pretrained, robot: RobotWithTask) -> tuple[float, ...]:
    """Return the thresholds to try."""
    return robot.task.rivals.margins if model.method == SECAS else ADVANTAGES


def try_threshold(
    model: Pretrained, robot: RobotWithTask, value: float, episodes: int, arena: str = "default"
) -> ThresholdTrial:
    """Evaluate the model with another threshold on fresh episodes."""
    setting = robot.footprint + value if model.method == SECAS else value
    question = in_process(replace(model, settings=dict(model.settings) | {SETTING[model.method]: setting}))
    tables = {}
    for name in (ORACLE, GREEDY):
        driver = EpisodeRunner(robot, environment(robot, arena, FRESH), ActorIdentity("tune", 0, 0))
        tables[name] = run_trial(driver, policy_named(name, robot, 0), question, episodes)
    oracle, greedy = tables[ORACLE].columns(), tables[GREEDY].columns()
    return ThresholdTrial(
        value,
        episodes,
        int(sum(oracle["goal"])),
        sum(oracle["interventions"]) / max(tables[ORACLE].decisions, 1),
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
    """Evaluate every value, and call `say` after each one."""
    rows = []
    for value in values:
        rows.append(try_threshold(model, robot, value, episodes))
        say(rows[-1])
    return rows


def best_threshold(rows: Sequence[ThresholdTrial]) -> ThresholdTrial:
    """Return the best row by the rule of this module."""
    most = max(row.oracle_goals for row in rows)
    without_loss = [row for row in rows if row.oracle_goals == most]
    return min(without_loss, key=lambda row: (row.greedy_collisions, -row.greedy_goals))
