"""What every part must agree on about a robot: names, order, units and bounds of its vectors, how it stops, its clock.

A robot is a file (`robots/NAME.toml`, or anybody's own), read by `brakeline.messaging.robot_description`. SI units
and ENU throughout.
The first `position_dim` coordinates of a state are its position.
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

Array = NDArray[np.float64]

INPUT_ROUNDING = 1e-9  # of an input

REAL_TIME_SUFFIX = "-late"  # ends the name of a robot in real time
TASK_SEPARATOR = (
    "+"  # stands between a robot's name and that of another task than its usual one (`brakeline.messaging.task`)
)
RAMP, HOLD, FEEDBACK = "ramp", "hold", "feedback"
INPUT_TOLERANCE = (
    1e-6  # of an input's range: two inputs this close are the same (they were rounded to single precision)
)
DEFAULT_ACCEPT_BOUND = (
    0.01  # largest stated share of plans outside their tubes that a robot is driven behind without a question
)
ROBOTS_FOLDER = Path(__file__).parents[1] / "robots"


class UnknownRobot(ValueError):
    """No robot of that name is known here, or its description is none."""

    field = "robot"  # of a request, where it stands


@dataclass(frozen=True)
class Disc:
    """A disc (sphere in space) fixed to the robot's frame. at (d,) [m] from the regressed position; radius [m]."""

    at: tuple[float, ...]
    radius: float

    @property
    def arm(self) -> float:
        """m from the regressed position to its centre."""
        return math.hypot(*self.at)


@dataclass(frozen=True)
class Limit:
    """`weights · state <= most`, to be kept along every plan like an obstacle. weights (n,), in units of each."""

    name: str
    weights: tuple[float, ...]
    most: float


@dataclass(frozen=True)
class Robot:
    """A robot kind.

    A plan has `horizon` inputs, one a period: `free_steps` chosen ones, then each input by its own `stop` rule: down to
    zero linearly in `brake_steps` (`RAMP`), held as it is (`HOLD`: a car keeps its steering), fractions of the last
    chosen one (a profile that ends in zero), or what `feedback` makes of the measured state (`FEEDBACK`). After it the
    robot stands.
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
    regressor: tuple[int, ...]  # state coordinates that matter for the next step, besides the input in force
    measurement_bound: tuple[float, ...]  # Z_v: half-widths of |measured - true|, one a state coordinate
    sight: float  # m from the measured position: the obstacles that come with every request
    horizon: int
    free_steps: int
    brake_steps: int
    body: tuple[Disc, ...]  # holds the whole body
    stop: tuple[str | tuple[float, ...], ...]  # a rule an input
    follows: tuple[int, ...]  # for each input the state coordinate that comes to it; -1: none does
    feedback: tuple[tuple[float, ...], ...] = ()  # (m, n): of inputs that stop by it, gains on the measured state
    stopped: float = math.inf  # residual speed, in units of each followed or regressed coordinate, that counts as none
    limits: tuple[Limit, ...] = ()
    late: bool = False  # an answer counts from the next period on: a plan's first input is the one in force meanwhile
    # The largest share of plans outside their tubes, as a model set states it, that is used without a question. It says
    # nothing about the robot's vectors: robots that differ in nothing else are equal, and have one layout.
    accept_bound: float = field(default=DEFAULT_ACCEPT_BOUND, compare=False)

    @property
    def kind(self) -> str:
        """Its name but for the time it lives in: robots of one kind have the same body, senses, arenas and policies."""
        return self.name.removesuffix(REAL_TIME_SUFFIX)

    @property
    def state_dim(self) -> int:
        return len(self.state)

    @property
    def action_dim(self) -> int:
        return len(self.action)

    @property
    def regressor_dim(self) -> int:
        """Length of z_0 = [x_0 (regressor coordinates); input in force], to which a plan's inputs are appended."""
        return len(self.regressor) + self.action_dim

    @property
    def committed_steps(self) -> int:
        """So many of a plan's free inputs are no longer free when the question is asked."""
        return int(self.late)

    def in_real_time(self) -> Self:
        """The same robot where the world does not wait for an answer: it decides on the period after this one.

        Raises:
            UnknownRobot: it stops by feedback: what the input in force then is, is not known when it is asked about.
        """
        if self.feedback:
            raise UnknownRobot(f"{self.name} stops by feedback: it has no real-time mode")
        return replace(
            self, name=self.name + REAL_TIME_SUFFIX, late=True, horizon=self.horizon + 1, free_steps=self.free_steps + 1
        )

    def in_lockstep(self) -> Self:
        """The same robot where the world waits."""
        if not self.late:
            return self
        return replace(self, name=self.kind, late=False, horizon=self.horizon - 1, free_steps=self.free_steps - 1)

    @cached_property
    def footprint(self) -> float:
        """m, radius of the disc (sphere) about the position that holds the body in every attitude."""
        return max(disc.arm + disc.radius for disc in self.body)

    @cached_property
    def front_extent(self) -> float:
        """m from the position straight ahead to where the discs of the body end."""
        ends = [d.at[0] + math.sqrt(d.radius**2 - d.at[1] ** 2) for d in self.body if abs(d.at[1]) <= d.radius]
        return max(ends, default=self.footprint)

    @property
    def speed_indices(self) -> list[int]:
        """The state coordinates that come to the inputs, in the order of those that any comes to."""
        return [index for index in self.follows if index >= 0]

    def state_at_inputs(self, inputs: Array) -> Array:
        """The state (n,), at the origin, of a robot that has come to these inputs (m,)."""
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
        """(m,), (m,): what no input may be beyond, rounding allowed."""
        return self.low() - INPUT_ROUNDING, self.high() + INPUT_ROUNDING

    @cached_property
    def zero_at_rest(self) -> NDArray[np.bool_]:
        """(m,) which inputs are zero when it stands: all but those that are held."""
        return np.array([rule != HOLD for rule in self.stop])

    @cached_property
    def stops_by_feedback(self) -> NDArray[np.bool_]:
        """(m,) which inputs stop by feedback."""
        return np.array([rule == FEEDBACK for rule in self.stop])

    def zero_input(self) -> Array:
        """The input (m,) nearest to none: that of a robot that has not been given any."""
        return np.asarray(np.clip(0.0, self.low(), self.high()))

    def is_stop_input(self, inputs: Array) -> NDArray[np.bool_]:
        """Are these inputs (..., m) those of a stop?"""
        return np.asarray((np.abs(inputs) < 1e-9)[..., self.zero_at_rest].all(-1))

    def stop_profile(self) -> Array:
        """What the rules leave of the last chosen input, j periods after it: (horizon, m), ones for j = 0."""
        left = np.ones((self.horizon, self.action_dim))
        for j in range(1, self.horizon):
            for i, rule in enumerate(self.stop):
                if rule == RAMP:
                    left[j, i] = max(0.0, 1.0 - j / self.brake_steps)
                elif rule == FEEDBACK:
                    left[j, i] = 0.0
                elif rule != HOLD:
                    left[j, i] = float(rule[min(j, len(rule)) - 1])
        return left

    def plan_matrix(self) -> Array:
        """S with `plan = S @ free`, plan (horizon·m) and free (free_steps·m) stacked step by step. Shape (N·m, F·m).

        What `feedback` adds to it is not known before.
        """
        m, F, left = self.action_dim, self.free_steps, self.stop_profile()
        S = np.zeros((self.horizon * m, F * m))
        for k in range(self.horizon):
            for i in range(m):
                S[k * m + i, min(k, F - 1) * m + i] = 1.0 if k < F else left[k - F + 1, i]
        return S

    def stop_by_feedback(self, planned: Array, state: Array, before: Array) -> Array:
        """A plan's rows while it brakes (..., m), with what `feedback` makes of the measured state (..., n), in bounds
        and slew after the input `before` (..., m)."""
        if not self.feedback:
            return planned
        wanted = np.where(self.stops_by_feedback, state @ np.asarray(self.feedback).T, planned)
        slew = np.asarray(self.action_slew)
        low, high = np.maximum(self.low(), before - slew), np.minimum(self.high(), before + slew)
        return np.asarray(np.clip(wanted, low, high))

    def is_standing(self, state: Array) -> bool:
        """Is no measured speed more than counts as stopped?"""
        return bool((np.abs(state[list(self.regressor)]) <= self.stopped).all())

    def is_stopping(self, inputs: Array, state: Array, before: Array) -> bool:
        """Are these the inputs (m,) of a stop, given in that measured state (n,) after the input `before` (m,)?"""
        if not self.feedback:
            return bool(self.is_stop_input(inputs))
        near = INPUT_TOLERANCE * (self.high() - self.low())
        off = np.abs(inputs - self.stop_by_feedback(np.where(self.zero_at_rest, 0.0, inputs), state, before))
        return self.is_standing(state) and bool((off <= near).all())

    def may_be_standing(self, inputs: Array) -> bool:
        """May a robot that stands have been given these inputs (m,)? By feedback it is given what its residual speed
        makes of it."""
        if not self.feedback:
            return bool(self.is_stop_input(inputs))
        gains = np.abs(np.asarray(self.feedback))[:, list(self.regressor)]
        most = INPUT_TOLERANCE * (self.high() - self.low())
        most += np.where(self.stops_by_feedback, gains.sum(1) * self.stopped, 0.0)
        return bool((np.abs(inputs) <= most)[self.zero_at_rest].all())

    @cached_property
    def description(self) -> dict[str, Any]:
        """What its file says, as JSON would hold it (`brakeline.messaging.robot_description`); of a late robot: the
        one that waits."""
        from brakeline.messaging.robot_description import describe

        return describe(self.in_lockstep())

    def layout(self) -> str:
        """Hash of everything that two processes must share to understand each other's vectors."""
        shared = {name: value for name, value in self.description.items() if name != "accept_bound"}
        words = json.dumps([shared, self.late])  # the order of names is part of it
        return hashlib.sha256(words.encode()).hexdigest()[:16]

    def accepts_layout(self, layout: object) -> bool:
        """Is it this robot's layout, or the one it had before robots were files?"""
        return layout == self.layout() or layout == FORMER_LAYOUTS.get(self.name)


# Of what was recorded, certified and trained before robots were files.
FORMER_LAYOUTS = {
    "ground": "746231dcb2e4fad7",
    "ground-late": "d013241bb63d32ac",
    "quadrotor": "82b53a84411b2bee",
    "quadrotor-late": "296e1f047a7fcc62",
}


def shipped_robots() -> tuple[str, ...]:
    """The names of the robots that come with the program."""
    return tuple(sorted(path.stem for path in ROBOTS_FOLDER.glob("*.toml") if "." not in path.stem))


def robot_named(name: str) -> Robot:
    """Read the robot of a name or at a path.

    Args:
        name: the name of a shipped robot, or the path of a description (.toml). With the suffix `-late`, the robot is
            returned in real time. A task's name after the robot's (`ground+tracks`) does not change the robot.

    Raises:
        UnknownRobot: with the names there are, or every mistake in the file.
    """
    from brakeline.messaging.robot_description import read

    base = name.removesuffix(REAL_TIME_SUFFIX)
    if base.endswith(".toml"):
        robot = refuse_shipped_name(read(Path(base)))
    else:
        base = base.partition(TASK_SEPARATOR)[0]
        if base not in shipped_robots():
            raise UnknownRobot(
                f"no robot is called {name!r}; choose one of {', '.join(shipped_robots())}, or give the path of a "
                "description (.toml)"
            )
        robot = read(ROBOTS_FOLDER / f"{base}.toml")
    return robot.in_real_time() if name.endswith(REAL_TIME_SUFFIX) else robot


def refuse_shipped_name(robot: Robot) -> Robot:
    """Return the robot, unless it takes the name of a robot that comes with the program and differs from it.

    Raises:
        UnknownRobot: it does.
    """
    name = robot.in_lockstep().name
    if name in shipped_robots() and robot.description != robot_named(name).description:
        raise UnknownRobot(f"{name} is the name of a robot that comes with the program: choose another")
    return robot
