"""Counts of a run from its beginning: the launcher tells them with its signs of life, for those who come late.

A count of a robot kind is called `ROBOT NAME` in a Health's figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from brakeline.logs.metrics import Metrics

COUNTS = ("steps", "episodes", "goals", "collisions", "interventions", "failsafes", "reward")  # reward: summed

Totals = dict[str, dict[str, float]]  # by robot kind and name


def run_totals(metrics: Metrics) -> Totals:
    """What metrics have counted so far. They may be added to meanwhile."""
    found: Totals = {}
    for tally in metrics.actors.copy().values():
        if tally.robot:
            counts = found.setdefault(tally.robot, dict.fromkeys(COUNTS, 0.0))
            returns = tally.returns[:]
            counts["episodes"] += len(returns)
            counts["reward"] += math.fsum(returns)
            for name in ("steps", "goals", "collisions", "interventions", "failsafes"):
                counts[name] += getattr(tally, name)
    return found


def totals_to_health(found: Totals) -> dict[str, float]:
    """As a Health's figures."""
    return {f"{robot} {name}": value for robot, counts in found.items() for name, value in counts.items()}


def totals_from_health(figures: Mapping[str, float]) -> Totals:
    """What `totals_to_health` said, among other figures; a kind of which a count is missing or odd is left out."""
    found: Totals = {}
    for key, value in figures.items():
        robot, _, name = key.partition(" ")
        if name in COUNTS and math.isfinite(value) and (value >= 0.0 or name == "reward"):
            found.setdefault(robot, {})[name] = value
    return {robot: counts for robot, counts in found.items() if len(counts) == len(COUNTS)}
