"""Check the arrays of obstacles and moving obstacles: a wrong one could make an obstacle smaller, or leave it out."""

from __future__ import annotations

import numpy as np

from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Robot

FLOAT, BOOL = np.dtype(float), np.dtype(bool)
IMPOSSIBLE = (
    "an obstacle has a negative size, axes that are not orthonormal, a rounding that is not 0 or 1, or a number that "
    "is infinite or too large"
)


def check_shapes(robot: Robot, shapes: Shapes) -> None:
    """Check obstacles. Compiled code would read past the end of an array that is too short.

    Raises:
        BadRequest: an array has another shape or type, or a number is impossible.
    """
    n, d = len(shapes), robot.position_dim
    if shapes.center.shape[1:] != (d,):
        raise BadRequest("obstacles", f"a {robot.name} robot's obstacles have {d} coordinates")
    for name, size in Shapes.sizes(n, d).items():
        part = getattr(shapes, name)
        if part.shape != size or part.dtype is not FLOAT or not part.flags.writeable:
            found = f"shape {part.shape} and type {part.dtype}{'' if part.flags.writeable else ', read-only'}"
            why = f"obstacles.{name} has {found}; {n} obstacles need {size} and float64, writable: use Shapes.of"
            raise BadRequest("obstacles", why)
    if n and not _plausible(shapes):
        raise BadRequest("obstacles", IMPOSSIBLE)


def check_movers(robot: Robot, movers: MovingObstacles) -> None:
    """Check moving obstacles. Each shape needs a motion: without one, or with a negative age, it would be nowhere.

    Raises:
        BadRequest: an array has another shape or type, or a number is impossible.
    """
    n, d = len(movers.shapes), robot.position_dim
    if movers.drift.shape[1:] != (d,):
        raise BadRequest("obstacles", f"a {robot.name} robot's movers have {d} coordinates")
    sizes = {"drift": (n, d), "growth": (n, 3), "age": (n,), "consistent": (n,)}
    for name, size in sizes.items():
        part, kind = getattr(movers, name), BOOL if name == "consistent" else FLOAT
        if part.shape != size or part.dtype is not kind:
            found = f"shape {part.shape} and type {part.dtype}"
            why = f"movers.{name} has {found}; {n} moving obstacles need {size} and {kind}: use MovingObstacles.of"
            raise BadRequest("obstacles", why)
    good = np.isfinite(movers.drift).all() and np.isfinite(movers.growth).all() and np.isfinite(movers.age).all()
    if not good or (movers.growth < 0.0).any() or (movers.age < 0.0).any():
        raise BadRequest("obstacles", "a moving obstacle's drift is finite; its growth and age, too, and not negative")
    check_shapes(robot, movers.shapes)


def _plausible(shapes: Shapes) -> bool:
    from brakeline.safety.filter.kernels import shape_kernels  # here, since clients need no compiled code

    return shape_kernels.plausible(*shapes.parts, np.ascontiguousarray(shapes.margin))
