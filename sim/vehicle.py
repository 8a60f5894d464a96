"""The interface of every vehicle, simulated or real: one input in, the report of one period out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from brakeline.messaging.body_clearance import body_clearance
from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import nearest_distances


@dataclass(frozen=True)
class Period:
    """The report of one period. Dimensions: n coordinates of the state, d of the position, S samples in a period."""

    measured: Array  # (n,) measured state at the end
    true: Array  # (n,) true state at the end
    collision: bool  # the robot touched a static obstacle in some physics step
    closest: float  # m, least distance from a disc (sphere) of the body to an obstacle, over the samples
    clearance: float  # m, the same distance at the end
    subsamples: Array  # (S, d) m, estimated positions relative to the start, in the robot's frame at the start
    turned: float  # rad, estimated change of heading; 0 for a robot without a heading
    contact_moving: bool = False  # the robot touched a moving obstacle while it was moving itself
    contact_standing: bool = False  # a moving obstacle touched the robot while the robot stood
    contact_robot: bool = False  # the robot began to touch another robot of its world

    @property
    def at_fault(self) -> bool:
        """Whether the robot touched something, and is responsible for it."""
        return self.collision or self.contact_moving or self.contact_robot


class Vehicle(Protocol):
    """One robot in one arena, for one episode."""

    @property
    def true(self) -> Array:
        """The true state (n,)."""

    @property
    def measured(self) -> Array:
        """The measured state (n,)."""

    @property
    def input(self) -> Array:
        """The input (m,) executed last, within bounds and slew; zero before the first step."""

    def step(self, input: Array) -> Period:
        """Carry out an input (m,) for one period, clipped to the robot's bounds and slew.

        Raises:
            BadInput: the input is not m finite numbers.
        """

    def initial_period(self) -> Period:
        """Return the report of a period in which nothing happened, at the present state."""

    def alter(self, **changes: float) -> None:
        """Change the vehicle's physics from now on; each kind of vehicle documents the names that it takes.

        Raises:
            ValueError: the vehicle has nothing with this name to change, or the value is out of range.
        """


MakeVehicle = Callable[[Arena, np.random.Generator], Vehicle]  # the generator is the source of all sensor errors


class SimulatedVehicle:
    """Base class of the vehicles in MuJoCo: it makes their reports and changes their physics."""

    robot: Robot
    samples: int  # number of positions in the report of a period
    arena: Arena
    true: Array
    measured: Array
    input: Array

    def clearance(self, states: Array) -> Array:
        """Return the distance [m] from the body in states (..., n) to the nearest obstacle, or inf.

        If the robot has no heading, or its body is a disc about the position, positions (..., d) are enough.
        """
        if self.robot.heading is not None and any(disc.arm > 0.0 for disc in self.robot.body):
            return body_clearance(self.robot, self.arena.shapes, states)
        positions = states[..., : self.robot.position_dim]
        distances = nearest_distances(self.arena.shapes, positions.reshape(-1, self.robot.position_dim))
        return np.asarray(distances.reshape(positions.shape[:-1]) - self.robot.footprint)

    def initial_period(self) -> Period:
        """Return the report of a period in which nothing happened, at the present state."""
        return self._report(False, self.true[None], np.zeros((self.samples, self.robot.position_dim)), 0.0)

    def _report(self, collision: bool, states: Array, subsamples: Array, turned: float, *contacts: bool) -> Period:
        """Return the report of a period, with the true states (K, d or more) at its samples."""
        distances = self.clearance(states)
        closest, clearance = float(distances.min()), float(distances[-1])
        return Period(self.measured, self.true, collision, closest, clearance, subsamples, turned, *contacts)

    def setters(self) -> dict[str, Callable[[float], None]]:
        """Return what `alter` can change, by name."""
        return {}

    def alter(self, **changes: float) -> None:
        """Change the physics from now on, with one of `setters`.

        Raises:
            ValueError: `setters` lacks the name, or the value is negative or not finite.
        """
        setters = self.setters()
        if unknown := changes.keys() - setters.keys():
            names = ", ".join(setters) or "nothing"
            raise ValueError(f"{self.robot.kind}: cannot change {', '.join(sorted(unknown))}; can change: {names}")
        for name, value in changes.items():
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and 0 or more, not {value}")
            setters[name](value)
