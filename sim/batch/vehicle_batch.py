"""The interface of many simulated vehicles: inputs of all of them in, the reports of one period out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.sim.arena import Arena
from brakeline.sim.batch.obstacle_batch import ObstacleBatch

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class PeriodBatch:
    """The reports of one period, with a row for each robot: see `Period`."""

    measured: Array  # (rows, n)
    true: Array  # (rows, n)
    collision: NDArray[np.bool_]  # (rows,)
    clearance: Array  # (rows,) m
    subsamples: Array  # (rows, S, d) m
    turned: Array  # (rows,) rad


def resting_period(measured: Array, true: Array, clearance: Array, samples: int, d: int) -> PeriodBatch:
    """Return the reports of a period in which nothing happened."""
    k = len(true)
    return PeriodBatch(measured, true, np.zeros(k, dtype=bool), clearance, np.zeros((k, samples, d)), np.zeros(k))


class VehicleBatch(Protocol):
    """N robots, each alone in its arena. Arguments and results have a row for each of the `rows` they are about."""

    obstacles: ObstacleBatch
    true: Array  # (N, n)
    measured: Array  # (N, n)
    input: Array  # (N, m), executed last

    def begin(self, rows: Rows, arenas: list[Arena], generators: list[np.random.Generator]) -> None:
        """Place robots at the starts of their arenas, at rest. generators: of the episodes."""

    def initial_period(self, rows: Rows) -> PeriodBatch:
        """Return the reports of a period in which nothing happened, at the present states."""

    def set_input(self, rows: Rows, inputs: Array) -> None:
        """Set the inputs (rows, m) of the next period, which are finite; clip them to the robot's bounds and slew."""

    def advance(self, rows: Rows) -> Any:
        """Simulate a period of the physics, which `finish` takes. It may run in a thread, beside an observation."""

    def finish(self, rows: Rows, motion: Any) -> PeriodBatch:
        """Measure, and return the reports of a period whose physics `advance` simulated."""

    def close(self) -> None:
        """End the threads."""
