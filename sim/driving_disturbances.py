"""Disturbances of ground robots: motors that differ, wheels that turn unevenly, and a floor that is not level.

`brakeline.sim.sim_conditions.ProcessNoise` has their levels and sources.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.sim.sim_conditions import ProcessNoise

Rows = NDArray[np.intp]

LIMIT = 3.0  # standard deviations at which each disturbance is cut off
DRAWS_AT_START = 6  # numbers of an episode: two gains, and the first values of the fluctuations
DRAWS_OF_SAMPLE = 4  # numbers of a sample: two wheels, two tilts
HELD_AFTER = 10  # samples without an input, in which the robot stops


class DrivingDisturbances:
    """The disturbances of N robots, with a value for each sample.

    A wheel turns at its commanded speed times 1 + g + s. The gain error g is constant over an episode, and s is a
    first-order Gauss-Markov process. The floor's tilts along the world's x and y are such processes too. The weight
    times the tilt pulls at the robot's centre of mass. It lies behind the axle, so a pull across also turns the robot.

    The simulated motors control speed and would let a standing robot roll away slowly. The gears of the real ones hold
    the wheels. Therefore the floor has no effect from `HELD_AFTER` samples without an input on.
    """

    def __init__(self, noise: ProcessNoise, size: int, sample_time: float) -> None:
        """sample_time: time between two values [s]."""
        self._gain_sigma = noise.scale * noise.motor_gain
        self._sigma = noise.scale * np.repeat([noise.wheel_speed, noise.floor_tilt], 2)
        self._decay = np.exp(-sample_time / np.repeat([noise.wheel_correlation, noise.floor_correlation], 2))
        self._innovation = np.sqrt(1.0 - self._decay**2)
        self._gains, self._values = np.zeros((size, 2)), np.zeros((size, DRAWS_OF_SAMPLE))
        self._idle = np.zeros(size, dtype=int)  # samples since the last one with an input

    def begin(self, rows: Rows, draws: Array) -> None:
        """Begin episodes of standing robots, with standard normal numbers `draws` (rows, DRAWS_AT_START)."""
        self._gains[rows] = self._gain_sigma * np.clip(draws[:, :2], -LIMIT, LIMIT)
        self._values[rows], self._idle[rows] = draws[:, 2:], HELD_AFTER

    def advance(self, rows: Rows, driven: NDArray[np.bool_], draws: Array) -> tuple[Array, Array]:
        """Advance by S samples.

        Args:
            driven: (rows,) whether the robot's input in these samples is not zero.
            draws: (rows, S, DRAWS_OF_SAMPLE) standard normal numbers.

        Returns:
            Factors (rows, S, 2) of the speeds of the left and the right wheel, and tilts (rows, S, 2) of the floor
            along x and y [rad].
        """
        values, samples = self._values[rows], self._innovation * draws
        for i in range(draws.shape[1]):
            values = self._decay * values + samples[:, i]
            samples[:, i] = values
        self._values[rows] = values
        samples = self._sigma * np.clip(samples, -LIMIT, LIMIT)
        idle = np.where(driven, 0, self._idle[rows])
        self._idle[rows] = np.where(driven, 0, idle + draws.shape[1])
        tilts = samples[..., 2:] * (idle < HELD_AFTER)[:, None, None]
        return 1.0 + self._gains[rows, None] + samples[..., :2], tilts
