"""A safety filter of your own: a class in a Python file, which `evaluate` and `compare` run in their own process.

No file and no message names code to run: a model of this kind exists in memory only.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brakeline.errors import BadInput, BadModel
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Array
from brakeline.messaging.task import needs_task
from brakeline.messaging.task_code import load_code
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Decision, Request, check_for_filter
from brakeline.safety.rivals.model_by_hand import check_standing_map
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.rival import Rival


class OwnFilter(Rival):
    """Derive your filter from this class, and write `safe_input`. `self.robot` has inputs, bounds, period and body.

    Attributes:
        obstacles: how your filter gets obstacles, as the results page states it.
        standing_map: True to refuse requests with a scan or moving obstacles, which `request.obstacles` does not
            contain. Set it to False in a filter that reads `request.scan`, `request.movers` or the rays.

    >>> class Half(OwnFilter):
    ...     def safe_input(self, request, proposal):
    ...         return 0.5 * proposal
    """

    obstacles = "the arena's map"
    standing_map = True

    @property
    def rays(self) -> LidarRays:
        """The rays of the policy's lidar: `directions` (R, d) in the robot's frame, and the largest `range` [m]."""
        return needs_task(self.robot).task.rays

    def ranges(self, request: Request) -> Array:
        """Return the distances [m] that the rays measure (R,). A ray that hits nothing measures the largest range."""
        return np.asarray(request.observation[: len(self.rays.directions)], dtype=float) * self.rays.range

    @abstractmethod
    def safe_input(self, request: Request, proposal: Array) -> Array | None:
        """Return the input (m,) that the robot executes, or None: it brakes.

        Args:
            request: the measured state (n,), the obstacles of the map within sight (`Shapes`), the input in force (m,),
                and the policy's observation.
            proposal: the policy's input (m,), within bounds and slew.
        """

    def check(self, request: Request) -> None:
        """Check a request as our filter does. Raises BadRequest, with the field's name; see also `standing_map`."""
        check_for_filter(self.robot, request)
        if self.standing_map:
            check_standing_map(self.model.method, request)

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the decision with the filter's input, within bounds and slew. Raises BadInput: it is no input."""
        returned = self.safe_input(request, proposal.copy())
        if returned is None:
            return self.braking(request, started, "the filter brakes")
        action = np.asarray(returned, dtype=float)
        if action.shape != proposal.shape or not np.isfinite(action).all():
            inputs = ", ".join(self.robot.action)
            raise BadInput(f"safe_input returned {returned!r:.200}: return {len(proposal)} finite numbers ({inputs})")
        action = self.robot.clip_input(action, request.input_in_force)
        kind = ALLOWED if np.array_equal(action, proposal) else ADJUSTED
        return self.decision(kind, braking_plan(self.robot, action), 0.0, started)


@dataclass(frozen=True)
class OwnCode(Pretrained):
    """The model of a filter of your own. `method` is the place of its class, `FILE.py:CLASS`."""

    @property
    def version(self) -> str:
        """A hash of the robot and of the file with the class. Other files that the class reads do not change it."""
        path = Path(self.method.rpartition(":")[0])
        try:
            return hashlib.sha256(super().version.encode() + path.read_bytes()).hexdigest()[:12]
        except OSError as error:
            raise BadModel(f"{path}: {error}") from error

    def encode(self) -> bytes:
        """Raise BadModel: a file of a model must not name code to run."""
        raise BadModel(f"{self.method} is code of your own, which no file of a model can hold")

    def ready(self) -> OwnFilter:
        """Return the filter. Raises UnknownTask: the code cannot be loaded; BadModel: it is no `OwnFilter`."""
        made = load_code(self.method, Path())
        if not (isinstance(made, type) and issubclass(made, OwnFilter)):
            raise BadModel(f"{self.method} is no filter: derive the class from brakeline.OwnFilter")
        if made.__abstractmethods__:
            raise BadModel(f"{self.method} lacks the method {', '.join(sorted(made.__abstractmethods__))}")
        return made(self)
