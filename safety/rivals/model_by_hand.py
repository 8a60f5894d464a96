"""What the rivals with equations that somebody derived by hand share: the robots and the requests that they take.

Their models need no recorded data: `Pretrained` holds their settings, and no networks. They decide among standing
obstacles of a map, as the filter does.
"""

from __future__ import annotations

import numpy as np

from brakeline.errors import BadModel, BadRequest
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.request import Request, check_for_filter
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.rival import Rival

OUTSIDE = 1e-9  # m; nearer to an obstacle, no direction leads away from it


def is_unicycle(robot: Robot) -> bool:
    """Return whether the inputs of a robot are speed and turn rate, in lockstep."""
    planar = robot.position_dim == 2 and robot.heading is not None and robot.translates == (True, False)
    return planar and not robot.feedback and not robot.late


def follows_velocities(robot: Robot) -> bool:
    """Return whether a robot's state is position, velocity and more, and its inputs are velocities, in lockstep."""
    d = robot.position_dim
    moves = robot.heading is None and robot.translates == (True,) * d and robot.state_dim >= 2 * d
    return d > 1 and moves and not robot.feedback and not robot.late


def check_standing_map(method: str, request: Request) -> None:
    """Raise BadRequest if a request has a scan or moving obstacles: a method that ignores them takes them as free."""
    if request.scan is not None or (request.movers is not None and len(request.movers)):
        raise BadRequest("obstacles", f"{method} decides among standing obstacles of a map alone")


class RivalByHand(Rival):
    """A method with equations of motion by hand, and the method's settings."""

    def __init__(self, model: Pretrained, method: str, settings: tuple[str, ...], fits: bool, inputs: str) -> None:
        """Take over the settings.

        Args:
            model: with the settings.
            method, settings: the method's name, and the names of its settings.
            fits: whether the equations are of robots like this one.
            inputs: of these robots.

        Raises:
            BadModel: the model is of another method, or does not fit the robot.
        """
        robot = model.robot
        missing = [name for name in settings if name not in model.settings]
        if model.method != method or missing:
            raise BadModel(f"no model of {method}: {model.method}, without {', '.join(missing) or 'its settings'}")
        if not fits:
            raise BadModel(f"{method} knows robots with the inputs {inputs}, in lockstep: not {robot.name}")
        super().__init__(model)
        self.settings = {name: model.settings[name] for name in settings}

    def check(self, request: Request) -> None:
        """Check a request.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size, or the request has a scan or moving
                obstacles. It has the field's name.
        """
        check_for_filter(self.robot, request)
        check_standing_map(self.model.method, request)
        for name in ("center", "axes", "half", "rho", "round", "margin"):
            if not np.isfinite(getattr(request.obstacles, name)).all():
                raise BadRequest("obstacles", f"obstacles: {name} holds NaN or infinity")

    def distances(self, request: Request, points: Array) -> tuple[Array, Array]:
        """Return the distances (n, P) of points (P, d) to the obstacles [m], and the directions (n, P, d) away.

        The obstacles' margins and the robot's footprint are subtracted. A direction is zero inside an obstacle.
        """
        away = -request.obstacles.towards(points)
        lengths = np.linalg.norm(away, axis=-1)
        radius = request.obstacles.margin[:, None] + self.robot.footprint
        return lengths - radius, np.where(
            lengths[..., None] > OUTSIDE, away / np.maximum(lengths, OUTSIDE)[..., None], 0.0
        )
