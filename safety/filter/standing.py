"""Decide from a request and the model set whether a robot stands."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.filter.constraints import TubeConstraints
from brakeline.safety.filter.local_map import LocalMap
from brakeline.safety.filter.request import Request


def stands(request: Request, local_map: LocalMap, constraints: TubeConstraints, z: Array) -> bool:
    """Return whether the robot stands and its plan is to go on standing. Such a plan needs no verification.

    The first request of a program contains no prediction, and the robot may be driving already. Then the robot counts
    as standing only if the sets of its plan contain its present position in every period, up to the measurement error.

    Args:
        z: regressors of the plan.
    """
    robot = constraints.robot
    if not request.still(robot) or request.predicted is not None or not robot.position_dim:
        return request.still(robot)
    centers, half = constraints.sets(local_map.start, local_map.turn, z)
    return bool((np.abs(centers - local_map.start) <= half + constraints.measurement_error).all())
