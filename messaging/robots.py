"""What every part must agree on about a robot: names, order, units and bounds of its vectors, and its clock.

SI units and ENU throughout. The first `position_dim` coordinates of a state are its position.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class UnknownRobot(ValueError):
    """The name is not in `ROBOTS`."""

    field = "robot"  # of a request, where it stands


@dataclass(frozen=True)
class Robot:
    """A robot kind.

    A plan has `horizon` inputs, one a period: `free_steps` chosen ones, then a linear ramp of the last of them
    down to zero in `brake_steps`. After it the robot stands still (`method` of both robots: zero input is a stop).
    """

    name: str
    period: float  # s between decisions
    state: tuple[str, ...]  # name [unit]; the position comes first
    position_dim: int
    heading: int | None  # index of the heading in the state; None: displacement is regressed in the world frame
    action: tuple[str, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    translates: tuple[bool, ...]  # which inputs move the position; the others can be used while standing
    action_slew: tuple[float, ...]  # largest change of the input from one period to the next; inf: none
    observation: tuple[str, ...]
    regressor: tuple[int, ...]  # state coordinates that matter for the next step, besides the input in force
    measurement_bound: tuple[float, ...]  # Z_v: half-widths of |measured - true|, one a state coordinate
    footprint: float  # m, radius of the disc (sphere) about the position that holds the body in every attitude
    sight: float  # m from the measured position: the obstacles that come with every request
    horizon: int
    free_steps: int
    brake_steps: int
    late: bool = False  # an answer counts from the next period on: a plan's first input is the one in force meanwhile

    @property
    def kind(self) -> str:
        """Its name but for the time it lives in: robots of one kind have the same body, senses, arenas and policies."""
        return self.name.removesuffix(LATE)

    @property
    def state_dim(self) -> int:
        return len(self.state)

    @property
    def action_dim(self) -> int:
        return len(self.action)

    @property
    def observation_dim(self) -> int:
        return len(self.observation)

    @property
    def regressor_dim(self) -> int:
        """Length of z_0 = [x_0 (regressor coordinates); input in force], to which a plan's inputs are appended."""
        return len(self.regressor) + self.action_dim

    @property
    def given(self) -> int:
        """So many of a plan's free inputs are no longer free when the question is asked."""
        return int(self.late)

    def in_real_time(self) -> Robot:
        """The same robot where the world does not wait for an answer: it decides on the period after this one."""
        return replace(self, name=self.name + LATE, late=True, horizon=self.horizon + 1, free_steps=self.free_steps + 1)

    @property
    def speeds(self) -> slice:
        """The state coordinates that follow the inputs: they come after the pose."""
        first = self.position_dim + (self.heading is not None)
        return slice(first, first + self.action_dim)

    def low(self) -> Array:
        return np.asarray(self.action_low)

    def high(self) -> Array:
        return np.asarray(self.action_high)

    def schedule(self) -> Array:
        """S with `plan = S @ free`, plan (horizon·m) and free (free_steps·m) stacked step by step. Shape (N·m, F·m)."""
        m = self.action_dim
        fractions = np.zeros((self.horizon, self.free_steps))
        for k in range(self.horizon):
            if k < self.free_steps:
                fractions[k, k] = 1.0
            else:
                fractions[k, -1] = max(0.0, 1.0 - (k - self.free_steps + 1) / self.brake_steps)
        return np.asarray(np.kron(fractions, np.eye(m)), dtype=float)

    def layout(self) -> str:
        """Hash of everything that two processes must share to understand each other's vectors."""
        shared = {name: value for name, value in asdict(self).items() if name != "late" or value}
        return hashlib.sha256(repr(sorted(shared.items())).encode()).hexdigest()[:16]


LATE = "-late"  # ends the name of a robot in real time
RAYS = 18

GROUND = Robot(
    name="ground",
    period=0.2,
    state=("x [m]", "y [m]", "heading [rad]", "speed [m/s]", "turn rate [rad/s]"),
    position_dim=2,
    heading=2,
    action=("speed [m/s]", "turn rate [rad/s]"),
    action_low=(0.0, -0.5),
    action_high=(0.25, 0.5),
    translates=(True, False),
    action_slew=(math.inf, math.inf),
    observation=(
        *(f"ray {i} [range/3.5 m]" for i in range(RAYS)),
        "goal distance [5 m]",
        "goal bearing sin",
        "goal bearing cos",
        "speed [0.25 m/s]",
        "turn rate [0.5 rad/s]",
        "last speed input [0.25 m/s]",
        "last turn input [0.5 rad/s]",
        "turn memory: low-passed turn rate [0.5 rad/s]",
    ),
    regressor=(3, 4),
    measurement_bound=(0.01, 0.01, 0.02, 0.02, 0.05),
    footprint=0.105,
    sight=1.0,
    horizon=3,
    free_steps=1,
    brake_steps=1,
)

SPHERE_RAYS = 180  # of the quadrotor's lidar: 36 azimuths over 360° x 5 elevations over 60°

QUADROTOR = Robot(
    name="quadrotor",
    period=0.2,
    state=(
        *(f"{axis} [m]" for axis in "xyz"),
        *(f"v{axis} [m/s]" for axis in "xyz"),
        *(f"a{axis} [m/s2]" for axis in "xyz"),
    ),
    position_dim=3,
    heading=None,  # the yaw is held at zero: its frame is the world's
    action=tuple(f"v{axis} setpoint [m/s]" for axis in "xyz"),
    action_low=(-5.0, -5.0, -5.0),
    action_high=(5.0, 5.0, 5.0),
    translates=(True, True, True),
    action_slew=(0.8, 0.8, 0.8),  # 4 m/s² by a period of 0.2 s
    observation=(
        *(f"ray {i} [range/12 m]" for i in range(SPHERE_RAYS)),
        *(f"goal - p, {axis} [its length + 5 m]" for axis in "xyz"),
        *(f"v{axis} [5 m/s]" for axis in "xyz"),
        *(f"last v{axis} setpoint [5 m/s]" for axis in "xyz"),
    ),
    regressor=(3, 4, 5, 6, 7, 8),
    measurement_bound=(0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.3, 0.3, 0.3),
    footprint=0.3,
    sight=12.0,
    horizon=12,
    free_steps=1,
    brake_steps=7,  # from 5 m/s the ramp falls by 0.71 m/s a period, within the slew
)

ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (GROUND, QUADROTOR)}


def robot_named(name: str) -> Robot:
    """The robot of that name; with `LATE` at its end, the same in real time.

    Raises:
        UnknownRobot: with the names there are.
    """
    try:
        return ROBOTS[name.removesuffix(LATE)].in_real_time() if name.endswith(LATE) else ROBOTS[name]
    except KeyError:
        raise UnknownRobot(f"no robot is called {name!r}; there are: {', '.join(sorted(ROBOTS))}") from None
