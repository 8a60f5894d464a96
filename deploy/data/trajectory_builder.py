"""Build a trajectory period by period, while a robot drives."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.model.dataset import Trajectory


class TrajectoryBuilder:
    """A trajectory during its recording."""

    def __init__(self, state: Array, before: Array | None = None) -> None:
        """Begin at `state` (n,), with the input `before` (m,) in force; None: at rest."""
        self._states, self._before = [state], before
        self._inputs, self._paths, self._turned = list[Array](), list[Array](), list[float]()

    def __len__(self) -> int:
        return len(self._inputs)

    @property
    def state(self) -> Array:
        """Return the last state (n,)."""
        return self._states[-1]

    def add(self, executed: Array, state: Array, path: Array, turned: float = 0.0) -> None:
        """Add a period: executed input (m,), state after it (n,), path in m (samples, d) and turn in rad."""
        self._inputs.append(executed)
        self._states.append(state)
        self._paths.append(path)
        self._turned.append(turned)

    def trajectory(self) -> Trajectory:
        arrays = np.array(self._states), np.array(self._inputs), np.array(self._paths), np.array(self._turned)
        return Trajectory(*arrays, self._before)
