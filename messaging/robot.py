"""The robot model that all parts share: its vectors with names, units and bounds, its body, and how it stops.

A robot is a file (`robots/NAME.toml`, or a file of your own); `brakeline.messaging.robot_description` reads it. All
values are in SI units and ENU frames. The first `position_dim` coordinates of a state are the position. A robot in
joint space has no position (`position_dim` = 0): its limits are all that a plan must respect.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadInput, UnknownRobot
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX, ROBOTS_FOLDER, TASK_SEPARATOR

Array = NDArray[np.float64]

INPUT_ROUNDING = 1e-9  # rounding that the bounds of an input allow
RAMP, HOLD, FEEDBACK = "ramp", "hold", "feedback"
INPUT_TOLERANCE = 1e-6  # share of an input's range: closer inputs are equal (logs hold single precision)
DEFAULT_ACCEPT_BOUND = 0.01


@dataclass(frozen=True)
class Disc:
    """A disc (a sphere in space) fixed to the robot's frame.

    >>> Disc(at=(0.3, 0.4), radius=0.1).arm
    0.5

    Attributes:
        at: center (d,) relative to the position [m].
        radius: [m].
    """

    at: tuple[float, ...]
    radius: float

    @property
    def arm(self) -> float:
        """Distance from the position to the center [m]."""
        return math.hypot(*self.at)


@dataclass(frozen=True)
class Limit:
    """A half-space `weights · state <= most` that every plan must respect, as it respects obstacles.

    >>> Limit("stay left of x = 2 m", weights=(1.0, 0.0, 0.0, 0.0, 0.0), most=2.0).most
    2.0

    Attributes:
        name: the name that messages give.
        weights: (n,), one for each state coordinate, in the order of the description.
        most: largest value of `weights · state`; with one weight of 1, in the unit of that coordinate.
    """

    name: str
    weights: tuple[float, ...]
    most: float


@dataclass(frozen=True)
class Robot:
    """A kind of robot with n state coordinates and m inputs.

    >>> robot = robot_named("ground")
    >>> robot.action, robot.period, robot.horizon
    (('speed [m/s]', 'turn rate [rad/s]'), 0.2, 3)

    A plan has `horizon` inputs, one for each period. The first `free_steps` inputs are free. After them, each input
    follows its own `stop` rule, at the end of which the robot stands:

        RAMP       falls linearly to zero in `brake_steps` periods
        HOLD       keeps the last free value (a car keeps its steering angle)
        fractions  multiplies the last free value by each fraction in turn; the last one is zero
        FEEDBACK   equals `feedback` times the measured state
    """

    name: str
    period: float  # time between decisions [s]
    state: tuple[str, ...]  # "name [unit]"; the position comes first
    position_dim: int  # 2 or 3; 0: joint space, without obstacles, sight and body
    heading: int | None  # index of the heading in the state; None: displacements are in the world frame
    action: tuple[str, ...]  # "name [unit]"
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    translates: tuple[bool, ...]  # whether each input moves the position; the others may be used at standstill
    action_slew: tuple[float, ...]  # largest change of each input in one period; inf: no limit
    regressor: tuple[int, ...]  # state coordinates that, with the inputs, determine the next displacement
    measurement_bound: tuple[float, ...]  # Z_v: largest |measured - true| of each state coordinate
    sight: float  # radius about the measured position within which a request lists all obstacles [m]
    horizon: int
    free_steps: int
    brake_steps: int
    body: tuple[Disc, ...]  # discs that together cover the body
    stop: tuple[str | tuple[float, ...], ...]  # the stop rule of each input
    follows: tuple[int, ...]  # for each input, the state coordinate that converges to it; -1: none
    feedback: tuple[tuple[float, ...], ...] = ()  # (m, n): gains on the measured state, for inputs with FEEDBACK
    stopped: float = math.inf  # largest residual speed that counts as standing, in the units of each coordinate
    limits: tuple[Limit, ...] = ()
    late: bool = False  # real time: an answer takes effect one period later, so the first input of a plan is fixed
    # Largest stated share of plans outside their tubes that a model set may have without an explicit confirmation.
    # Robots that differ only in it are equal and have the same layout.
    accept_bound: float = field(default=DEFAULT_ACCEPT_BOUND, compare=False)

    @property
    def kind(self) -> str:
        """The name without the real-time suffix. Robots of one kind share body, sensors, arenas and policies."""
        return self.name.removesuffix(REAL_TIME_SUFFIX)

    @property
    def state_dim(self) -> int:
        return len(self.state)

    @property
    def action_dim(self) -> int:
        return len(self.action)

    @property
    def regressor_dim(self) -> int:
        """Length of z_0 = [regressor coordinates of x_0; input in force], which precedes the inputs of a plan."""
        return len(self.regressor) + self.action_dim

    @property
    def path_dim(self) -> int:
        """Number of coordinates of a recorded path: those of the position, or all in joint space."""
        return self.position_dim or self.state_dim

    @cached_property
    def limit_weights(self) -> Array:
        """The weights (C, n) of the limits."""
        return np.array([limit.weights for limit in self.limits]).reshape(-1, self.state_dim)

    @cached_property
    def limit_scales(self) -> Array:
        """The units (C,) in which limits of different kinds are compared.

        The unit of a limit is half its distance to the opposite limit; without one, |most|; if that is zero, 1.
        """
        opposite = {limit.weights: limit.most for limit in self.limits}
        scales = []
        for limit in self.limits:
            other = opposite.get(tuple(-weight for weight in limit.weights))
            scale = abs(limit.most) if other is None else 0.5 * (limit.most + other)
            scales.append(scale if scale > 0.0 else 1.0)
        return np.array(scales)

    def limit_values(self, states: Array) -> Array:
        """Return `weights · state` of each limit (..., C), in units of `limit_scales`, for states (..., n)."""
        return np.asarray(states @ (self.limit_weights / self.limit_scales[:, None]).T)

    @property
    def committed_steps(self) -> int:
        """Number of free inputs that are already fixed when the filter decides: 1 in real time, otherwise 0."""
        return int(self.late)

    def in_real_time(self) -> Self:
        """Return the same robot in a world that moves on while the filter decides.

        Raises:
            UnknownRobot: the robot stops by feedback, so the input in force is unknown when the filter decides.
        """
        if self.feedback:
            raise UnknownRobot(f"{self.name} stops by feedback: it has no real-time mode")
        name, horizon, free_steps = self.name + REAL_TIME_SUFFIX, self.horizon + 1, self.free_steps + 1
        return replace(self, name=name, late=True, horizon=horizon, free_steps=free_steps)

    def in_lockstep(self) -> Self:
        """Return the same robot in a world that waits for each decision."""
        if not self.late:
            return self
        return replace(self, name=self.kind, late=False, horizon=self.horizon - 1, free_steps=self.free_steps - 1)

    @cached_property
    def least_margin(self) -> float:
        """The least margin of an obstacle that has an effect [m]: minus the radius of the body's smallest disc."""
        return -min((disc.radius for disc in self.body), default=0.0)

    @cached_property
    def footprint(self) -> float:
        """Radius of the disc (sphere) about the position that contains the body in every attitude [m]."""
        return max((disc.arm + disc.radius for disc in self.body), default=0.0)

    @cached_property
    def front_extent(self) -> float:
        """Distance from the position straight ahead to the edge of the body [m]."""
        ends = [d.at[0] + math.sqrt(d.radius**2 - d.at[1] ** 2) for d in self.body if abs(d.at[1]) <= d.radius]
        return max(ends, default=self.footprint)

    @property
    def speed_indices(self) -> list[int]:
        """Indices of the state coordinates that converge to an input, in the order of the inputs."""
        return [index for index in self.follows if index >= 0]

    def state_at_inputs(self, inputs: Array) -> Array:
        """Return the state (n,) at the origin after the speeds have converged to the inputs (m,)."""
        state = np.zeros(self.state_dim)
        for index, value in zip(self.follows, inputs, strict=True):
            if index >= 0:
                state[index] = value
        return state

    def low(self) -> Array:
        return np.asarray(self.action_low, dtype=float)

    def high(self) -> Array:
        return np.asarray(self.action_high, dtype=float)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the inputs, (m,) each, widened by `INPUT_ROUNDING`."""
        return self.low() - INPUT_ROUNDING, self.high() + INPUT_ROUNDING

    @cached_property
    def slew(self) -> Array:
        """Largest change of each input (m,) in a period; infinite without a limit."""
        return np.asarray(self.action_slew, dtype=float)

    @cached_property
    def zero_at_rest(self) -> NDArray[np.bool_]:
        """Whether each input (m,) is zero when the robot stands: true for all rules except HOLD."""
        return np.array([rule != HOLD for rule in self.stop])

    @cached_property
    def stops_by_feedback(self) -> NDArray[np.bool_]:
        """Whether each input (m,) follows the rule FEEDBACK."""
        return np.array([rule == FEEDBACK for rule in self.stop])

    def zero_input(self) -> Array:
        """Return the input (m,) within the bounds that is closest to zero: the input before the first decision."""
        return np.asarray(np.clip(0.0, self.low(), self.high()))

    def clip_input(self, wanted: Array, before: Array) -> Array:
        """Return the input (m,) closest to the wanted one within the bounds, and within the slew of the one before.

        >>> robot_named("ground").clip_input(np.array([9.0, 0.0]), before=np.zeros(2))
        array([0.25, 0.  ])

        Raises:
            BadInput: the wanted input is not m finite numbers.
        """
        wanted = np.asarray(wanted, dtype=np.float64)
        if wanted.shape != (self.action_dim,) or not np.isfinite(wanted).all():
            raise BadInput(f"the input of {self.name} must be {self.action_dim} finite numbers, not {wanted!r}")
        near = np.minimum(np.maximum(wanted, before - self.slew), before + self.slew)  # `np.clip` takes longer
        return np.asarray(np.minimum(np.maximum(near, self.low()), self.high()))

    def is_stop_input(self, inputs: Array) -> NDArray[np.bool_]:
        """Return whether inputs (..., m) are zero where a standing robot has zero: (...,)."""
        return np.asarray((np.abs(inputs) < 1e-9)[..., self.zero_at_rest].all(-1))

    def stop_profile(self) -> Array:
        """Return the fraction of the last free input that remains j periods later: (horizon, m); row 0 is ones."""
        profile = np.ones((self.horizon, self.action_dim))
        for j in range(1, self.horizon):
            for i, rule in enumerate(self.stop):
                if rule == RAMP:
                    profile[j, i] = max(0.0, 1.0 - j / self.brake_steps)
                elif rule == FEEDBACK:
                    profile[j, i] = 0.0
                elif rule != HOLD:
                    profile[j, i] = float(rule[min(j, len(rule)) - 1])
        return profile

    def plan_matrix(self) -> Array:
        """Return S (horizon·m, free_steps·m) with `plan = S @ free`; both vectors are stacked step by step.

        The contribution of `feedback` is not included: it depends on the measured state.
        """
        m, F, profile = self.action_dim, self.free_steps, self.stop_profile()
        S = np.zeros((self.horizon * m, F * m))
        for k in range(self.horizon):
            for i in range(m):
                S[k * m + i, min(k, F - 1) * m + i] = 1.0 if k < F else profile[k - F + 1, i]
        return S

    def stop_by_feedback(self, planned: Array, state: Array, before: Array) -> Array:
        """Replace the inputs with the rule FEEDBACK by the feedback on the measured state.

        Args:
            planned: inputs of a plan while it brakes (..., m).
            state: measured state (..., n).
            before: input of the period before (..., m), for the slew limit.

        Returns:
            Inputs (..., m) within the bounds and the slew limit. Without feedback, `planned` itself.
        """
        if not self.feedback:
            return planned
        wanted = np.where(self.stops_by_feedback, state @ np.asarray(self.feedback).T, planned)
        low, high = np.maximum(self.low(), before - self.slew), np.minimum(self.high(), before + self.slew)
        return np.asarray(np.clip(wanted, low, high))

    def is_standing(self, state: Array) -> bool:
        """Return whether all measured speeds in a state (n,) are at most `stopped`.

        In joint space, angles are regressors, too: there, the speeds are the coordinates that follow an input, if any.
        """
        speeds = list(self.regressor) if self.position_dim else self.speed_indices or list(self.regressor)
        return bool((np.abs(state[speeds]) <= self.stopped).all())

    def is_stopping(self, inputs: Array, state: Array, before: Array) -> bool:
        """Return whether the inputs (m,) keep a robot standing, in the measured state (n,) after the input `before`."""
        if not self.feedback:
            return bool(self.is_stop_input(inputs))
        rejected = INPUT_TOLERANCE * (self.high() - self.low())
        stop_inputs = self.stop_by_feedback(np.where(self.zero_at_rest, 0.0, inputs), state, before)
        return self.is_standing(state) and bool((np.abs(inputs - stop_inputs) <= rejected).all())

    def may_be_standing(self, inputs: Array) -> bool:
        """Return whether a standing robot may have executed the inputs (m,).

        With feedback, a standing robot still has inputs in proportion to its residual speed.
        """
        if not self.feedback:
            return bool(self.is_stop_input(inputs))
        gains = np.abs(np.asarray(self.feedback))[:, list(self.regressor)]
        most = INPUT_TOLERANCE * (self.high() - self.low())
        most += np.where(self.stops_by_feedback, gains.sum(1) * self.stopped, 0.0)
        return bool((np.abs(inputs) <= most)[self.zero_at_rest].all())

    @cached_property
    def description(self) -> dict[str, Any]:
        """The description of the robot in lockstep, as JSON values (`brakeline.messaging.robot_description`)."""
        from brakeline.messaging.robot_description import describe

        return describe(self.in_lockstep())

    def layout(self) -> str:
        """Return the hash of everything that two processes must share to exchange the robot's vectors."""
        return self._layout

    @cached_property
    def _layout(self) -> str:
        shared = {name: value for name, value in self.description.items() if name != "accept_bound"}
        text = json.dumps([shared, self.late])  # not sorted: the order of the coordinates matters
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def accepts_layout(self, layout: object) -> bool:
        """Return whether a layout is this robot's, or the one it had before robots were files."""
        return isinstance(layout, str) and layout in (self.layout(), FORMER_LAYOUTS.get(self.name))


# Layouts of logs, model sets and policies from before robots were files.
FORMER_LAYOUTS = {
    "ground": "746231dcb2e4fad7",
    "ground-late": "d013241bb63d32ac",
    "quadrotor": "82b53a84411b2bee",
    "quadrotor-late": "296e1f047a7fcc62",
}


def shipped_robots() -> tuple[str, ...]:
    """Return the names of the robots that are shipped with Brakeline."""
    return tuple(sorted(path.stem for path in ROBOTS_FOLDER.glob("*.toml") if "." not in path.stem))


def robot_named(name: Path | str) -> Robot:
    """Read a robot by its name or path.

    >>> robot_named("quadrotor").position_dim
    3

    Args:
        name: the name of a shipped robot, or the path of a description (.toml). With the suffix `-late`, the robot is
            returned in real time. A task's name after the robot's (`ground+tracks`) does not change the robot.

    Raises:
        UnknownRobot: no robot has this name (the message lists the names), or the file has mistakes (it lists all).
    """
    from brakeline.messaging.robot_description import read_robot

    name = str(name)
    base = name.removesuffix(REAL_TIME_SUFFIX)
    if base.endswith(".toml"):
        robot = refuse_shipped_name(read_robot(Path(base)))
    else:
        base = base.partition(TASK_SEPARATOR)[0]
        if base not in shipped_robots():
            names = ", ".join(shipped_robots())
            raise UnknownRobot(f"no robot is called {name!r}; there are: {names}, or the path of a description (.toml)")
        robot = read_robot(ROBOTS_FOLDER / f"{base}.toml")
    return robot.in_real_time() if name.endswith(REAL_TIME_SUFFIX) else robot


def refuse_shipped_name(robot: Robot) -> Robot:
    """Return the robot. Raises UnknownRobot: the robot has the name of a shipped robot but differs from it."""
    name = robot.in_lockstep().name
    if name in shipped_robots() and robot.description != robot_named(name).description:
        raise UnknownRobot(f"{name} is the name of a robot that comes with the program: choose another")
    return robot
