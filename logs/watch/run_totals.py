"""Encode the counts of a run in the launcher's Health messages, for viewers that start later than the run.

The figure of a Health message with the count NAME of a robot kind has the key `ROBOT NAME`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from brakeline.logs.metrics import Metrics

COUNTS = ("steps", "episodes", "goals", "collisions", "interventions", "failsafes", "reward")  # reward: the sum

Totals = dict[str, dict[str, float]]  # by robot kind and name of the count


def run_totals(metrics: Metrics) -> Totals:
    """Return the counts of the metrics, which another thread may extend meanwhile."""
    totals: Totals = {}
    for stats in metrics.actors.copy().values():
        if stats.robot:
            counts = totals.setdefault(stats.robot, dict.fromkeys(COUNTS, 0.0))
            returns = stats.returns[:]
            counts["episodes"] += len(returns)
            counts["reward"] += math.fsum(returns)
            for name in ("steps", "goals", "collisions", "interventions", "failsafes"):
                counts[name] += getattr(stats, name)
    return totals


def totals_to_health(totals: Totals) -> dict[str, float]:
    """Encode counts as figures of a Health message."""
    return {f"{robot} {name}": value for robot, counts in totals.items() for name, value in counts.items()}


def totals_from_health(figures: Mapping[str, float]) -> Totals:
    """Decode counts from a Health message, without robot kinds whose counts are incomplete or invalid."""
    totals: Totals = {}
    for key, value in figures.items():
        robot, _, name = key.partition(" ")
        if name in COUNTS and math.isfinite(value) and (value >= 0.0 or name == "reward"):
            totals.setdefault(robot, {})[name] = value
    return {robot: counts for robot, counts in totals.items() if len(counts) == len(COUNTS)}
