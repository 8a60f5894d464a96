"""How far tubes reach: the reach of local maps, and whether a standing robot drifts."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.reachable_tube import RolloutTube, Tube
from brakeline.safety.model.model_set import ModelSet

ROOM_FOR_STRETCH = 1.2  # of the reach of a rollout, whose sets grow with the leverage of a plan
EXTREMES = 4096  # plans with extreme regressors, for the reach of a rollout


def stays(model: ModelSet, tube: Tube) -> bool:
    """Return whether a standing robot stays in place.

    A robot that hovers by an estimate may drift: its tube of standing then grows over a plan by more than the
    measurement error, and by more than a tenth of the body's radius.
    """
    robot, nothing = model.robot, model.robot.zero_input()
    z = np.concatenate([model.measured_at(nothing), np.tile(nothing, 1 + robot.free_steps)])
    half = np.abs(tube.directions) @ tube.magnitudes(z)[: tube.generators]
    size = np.linalg.norm(half, axis=1)
    measured = np.linalg.norm(robot.measurement_bound[: robot.position_dim])
    return bool(size[-1] - size[0] <= max(measured, 0.1 * robot.footprint))


def widest_extent(robot: Robot, tube: Tube, outer: Tube, domain: Array, body: float) -> float:
    """Return a distance [m] from the measured position that no tube, with a body of radius `body` [m], exceeds.

    It comes from interval arithmetic over the range of all regressors, so it is loose for error bounds with many
    rows W. For a rollout it is an estimate from extreme regressors; the filter checks the extent of each plan.

    Args:
        robot: the robot. tube: the exact tube. outer: an outer tube with fewer rows in W.
        domain (2, r): range of the recorded [x_0; input in force].
        body: radius of the body with the measurement error.
    """
    F = robot.free_steps
    low = np.concatenate([domain[0], np.tile(robot.low(), F)])
    high = np.concatenate([domain[1], np.tile(robot.high(), F)])
    z = np.maximum(np.abs(low), np.abs(high))
    sizes = outer.M @ (np.abs(outer.W) @ z) + outer.m_0
    way = np.abs(outer.position) @ z + np.abs(outer.directions) @ sizes[: outer.generators]
    if isinstance(tube, RolloutTube):
        extremes = np.random.default_rng(0).integers(0, 2, (EXTREMES, len(low)))
        with np.errstate(over="ignore", invalid="ignore"):  # far from the data a rollout may diverge
            way += np.nan_to_num(np.abs(tube.outputs(np.where(extremes, high, low))[0]), nan=np.inf).max(0)
        way = np.minimum(ROOM_FOR_STRETCH * way, robot.sight)
    return float(np.linalg.norm(way, axis=1).max() + body + sizes[outer.generators :].max())
