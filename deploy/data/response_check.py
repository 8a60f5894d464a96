"""Check that the robot responds to the inputs of its log: late enough, and at all.

If a command has a stamp that is too late, the model set learns the effect of another command. Its sets are wide, and
its bound holds only for driving in which commands change as in the log.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from brakeline.deploy.data.gap_free_recordings import GapFreeRecording
from brakeline.deploy.data.glitches import MOST as MOST_GLITCHES
from brakeline.deploy.data.input_response import MAX_DELAY, followed_inputs, hold_at, response_by_lag
from brakeline.deploy.data.motion_check import MAX_LAG, agreement, likely_unit, needless_conversion
from brakeline.deploy.data.sources.quantity_names import column_names, column_units
from brakeline.deploy.data.sources.source_table import Array, Series
from brakeline.deploy.data.unit_table import AS_IT_IS, UNITS, unit_option
from brakeline.errors import NoSource
from brakeline.messaging.robot import Robot

Recordings = Sequence[tuple[Series, Series, float, float]]  # of input and follower, with begin and end in s

LEAST_LEAD = 0.5  # of a period: a smaller lead of the robot over its input is the jitter of stamps
CLEARER = 1.5  # times the largest response after the input: the response before it is no chance
LEAST_RESPONSE = 0.15  # correlation of the changes of an input and its follower
ALIKE, FAR_GAIN = 0.8, 5.0  # correlation of an input with its follower, and gain, that another unit explains
UNRELATED = 0.2  # correlation with its input that no follower has, if the columns belong together
MOVED = 0.25  # of an input's range: how far a coordinate moves that does not stand
FEWEST = 200  # half periods: a shorter log shows no relation


def checked_responses(
    recordings: Sequence[GapFreeRecording], robot: Robot, delay: float, given: Mapping[str, str]
) -> list[str]:
    """Return notes on inputs to which the robot responds in the opposite direction.

    Args:
        recordings: their inputs are shifted by `delay` already.
        robot: names the coordinate that follows each input.
        delay: time in s by which the stamps of the inputs were shifted.
        given: units that `--unit` names; a column that the user takes as it is counts as right.

    Raises:
        NoSource: the robot moves before its inputs change, or whatever they are; or a column is in another unit.
    """
    states, inputs = column_names(robot)
    problems, notes = list[str](), list[str]()
    for i, follower in followed_inputs(robot):
        low, high = float(robot.low()[i]), float(robot.high()[i])
        series = [
            ((r.inputs[i][0], np.clip(r.inputs[i][1], low, high)), r.states[follower], r.begin, r.end)
            for r in recordings
        ]  # a glitch of an input is beyond its bounds
        step, responses = response_by_lag(series, robot.period)
        after = responses[len(responses) // 2 :]
        if (lead := _lead(step, responses)) >= LEAST_LEAD * robot.period:
            problems.append(
                f"{inputs[i]}: the robot moves {lead:.3g} s before this input changes, so the stamps of the input are "
                f"too late, or it is the input of another drive. Shift the stamps with --delay {delay - lead:.3g}"
            )
        elif problem := (
            _unrelated(inputs[i], states[follower], series, robot.period, MOVED * (high - low))
            or _in_another_unit(recordings, i, follower, robot, given)
        ):
            problems.append(problem)
        elif after.max() < -after.min():
            notes.append(
                f"{inputs[i]}: {states[follower]} changes in the opposite direction. If your controller does not use "
                "this sign, change it in the column"
            )
    if problems:
        raise NoSource("\n".join(problems))
    return notes


def _lead(step: float, responses: Array) -> float:
    """Return how long the strongest response is before its input [s]; 0 if it is after it, or not clear.

    A response counts in the direction in which the coordinate follows its input in all. A controller that damps the
    motion changes its input after the motion too, but in the opposite direction.
    """
    strength, now = np.sign(responses.sum()) * responses, len(responses) // 2
    best = int(strength.argmax())
    clear = strength[best] > max(LEAST_RESPONSE, CLEARER * float(strength[now:].max()))
    return step * (now - best) if clear and best < now else 0.0


def _unrelated(name: str, follower: str, series: Recordings, period: float, moved: float) -> str:
    """Return what to do if a coordinate does not follow its input; empty if it does, or if the log shows neither."""
    held, followers = _by_lag(series, period)
    if len(held) < FEWEST:
        return ""
    if np.ptp(followers[0]) < moved:
        return ""
    if np.ptp(held) == 0.0:
        return (
            f"{name} is always {held[0]:.6g}, but {follower}, which follows it, moves: the column does not hold what "
            f"the robot was sent. Name the right one with --map {shlex.quote(name)}=COLUMN"
        )
    if max(abs(agreement(held, values)[0]) for values in followers) > UNRELATED:
        return ""
    return (
        f"{follower} does not follow {name} (correlation below {UNRELATED:g}): the columns are swapped, or the input "
        f"is of another drive. Name the right one with --map {shlex.quote(name)}=COLUMN, or correct `follows` in the "
        "description"
    )


def _in_another_unit(
    recordings: Sequence[GapFreeRecording], i: int, follower: int, robot: Robot, given: Mapping[str, str]
) -> str:
    """Return what to do if a coordinate follows input i in another unit; empty if it does not, or in the same unit.

    The input may be beyond its bounds, because of its unit.
    """
    names, units = (column_names(robot)[1][i], column_names(robot)[0][follower]), column_units(robot)
    si = units[names[0]]
    if si != units[names[1]] or si not in UNITS or AS_IT_IS in map(given.get, names):
        return ""
    held, followers = _by_lag([(r.inputs[i], r.states[follower], r.begin, r.end) for r in recordings], robot.period)
    if len(held) < FEWEST:
        return ""
    held = np.clip(held, *np.quantile(held, (MOST_GLITCHES, 1.0 - MOST_GLITCHES)))
    correlation, gain = max((agreement(held, values) for values in followers), key=lambda fit: abs(fit[0]))
    if abs(correlation) < ALIKE or 1.0 / FAR_GAIN < gain < FAR_GAIN:
        return ""
    (other, wrong), times = (names, gain) if gain > 1.0 else (names[::-1], 1.0 / gain)
    if not (unit := likely_unit(times, si)):
        return ""
    if other in given:
        return needless_conversion(other, given[other], si)
    return (
        f"{wrong} looks like {unit}: it is {times:.3g} times {other}, although {names[1]} follows {names[0]}. Convert "
        f"it with {unit_option(wrong, unit)}, or take the column as it is with {unit_option(wrong, AS_IT_IS)}"
    )


def _by_lag(series: Recordings, period: float) -> tuple[Array, list[Array]]:
    """Return an input every half period (T,), and its follower (T,) after each lag."""
    step = 0.5 * period
    lags = np.arange(0.0, max(MAX_LAG, MAX_DELAY * period), step)
    times = [np.arange(begin, end - lags[-1], step) for _, _, begin, end in series]
    held = [hold_at(one[0], clock) for one, clock in zip(series, times, strict=True)]
    return np.concatenate(held), [
        np.concatenate([np.interp(clock + lag, *one[1]) for one, clock in zip(series, times, strict=True)])
        for lag in lags
    ]
