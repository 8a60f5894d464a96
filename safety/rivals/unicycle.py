"""What the rivals with a unicycle that somebody derived by hand share: the robots and the requests that they take.

Their models need no recorded data: `Pretrained` holds their settings, and no networks. They decide among standing
obstacles of a map, as the filter does.
"""

from __future__ import annotations

import numpy as np

from brakeline.errors import BadModel, BadRequest
from brakeline.messaging.robot import Array
from brakeline.safety.filter.request import Request, check_for_filter
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.rival import Rival

OUTSIDE = 1e-9  # m; nearer to an obstacle, no direction leads away from it


class UnicycleRival(Rival):
    """A method with a unicycle by hand: a robot with the inputs [speed; turn rate], and the method's settings."""

    def __init__(self, model: Pretrained, method: str, settings: tuple[str, ...]) -> None:
        """Take over the settings. Raises BadModel if the model is of another method or does not fit the robot."""
        robot = model.robot
        missing = [name for name in settings if name not in model.settings]
        if model.method != method or missing:
            raise BadModel(f"no model of {method}: {model.method}, without {', '.join(missing) or 'its settings'}")
        planar = robot.position_dim == 2 and robot.heading is not None and robot.translates == (True, False)
        if not planar or robot.feedback or robot.late:
            raise BadModel(f"{method} knows robots with the inputs speed and turn rate, in lockstep: not {robot.name}")
        super().__init__(model)
        self.settings = {name: model.settings[name] for name in settings}

    def check(self, request: Request) -> None:
        """Check a request.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size, or the request has a scan or moving
                obstacles. It has the field's name.
        """
        check_for_filter(self.robot, request)
        if request.scan is not None or (request.movers is not None and len(request.movers)):
            raise BadRequest("obstacles", f"{self.model.method} decides among standing obstacles of a map alone")
        for name in ("center", "axes", "half", "rho", "round", "margin"):
            if not np.isfinite(getattr(request.obstacles, name)).all():
                raise BadRequest("obstacles", f"obstacles: {name} holds NaN or infinity")

    def distances(self, request: Request, points: Array) -> tuple[Array, Array]:
        """Return the distances (n, P) of points (P, 2) to the obstacles [m], and the directions (n, P, 2) away.

        The obstacles' margins and the robot's footprint are subtracted. A direction is zero inside an obstacle.
        """
        away = -request.obstacles.towards(points)
        lengths = np.linalg.norm(away, axis=-1)
        taken = request.obstacles.margin[:, None] + self.robot.footprint
        return lengths - taken, np.where(
            lengths[..., None] > OUTSIDE, away / np.maximum(lengths, OUTSIDE)[..., None], 0.0
        )
