"""The interface of many simulated vehicles: inputs of all of them in, the reports of one period out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.batch.normal_streams import Rows
from brakeline.sim.batch.obstacle_batch import ObstacleBatch


@dataclass(frozen=True)
class PeriodBatch:
    """The reports of one period, with a row for each robot: see `Period`."""

    measured: Array  # (rows, n)
    true: Array  # (rows, n)
    collision: NDArray[np.bool_]  # (rows,)
    closest: Array  # (rows,) m
    clearance: Array  # (rows,) m
    subsamples: Array  # (rows, S, d) m
    turned: Array  # (rows,) rad


class VehicleBatch(ABC):
    """N robots, each alone in its arena. Arguments and results have a row for each of the `rows` they are about.

    Attributes:
        robot: its kind. samples: S, of the position in a period.
        true, measured: (N, n) states.
        input: (N, m) inputs executed last.
        obstacles: those of each robot's arena.
    """

    robot: Robot
    samples: int

    def __init__(self, size: int, kind: ArenaKind) -> None:
        """Make room for `size` robots. kind: of the arenas."""
        self.obstacles, self.input = ObstacleBatch(size, kind), np.zeros((size, self.robot.action_dim))
        self.true, self.measured = np.zeros((size, self.robot.state_dim)), np.zeros((size, self.robot.state_dim))
        self._clearance = np.zeros(size)  # m, from the body to the nearest obstacle

    @abstractmethod
    def begin(self, rows: Rows, arenas: list[Arena], generators: list[np.random.Generator]) -> None:
        """Place robots at the starts of their arenas, at rest. generators: of the episodes."""

    def initial_period(self, rows: Rows) -> PeriodBatch:
        """Return the reports of a period in which nothing happened, at the present states."""
        k, states = len(rows), (self.measured[rows], self.true[rows])
        path, still = np.zeros((k, self.samples, self.robot.position_dim)), np.zeros(k, dtype=bool)
        clearance = self._clearance[rows]
        return PeriodBatch(*states, still, clearance, clearance, path, np.zeros(k))

    @abstractmethod
    def set_input(self, rows: Rows, inputs: Array) -> None:
        """Set the inputs (rows, m) of the next period, which are finite; clip them to the robot's bounds and slew."""

    @abstractmethod
    def advance(self, rows: Rows) -> Any:
        """Simulate a period of the physics, which `finish` takes. It may run in a thread, beside an observation."""

    @abstractmethod
    def finish(self, rows: Rows, motion: Any) -> PeriodBatch:
        """Measure, and return the reports of a period whose physics `advance` simulated."""

    def close(self) -> None:  # noqa: B027, most have no threads
        """End the threads, if there are any."""
