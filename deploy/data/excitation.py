"""Which inputs to record: every state the robot can be in, then plans as the filter makes them, then standing still."""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot

Array = NDArray[np.float64]

MOST_LEAD = 4  # random targets before a plan, each held for up to
MOST_HELD = 3  # periods, and as many more as it takes to get there
SHORT_STOP, LONG_STOP = 2, 15  # periods of standing still after a plan, mostly short
LONG_STOPS = 0.1  # share of long stops
RESTLESS = 0.3  # share of lead-ins from bound to bound every period: so drives who explores, or means harm
HASTE = 0.5  # share of targets that are left as soon as by a robot without a slew: learners change their mind a lot
EXTREMES = 0.45  # share of inputs that are at a bound or zero: driving has more of them than a uniform draw


def random_target(robot: Robot, rng: np.random.Generator) -> Array:
    """An input within bounds; each coordinate often at a bound or zero."""
    low, high = robot.low(), robot.high()
    drawn = rng.uniform(low, high)
    edge = np.stack([low, high, np.clip(0.0, low, high)])[rng.integers(3, size=len(low)), np.arange(len(low))]
    return np.where(rng.random(len(low)) < EXTREMES, edge, drawn)


def limit_slew(robot: Robot, before: Array, target: Array) -> Array:
    """The input nearest to a target that the slew allows after `before`."""
    slew = np.asarray(robot.action_slew)
    return np.asarray(np.clip(target, before - slew, before + slew))


def excitation(
    robot: Robot, rng: np.random.Generator, held: int = MOST_HELD, before: Array | None = None
) -> Generator[Array, Array | None, None]:
    """Inputs without end: lead-in, plan (chosen inputs, then braking), stop, and again.

    A lead-in goes for one target after the other, and may leave each before it gets there: every speed comes with
    every acceleration. `held`: periods that a target is held for at most, more of them where a robot needs longer to
    come to its speed; then some lead-ins are restless. To a robot that stops by feedback the measured state (n,) is
    sent after each period, `u = inputs.send(state)`: its braking follows from it. before (m,): the input in force;
    none, unless given.
    """
    before = np.zeros(robot.action_dim) if before is None else before
    schedule = robot.plan_matrix()
    across = (robot.high() - robot.low()) / np.asarray(robot.action_slew)  # periods from bound to bound
    longest_lead = held + math.ceil(across.max())
    state: Array | None = None
    while True:
        if held > MOST_HELD and rng.random() < RESTLESS:
            for _ in range(rng.integers(held + 1)):
                before = limit_slew(
                    robot, before, np.where(rng.random(robot.action_dim) < 0.5, robot.low(), robot.high())
                )
                state = yield before
        for _ in range(rng.integers(MOST_LEAD + 1)):
            target = random_target(robot, rng)
            hasty = longest_lead > MOST_HELD and rng.random() < HASTE
            for _ in range(rng.integers(1, (MOST_HELD if hasty else longest_lead) + 1)):
                before = limit_slew(robot, before, target)
                state = yield before
        free = []
        for _ in range(robot.free_steps):
            before = limit_slew(robot, before, random_target(robot, rng))
            free.append(before)
        for k, planned in enumerate((schedule @ np.concatenate(free)).reshape(robot.horizon, -1)):
            before = planned if k < robot.free_steps else _braked(robot, planned, state, before)
            state = yield before
        standing = np.where(robot.zero_at_rest, 0.0, before)
        longest = LONG_STOP if rng.random() < LONG_STOPS else SHORT_STOP
        for _ in range(rng.integers(longest + 1)):
            before = _braked(robot, standing, state, before)
            state = yield before


def _braked(robot: Robot, planned: Array, state: Array | None, before: Array) -> Array:
    """A planned input while it brakes, by feedback from the measured state where there is one."""
    if not robot.feedback:
        return planned
    if state is None:
        raise ValueError(f"{robot.name} stops by feedback: send the measured state after each period")
    return robot.stop_by_feedback(planned, state, before)
