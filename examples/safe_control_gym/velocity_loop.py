"""The velocity loop: the force that balances the pole while the cart follows a commanded velocity, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brakeline import robot_named

Array = NDArray[np.float64]

ROBOT = robot_named(str(Path(__file__).with_name("cartpole.toml")))
STRONGEST = 10.0  # N, of the environment's motor
# N per m/s, rad and rad/s: the LQR for speed, tilt and tilt rate, with weights 3, 1, 0.1, and 0.1 for the force.
GAIN = np.array([-3.53, -36.99, -9.48])


def force_of(state: Array, velocity: float) -> float:
    """Return the force [N] in a state (x, speed, tilt, tilt rate) that follows a commanded velocity [m/s]."""
    return float(np.clip(-GAIN @ (state[1:4] - [velocity, 0.0, 0.0]), -STRONGEST, STRONGEST))


def velocity_of(state: Array, force: float) -> float:
    """Return the commanded velocity [m/s] that gives a force [N], or the nearest one within its bounds."""
    velocity = (force + GAIN @ state[1:4]) / GAIN[0]
    return float(np.clip(velocity, ROBOT.low()[0], ROBOT.high()[0]))
