"""Generate inputs for recording: random driving that covers all states, then plans like the filter's, then standing.

Restless driving also jumps between bounds, as exploring and adversarial policies do, and cruises at a bound, as trained
policies do.
"""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np

from brakeline.messaging.robot import Array, Robot

MOST_LEAD = 4  # largest number of random targets before a plan
MOST_HELD = 3  # periods for which a target is held, in addition to the periods until the robot reaches it
SHORT_STOP, LONG_STOP = 2, 15  # periods of standing after a plan
LONG_STOPS = 0.1  # share of long stops
RESTLESS = 0.3  # share of lead-ins that jump between bounds every period, as exploring and adversarial policies do
JUMPS = 2.0 / 3.0  # probability of a jump in each period of restless inputs
HASTE = 0.5  # share of targets that the robot leaves before it reaches them, as learning policies do
CRUISES, LONGEST_CRUISE = 0.5, 30  # share of restless manoeuvres that begin with a cruise; its most periods at speed
EXTREMES = 0.45  # share of inputs at a bound or zero: a uniform draw would have too few


def random_target(robot: Robot, rng: np.random.Generator) -> Array:
    """Draw an input (m,) within bounds; each coordinate is often at a bound or zero."""
    low, high = robot.low(), robot.high()
    drawn = rng.uniform(low, high)
    edge = np.stack([low, high, np.clip(0.0, low, high)])[rng.integers(3, size=len(low)), np.arange(len(low))]
    return np.where(rng.random(len(low)) < EXTREMES, edge, drawn)


def limit_slew(robot: Robot, before: Array, target: Array) -> Array:
    """Return the input (m,) closest to `target` that the slew limits allow after `before`."""
    slew = np.asarray(robot.action_slew)
    return np.asarray(np.clip(target, before - slew, before + slew))


def excitation(
    robot: Robot, rng: np.random.Generator, held: int = MOST_HELD, before: Array | None = None
) -> Generator[Array, Array | None, None]:
    """Yield inputs (m,) without end, in manoeuvres that follow each other.

    For a robot that stops by feedback, send the measured state (n,) after each period: `u = inputs.send(state)`.

    Args:
        held: largest number of periods for which a target is held. A robot that needs long to reach its top speed
            needs more; some lead-ins then jump between bounds.
        before: input in force (m,); zero by default.

    Raises:
        ValueError: no state was sent for a robot that stops by feedback.
    """
    before = np.zeros(robot.action_dim) if before is None else before
    while True:
        before = yield from manoeuvre(robot, rng, before, held)


def restless_excitation(robot: Robot, rng: np.random.Generator) -> Generator[Array, Array | None, None]:
    """Yield inputs (m,) without end, as `excitation` does; each manoeuvre begins with restless inputs or a cruise.

    Some restless inputs start at full speed: all inputs at a bound together, such as turning or climbing at speed.
    """
    before, lead = np.zeros(robot.action_dim), MOST_HELD + _across(robot)
    while True:
        if rng.random() < CRUISES:
            before, state = yield from _cruise(robot, rng, before)
            before = yield from manoeuvre(robot, rng, before, state=state)
            continue
        state = None
        first = int(rng.integers(lead + 1))
        target = _bounds(robot, rng)
        for period in range(first + int(rng.integers(2 * robot.horizon + 1))):
            if period >= first and rng.random() < JUMPS:
                target = _bounds(robot, rng)
            before = limit_slew(robot, before, target)
            state = yield before
        before = yield from manoeuvre(robot, rng, before, state=state)


def _cruise(
    robot: Robot, rng: np.random.Generator, before: Array
) -> Generator[Array, Array | None, tuple[Array, Array | None]]:
    """Yield inputs with one coordinate at a bound and new targets for the others; return the last input and state."""
    held, bound = rng.integers(robot.action_dim), _bounds(robot, rng)
    low, high = robot.low(), robot.high()
    bound = np.where(-low > high, low, np.where(high > -low, high, bound))  # the larger one: zero speed is no cruise
    state: Array | None = None
    for period in range(_across(robot) + int(rng.integers(LONGEST_CRUISE)) + 1):
        if period % MOST_HELD == 0 or rng.random() < HASTE:
            target = random_target(robot, rng)
            target[held] = bound[held]
        before = limit_slew(robot, before, target)
        state = yield before
    return before, state


def _bounds(robot: Robot, rng: np.random.Generator) -> Array:
    """Draw an input (m,) of which each coordinate is at a bound."""
    return np.where(rng.random(robot.action_dim) < 0.5, robot.low(), robot.high())


def _across(robot: Robot) -> int:
    """Return the periods that an input takes from bound to bound."""
    return math.ceil(float(((robot.high() - robot.low()) / np.asarray(robot.action_slew)).max()))


def manoeuvre(
    robot: Robot, rng: np.random.Generator, before: Array, held: int = MOST_HELD, state: Array | None = None
) -> Generator[Array, Array | None, Array]:
    """Yield a lead-in, a plan (free inputs, then braking) and standing; return the last input.

    A lead-in drives to several targets and may leave each early, so that every speed occurs with every acceleration.

    state: (n,) as measured after the last input, which a robot that stops by feedback needs.
    """
    if held > MOST_HELD and rng.random() < RESTLESS:
        for _ in range(rng.integers(held + 1)):
            before = limit_slew(robot, before, _bounds(robot, rng))
            state = yield before
    longest_lead = held + _across(robot)
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
    for k, planned in enumerate((robot.plan_matrix() @ np.concatenate(free)).reshape(robot.horizon, -1)):
        before = planned if k < robot.free_steps else _braked(robot, planned, state, before)
        state = yield before
    standing = np.where(robot.zero_at_rest, 0.0, before)
    longest = LONG_STOP if rng.random() < LONG_STOPS else SHORT_STOP
    for _ in range(rng.integers(longest + 1)):
        before = _braked(robot, standing, state, before)
        state = yield before
    return before


def _braked(robot: Robot, planned: Array, state: Array | None, before: Array) -> Array:
    """Return a planned braking input, corrected by the measured state if the robot stops by feedback."""
    if not robot.feedback:
        return planned
    if state is None:
        raise ValueError(f"{robot.name} stops by feedback: send the measured state after each period")
    return robot.stop_by_feedback(planned, state, before)
