"""Compare the columns of a log with its motion: the differences of the positions show direction, speed and turn rate.

A heading follows the direction of the motion, and a speed is the length of the way over its time. A column that does
so only in another unit (degrees, km/h) has that unit. A column that does so only without the conversion that the user
asked for was in SI units already.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog, Indices
from brakeline.deploy.data.sources.source_table import Array
from brakeline.deploy.data.stamps import FACTORS, TIME
from brakeline.deploy.data.unit_table import COMPASS, UNITS, factor, from_si, in_si, unit_option

SPAN = 0.3  # s over which motion is compared with a column: over less, noise dominates
SAME_CORRELATION = 0.9  # of two columns of the same quantity
SAME_GAIN = (0.75, 1.33)  # ratio of their standard deviations
UNRELATED = 0.5  # largest correlation with a column's own quantity, if the column holds another one
FOLLOWS_CORRELATION = 0.8  # of an input with the motion up to `MAX_LAG` later, so that its gain is its unit's
MAX_LAG = 1.0  # s
FEWEST_SPANS = 20  # fewer spans give no result
LIKE_UNIT = 0.06  # largest relative difference of a gain from a unit's: km/h and ft/s differ by 10 %
ALIKE = 1.5  # largest ratio of two gains with one cause: noise and curved paths change them a little
LEAST_TURN = 0.5  # rad: a heading that changes less shows no unit
HEADING_UNITS = ("rad", "deg", COMPASS)
COHERENT, INCOHERENT = 0.9, 0.6  # of directions and headings: the length of the mean of their differences' unit vectors
UNCONVERTED = "unconverted"  # the reading of a heading without the conversion by --unit
WORDS = {"deg": "degrees", COMPASS: "a compass heading (degrees, clockwise from y)"}


class SpeedFit(NamedTuple):
    """How well a column agrees with a speed of the motion, and how many times larger it is."""

    correlation: float
    gain: float
    unit: str  # SI unit of the speed


def contradictions(log: AlignedLog, heading: str, units: Mapping[str, str], given: Mapping[str, str]) -> list[str]:
    """Return what the motion contradicts, in sentences that say what to do.

    Args:
        log: its heading is not unwrapped, and not set.
        heading: name of the heading; empty for none.
        units: SI unit that each column should have.
        given: units from which columns were converted, as `--unit` says.
    """
    if heading and (problem := heading_problem(log, heading, given)):
        return [problem]
    speeds = speeds_of_motion(log, heading)
    gains: dict[str, SpeedFit] = {}
    for name, unit in units.items():
        if unit in ("m/s", "rad/s") and name in log.columns:
            fit = speed_fit(log, name, [s for s in speeds if s[0] == unit], name in log.inputs)
            if fit is not None:
                gains[name] = fit
    needless = [
        needless_conversion(name, given[name], fit.unit)
        for name, fit in gains.items()
        if name in given and needlessly_converted(fit, given[name])
    ]
    return needless or _explained(log, gains)


def needlessly_converted(fit: SpeedFit, given: str) -> bool:
    """Return whether a column that was converted from a unit agrees with the motion only without that."""
    return not same_gain(fit.gain) and same_gain(fit.gain / (factor(given, fit.unit) or 1.0))


def needless_conversion(name: str, given: str, si: str) -> str:
    """Return the sentence for a column that agrees with the motion only without its conversion."""
    option = unit_option(name, given)
    return f"{name} is in {si} already: only without {option} does the motion agree with it. Leave it out"


def heading_problem(log: AlignedLog, name: str, given: Mapping[str, str]) -> str:
    """Return the sentence for a heading that is not in rad, or mirrored, by the motion or else by the speeds.

    It is empty if the heading may be right.
    """
    unit, score = heading_unit(log, name, given.get(name, ""))
    if unit == "rad" and score <= SAME_CORRELATION:
        unit, score = _clear(speed_scores(log, name, given.get(name, "")))
    if unit == "rad":
        return mirrored_heading(log, name)
    if unit == UNCONVERTED:
        return needless_conversion(name, given[name], "rad")
    return (
        f"{name} looks like {WORDS[unit]}: in that unit, the motion agrees with it ({score:.0%}), in rad it does not. "
        f"Convert it with {unit_option(name, unit)}"
    )


def heading_unit(log: AlignedLog, name: str, given: str = "") -> tuple[str, float]:
    """Return the unit in which a column agrees best with the direction of motion, and how well, in [0, 1]."""
    return _clear(heading_scores(log, name, given))


def _clear(scores: Mapping[str, float]) -> tuple[str, float]:
    """Return the unit with the best score, and its score. The unit is rad, unless another one is clearly better."""
    best = max(scores, key=lambda unit: scores[unit])
    clear = scores[best] > SAME_CORRELATION and scores[best] > scores["rad"] + 0.1
    return (best, scores[best]) if clear else ("rad", scores["rad"])


def heading_scores(log: AlignedLog, name: str, given: str = "") -> dict[str, float]:
    """Return for each unit how well a column agrees with the direction of motion: the mean of |cos(direction - angle)|.

    On a straight path, a constant agrees as well as the heading does: 0 if the angle does not change. If the column was
    converted from the unit `given`, `UNCONVERTED` is the score without the conversion.
    """
    direction, middle = directions_of_motion(log)
    if not len(middle):
        return dict.fromkeys(HEADING_UNITS, 0.0)
    return {
        unit: float(np.abs(np.cos(direction - angles[middle])).mean()) if np.ptp(angles) > LEAST_TURN else 0.0
        for unit, angles in _readings(log, name, given).items()
    }


def speed_scores(log: AlignedLog, name: str, given: str = "") -> dict[str, float]:
    """Return for each unit how well speeds in the log agree with the motion along and across a heading in this unit.

    An omnidirectional robot moves in every direction, so only its speeds show the unit of its heading. The score is the
    largest correlation of another column with one of the two speeds. Speeds along x and y do not count.
    """
    others = _other_columns(log, name)
    return {unit: max(_speed_matches(log, others, angles)) for unit, angles in _readings(log, name, given).items()}


def _other_columns(log: AlignedLog, heading: str) -> list[str]:
    """Return the columns that may hold a speed along or across the heading: not the pose, nor speeds along x and y."""
    along_axes = speeds_of_motion(log, "")
    return [
        name
        for name in log.columns
        if name not in (*log.positions, heading) and speed_fit(log, name, along_axes, name in log.inputs) is None
    ]


def _speed_matches(log: AlignedLog, columns: list[str], angles: Array) -> tuple[float, float]:
    """Return the largest correlation of a column with the motion along angles (rows,) [rad], and of one across them.

    Both are 0 if the angles hardly change.
    """
    if np.ptp(angles) <= LEAST_TURN:
        return 0.0, 0.0
    along, across = (
        max((best_fit(log, name, [speed], name in log.inputs).correlation for name in columns), default=0.0)
        for speed in _along_and_across(log, angles)
    )
    return along, across


def mirrored_heading(log: AlignedLog, name: str) -> str:
    """Return what to do if a heading turns against the direction of motion; empty if it does not."""
    direction, middle = directions_of_motion(log)
    angles = log.columns[name][middle]
    if not len(angles) or np.ptp(np.unwrap(log.columns[name])) < LEAST_TURN:
        return ""
    # A robot that drives backwards moves at pi to its heading, so that only twice the angles can be compared.
    same, mirrored = (complex(np.exp(2j * (direction - sign * angles)).mean()) for sign in (1.0, -1.0))
    if abs(mirrored) >= COHERENT and abs(same) <= INCOHERENT:
        from_y = abs(abs(0.5 * math.atan2(mirrored.imag, mirrored.real)) - math.pi / 2.0) < 0.4
    else:
        as_it_is, others = log.columns[name], _other_columns(log, name)
        readings = as_it_is, -as_it_is, math.pi / 2.0 - as_it_is
        right, negated, turned = (_speed_matches(log, others, angles) for angles in readings)
        if max(negated) <= max(SAME_CORRELATION, max(right) + 0.1):
            return ""
        from_y = sum(turned) > sum(negated) + 0.1
    formula = f"pi/2 - {name}" if from_y else f"-{name}"
    repair = "swap the columns x and y" if from_y else "change the sign of y"
    return (
        f"{name} grows clockwise, but x and y show that it must grow counterclockwise from the x axis. Write {formula} "
        f"into the column, or {repair}, whichever of the two is wrong"
    )


def _readings(log: AlignedLog, name: str, given: str) -> dict[str, Array]:
    """Return a heading [rad] for each unit that its column may have, and without the conversion from `given`."""
    readings = {unit: in_si(log.columns[name], unit, "rad") for unit in HEADING_UNITS}
    if given:
        readings[UNCONVERTED] = from_si(log.columns[name], given, "rad")
    return {unit: angles for unit, angles in readings.items() if angles is not None}


def directions_of_motion(log: AlignedLog) -> tuple[Array, Indices]:
    """Return the directions in rad of the spans in which the robot moves, and the row in the middle of each span.

    Both are empty if there are too few of them.
    """
    i, j = log.spans(SPAN)
    x, y = (log.change(p, i, j) for p in log.positions[:2])
    length = np.hypot(x, y)
    far = np.flatnonzero(length > 0.3 * np.quantile(length, 0.99)) if len(length) else i
    far = far if len(far) >= FEWEST_SPANS else far[:0]
    return np.arctan2(y[far], x[far]), ((i + j) // 2)[far]


def speeds_of_motion(log: AlignedLog, heading: str) -> list[tuple[str, Array]]:
    """Return the speeds of all spans with their units: along and across the heading and around it, or along axes."""
    i, j = log.spans(SPAN)
    time = log.time[j] - log.time[i]
    axes = [log.change(p, i, j) / time for p in log.positions]
    if not heading:
        return [("m/s", speed) for speed in axes]
    angles = np.unwrap(log.columns[heading])
    return [
        *_along_and_across(log, angles),
        ("m/s", np.hypot(*axes[:2])),
        ("rad/s", (angles[j] - angles[i]) / time),
    ]


def _along_and_across(log: AlignedLog, angles: Array) -> list[tuple[str, Array]]:
    """Return the speeds of all spans along and across a heading (rows,) [rad], with their units."""
    i, j = log.spans(SPAN)
    time = log.time[j] - log.time[i]
    x, y = (log.change(p, i, j) / time for p in log.positions[:2])
    cos, sin = np.cos(angles[(i + j) // 2]), np.sin(angles[(i + j) // 2])
    return [("m/s", cos * x + sin * y), ("m/s", cos * y - sin * x)]


def speed_fit(log: AlignedLog, name: str, speeds: list[tuple[str, Array]], is_input: bool) -> SpeedFit | None:
    """Return the speed of the motion that a column agrees with best; None if it agrees with none of them."""
    best = best_fit(log, name, speeds, is_input)
    return best if best.correlation > (FOLLOWS_CORRELATION if is_input else SAME_CORRELATION) else None


def best_fit(log: AlignedLog, name: str, speeds: list[tuple[str, Array]], is_input: bool) -> SpeedFit:
    """Return the speed of the motion that correlates most with a column. The motion follows an input later."""
    means = span_means(log, name)
    lags = range(0, round(MAX_LAG / log.step) + 1, max(round(0.1 / log.step), 1)) if is_input else (0,)
    fits = [
        SpeedFit(*agreement(speed[lag:], means[:end]), unit)
        for unit, speed in speeds
        for lag in lags
        if (end := len(means) - lag) >= FEWEST_SPANS
    ]
    return max(fits, default=SpeedFit(0.0, 0.0, ""))


def world_speed_advice(log: AlignedLog, name: str, heading: str) -> str:
    """Return what to do if a column is a speed along x or y, though the robot has a heading; empty if it is not."""
    is_input = name in log.inputs
    if not heading or speed_fit(log, name, speeds_of_motion(log, ""), is_input) is None:
        return ""
    if best_fit(log, name, speeds_of_motion(log, heading)[:2], is_input).correlation > UNRELATED:
        return ""
    return (
        f"{name} is a speed along x or y, but a robot with a heading needs speeds in its own frame. Write "
        f"cos({heading}) * vx + sin({heading}) * vy (ahead) and cos({heading}) * vy - sin({heading}) * vx (to the left)"
        " into the columns, or describe the robot without a heading"
    )


def span_means(log: AlignedLog, name: str) -> Array:
    """Return the mean of a column over each span."""
    i, j = log.spans(SPAN)
    sums = np.concatenate([[0.0], np.cumsum(log.columns[name])])
    return np.asarray((sums[j + 1] - sums[i]) / (j - i + 1))


def agreement(one: Array, other: Array) -> tuple[float, float]:
    """Return the correlation of two series, and the ratio of the second's standard deviation to the first's.

    Both are 0 for too few values, or if one series is constant.
    """
    if len(one) < FEWEST_SPANS or one.min() == one.max() or other.min() == other.max():
        return 0.0, 0.0
    # Shorter than numpy.corrcoef, because `speed_fit` compares every column at every lag.
    one, other = one - one.sum() / len(one), other - other.sum() / len(other)
    size, other_size = math.sqrt(one @ one), math.sqrt(other @ other)
    if not 0.0 < size * other_size < math.inf:  # values too small or too large to be squared
        return 0.0, 0.0
    return float(one @ other) / size / other_size, other_size / size


def same_gain(gain: float) -> bool:
    """Return whether a gain is near 1."""
    return SAME_GAIN[0] < gain < SAME_GAIN[1]


def unit_like(gain: float, si: str) -> str:
    """Return the unit that explains a gain, or an empty text."""
    fits = {unit: abs(gain * scale - 1.0) for unit, scale in UNITS[si].items() if scale != 1.0}
    best = min(fits, key=lambda unit: fits[unit])
    return best if fits[best] < LIKE_UNIT and not same_gain(gain) else ""


def likely_unit(gain: float, si: str) -> str:
    """Return the only unit near the gain of an input, which a robot that slips follows by less; else an empty text."""
    near = [unit for unit, scale in UNITS[si].items() if same_gain(gain * scale)]
    return near[0] if len(near) == 1 and near[0] != si else ""


def speed_contradiction(name: str, fit: SpeedFit) -> str:
    """Return the sentence for a speed in another unit; empty if the gain is near 1 or no unit explains it."""
    unit = unit_like(fit.gain, fit.unit)
    what = "speed" if fit.unit == "m/s" else "turn rate"
    return (
        f"{name} looks like {unit}: it is {fit.gain:.3g} times the {what} of the positions in {fit.unit}. "
        f"Convert it with {unit_option(name, unit)}"
        if unit
        else ""
    )


def _explained(log: AlignedLog, gains: dict[str, SpeedFit]) -> list[str]:
    """Explain gains by the stamps, if speeds and turn rates have the same, by the positions, or by each column."""
    wrong = {name: fit for name, fit in gains.items() if not same_gain(fit.gain)}
    values = [fit.gain for fit in wrong.values()]
    alike = len(values) > 0 and max(values) < ALIKE * min(values)
    if alike and {fit.unit for fit in wrong.values()} == {"m/s", "rad/s"} and len(wrong) == len(gains):
        units = [unit for unit, scale in FACTORS.items() if abs(values[0] * scale - 1.0) < LIKE_UNIT]
        hint = (
            f"They look like {units[0]}: give the unit of the stamps with --unit {TIME}={units[0]}"
            if units
            else "No unit of time explains this: write the time in s into the column (numbers of rows are no time)"
        )
        return [
            f"the time stamps do not fit: {', '.join(wrong)} are {values[0]:.3g} times as fast as the positions move. "
            f"{hint}"
        ]
    linear = {name: fit for name, fit in gains.items() if fit.unit == "m/s"}
    if alike and wrong.keys() == linear.keys() and values[0] < 1.0:
        unit = next((u for u, scale in UNITS["m"].items() if abs(values[0] / scale - 1.0) < LIKE_UNIT), "")
        if unit:
            words = " ".join(shlex.quote(f"{name}={unit}") for name in log.positions)
            return [
                f"{', '.join(log.positions)} look like {unit}: they move {1 / values[0]:.3g} times as fast as "
                f"{', '.join(wrong)}. Convert them with --unit {words}"
            ]
    return [text for name, fit in wrong.items() if (text := speed_contradiction(name, fit))]
