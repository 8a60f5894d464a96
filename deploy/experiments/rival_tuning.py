"""Tune one setting of each rival in closed loop; the results are the `rivals` of the task files.

The rule is the same for all rivals. Among the values with which A* loses no goal, choose the one with the fewest
collisions of the greedy policy, which drives straight to the goal. Break ties by the goals of the greedy policy, then
by the interventions on A*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.experiments.trials import fresh_trial
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.model_config import CBF, PSF, SAILR, SECAS
from brakeline.safety.rivals.pretrained import Pretrained

ORACLE, GREEDY = "astar", "greedy"
VALUES = {
    SAILR: (0.03, 0.05, 0.08, 0.15),  # η; its authors' is 0.08
    CBF: (0.5, 1.0, 2.0, 4.0),  # α [1/s]
    PSF: (0.0, 0.01, 0.02, 0.04),  # margin [m]
}
SETTING = {SECAS: "clearance", SAILR: "threshold", CBF: "rate", PSF: "margin"}


@dataclass(frozen=True)
class ThresholdTrial:
    """A value of `SETTING` (SECAS: its margin to the footprint) and its results over `episodes` per policy."""

    value: float
    episodes: int
    oracle_goals: int
    oracle_interventions: float  # share of its steps
    greedy_goals: int
    greedy_collisions: int


def values_of(method: str, robot: RobotWithTask) -> tuple[float, ...]:
    """Return the values of a method's setting to try."""
    return robot.task.rivals.margins if method == SECAS else VALUES[method]


def try_threshold(
    model: Pretrained, robot: RobotWithTask, value: float, episodes: int, arena: str = "default"
) -> ThresholdTrial:
    """Evaluate the model with another threshold on fresh episodes."""
    setting = robot.footprint + value if model.method == SECAS else value
    question = in_process(replace(model, settings=dict(model.settings) | {SETTING[model.method]: setting}))
    oracle, greedy = (fresh_trial(robot, arena, policy, question, episodes) for policy in (ORACLE, GREEDY))
    reached, driven = oracle.columns(), greedy.columns()
    return ThresholdTrial(
        value,
        episodes,
        oracle_goals=int(sum(reached["goal"])),
        oracle_interventions=sum(reached["interventions"]) / max(oracle.decisions, 1),
        greedy_goals=int(sum(driven["goal"])),
        greedy_collisions=int(sum(driven["collision"])),
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
    return min(without_loss, key=lambda row: (row.greedy_collisions, -row.greedy_goals, row.oracle_interventions))
