"""Decide from a request and the model set whether a robot stands, or drives already."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.constraints import TubeConstraints
from brakeline.safety.filter.local_map import LocalMap
from brakeline.safety.filter.request import Request
from brakeline.safety.model.model_set import extra_coordinates

DRIVES_ALREADY = (
    "the robot drives already, but the request names the input of a robot that stands, and has no predicted set (as a "
    "first request, or one after a period without a decision): the true input is not known"
)


def stands(request: Request, local_map: LocalMap, constraints: TubeConstraints, z: Array, start: float) -> bool:
    """Return whether the robot stands and its plan is to go on standing. Such a plan needs no verification.

    The first request of a program contains no prediction, and the robot may be driving already. Then the robot counts
    as standing only if the sets of its plan contain its present position in every period, up to the measurement error.
    In joint space, this is about the coordinates that have a limit. A later request contains the predicted set of the
    state. If it was widened, a robot outside the set without widening does not stand: something pushes it.

    Args:
        z: regressors of the plan.
        start: factor on the sets at the start of an episode (`Filter.start`). The sets count with this factor alone: a
            robot does not stand because its sets were widened.
    """
    robot = constraints.robot
    if not request.still(robot):
        return False
    if (predicted := request.predicted) is not None:
        factors = local_map.state_factors(constraints.decide) / (start if request.past is None else 1.0)
        stated = replace(predicted, half_width=predicted.half_width / factors)
        return bool((factors <= 1.0).all()) or stated.contains(robot, request.state)
    constraints = constraints.at(z, start)
    if robot.position_dim:
        centers, half = constraints.sets(local_map.start, local_map.turn, z)
        return bool((np.abs(centers - local_map.start) <= half + constraints.measurement_error).all())
    limited, tube = list(extra_coordinates(robot)), constraints.tube
    half = start * tube.more_half_widths(z) + np.asarray(robot.measurement_bound)[limited]
    return bool((np.abs(tube.more_offset - request.state[limited]) <= half).all())


def may_drive_already(request: Request, robot: Robot) -> bool:
    """Return whether this may be the first request of a program, about a robot that drives already.

    Such a request names the input in force of a standing robot, and nobody knows the true one. A request after a period
    without a decision looks the same: something moves the robot, although its plan is to stand. A robot whose measured
    speeds are no more than their errors counts as standing. Whether another one drives, `stands` says.
    """
    if request.predicted is not None or not request.names_standing(robot):
        return False
    speeds = list(robot.regressor)
    return bool((np.abs(request.state[speeds]) > np.asarray(robot.measurement_bound)[speeds]).any())
