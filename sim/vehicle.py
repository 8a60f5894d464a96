"""What every vehicle has in common, whatever it is and wherever it runs: one input in, one period's report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena

Array = NDArray[np.float64]


class BadInput(ValueError):
    """An input that is not a finite vector of the robot's length."""


def clip_input(robot: Robot, input: Array, before: Array) -> Array:
    """What is executed of an input (m,) after `before`: within the robot's bounds and slew.

    Raises:
        BadInput: when it is not as many finite numbers as the robot has inputs.
    """
    input = np.asarray(input, dtype=np.float64)
    if input.shape != (robot.action_dim,) or not np.isfinite(input).all():
        raise BadInput(f"an input is {robot.action_dim} finite numbers, not {input!r}")
    slew = np.asarray(robot.action_slew)
    return np.clip(np.clip(input, robot.low(), robot.high()), before - slew, before + slew)


@dataclass(frozen=True)
class Period:
    """What happened in one period. n: state coordinates; d: of them the position; S: samples in a period."""

    measured: Array  # (n,) state at its end, as estimated
    true: Array  # (n,) state at its end, as it is
    collision: bool  # some geom of the robot touched an obstacle at some physics step
    closest: float  # m, least distance from a disc (sphere) of the body to an obstacle, at the samples
    clearance: float  # m, the same at the period's end
    subsamples: Array  # (S, d) m, estimated positions from the period's start, in the robot's frame of that moment
    turned: float  # rad, estimated change of heading; 0 for a robot whose state has none
    contact_moving: bool = False  # it touched something that moves, and was moving itself when that began
    contact_standing: bool = False  # it was run into while it stood
    contact_robot: bool = False  # it began to touch another robot of its world


class Vehicle(Protocol):
    """One robot in one arena, for one episode."""

    @property
    def true(self) -> Array:
        """(n,) the state as it is."""

    @property
    def measured(self) -> Array:
        """(n,) the state as it is estimated."""

    @property
    def input(self) -> Array:
        """(m,) what was executed last, within bounds and slew; zero before the first step."""

    def step(self, input: Array) -> Period:
        """Carry out an input for one period; it is clipped to the robot's bounds and slew.

        Raises:
            BadInput: when the input is not m finite numbers.
        """

    def initial_period(self) -> Period:
        """The present state as a period in which nothing happened: what there is to say before the first step."""

    def alter(self, **changes: float) -> None:
        """Change the vehicle's physics, from now on, by the names that its kind documents.

        Raises:
            ValueError: this kind of vehicle has no such thing, or it cannot have this value.
        """


MakeVehicle = Callable[[Arena, np.random.Generator], Vehicle]  # from the generator comes every error of its sensors
