"""Compare the senses of a log's columns with its motion: a mirrored heading, an opposite sign, swapped columns.

`motion_check` compares units. A column can have the right unit, and still describe another frame or another quantity.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog, align
from brakeline.deploy.data.motion_check import (
    COHERENT,
    FEWEST_SPANS,
    UNRELATED,
    best_fit,
    contradictions,
    likely_unit,
    span_means,
    speed_fit,
    speeds_of_motion,
    world_speed_advice,
)
from brakeline.deploy.data.sources.quantity_names import Places
from brakeline.deploy.data.sources.source_table import Array
from brakeline.deploy.data.unit_table import AS_IT_IS, unit_option
from brakeline.errors import NoSource

FAR_GAIN = {False: 2.0, True: 5.0}  # of a state, of an input: farther from 1 it is another unit
BACKWARDS = 0.3  # of the usual top speed: a robot that moves so fast against its heading drives backwards
CONFIRMED = 0.8  # least correlation of a speed with the motion, if its column and those of the pose are right
NO_RELATION = 0.2  # correlation of speeds with the motion below which the pose must be of something else
MOVED = {"m/s": 0.2, "rad/s": 0.5}  # range of a speed that the motion must show
QUANTITIES = {"m/s": "speed", "rad/s": "turn rate"}


def motion_notes(
    places: Places,
    positions: list[str],
    inputs: list[str],
    heading: str,
    units: Mapping[str, str],
    given: Mapping[str, str],
) -> list[str]:
    """Return notes on speeds that the motion does not confirm.

    Raises:
        NoSource: the motion contradicts a column; the message says what to do.
    """
    try:
        log = align(places, positions, inputs, {})
    except NoSource:
        return []  # too few rows to compare; `resample` says so
    if positions and not any(np.ptp(log.columns[name]) for name in positions):
        raise NoSource(
            f"{', '.join(positions)} never change: they do not hold the robot's position. Name the right columns with "
            f"--map {shlex.quote(positions[0])}=COLUMN, or drive the robot"
        )
    problems = contradictions(log, heading, units, given) or wrong_senses(log, heading, units, given)
    if problems:
        raise NoSource("\n".join(problems))
    return _unconfirmed(log, heading, units, given)


def _unconfirmed(log: AlignedLog, heading: str, units: Mapping[str, str], given: Mapping[str, str]) -> list[str]:
    """Return notes on measured speeds that agree little with the motion, and on the turn rate if there is only one.

    Raises:
        NoSource: several speeds have no relation to the motion.
    """
    speeds, notes, fits = speeds_of_motion(log, heading), [], {}
    measured = {name: unit for name, unit in units.items() if name not in log.inputs}
    several = list(measured.values()).count("rad/s") > 1  # of wheels or joints
    for name, unit in measured.items():
        if unit in QUANTITIES and given.get(name) != AS_IT_IS and not (several and unit == "rad/s"):
            fit = fits[name] = best_fit(log, name, [s for s in speeds if s[0] == unit], False)
            if fit.gain and fit.correlation < CONFIRMED and np.ptp(span_means(log, name)) > MOVED[unit]:
                pose = ", ".join((*log.positions, heading) if heading else log.positions)
                notes.append(
                    f"{name} agrees little with the motion of {pose} (correlation {max(fit.correlation, 0.0):.2f}): "
                    "unless the robot slips that much, one of these columns is of something else"
                )
    if len(fits) > 1 and len(notes) == len(fits) and all(fit.correlation < NO_RELATION for fit in fits.values()):
        columns = [*log.positions, *([heading] if heading else [])]
        raise NoSource(
            f"{', '.join(fits)} have no relation to the motion of {', '.join(columns)}: columns of the pose are "
            f"swapped, or of something else. Name the right ones with --map {shlex.quote(columns[-1])}=COLUMN, or take "
            f"the speeds as they are with {unit_option(next(iter(fits)), AS_IT_IS)}"
        )
    return notes


def wrong_senses(log: AlignedLog, heading: str, units: Mapping[str, str], given: Mapping[str, str]) -> list[str]:
    """Return in sentences which columns the motion contradicts other than by a known unit.

    Args:
        log: its heading is not unwrapped, and not set.
        heading: name of the heading; empty for none.
        units: SI unit that each column should have.
        given: units that `--unit` names; a column that the user takes as it is counts as right.
    """
    speeds = speeds_of_motion(log, heading)
    problems = []
    for name, unit in units.items():
        if unit in QUANTITIES and name in log.columns and given.get(name) != AS_IT_IS:
            problems.append(_wrong_sense(log, name, unit, speeds) or _world_speed_problem(log, name, unit, heading))
    return [problem for problem in problems if problem]


def _wrong_sense(log: AlignedLog, name: str, unit: str, speeds: list[tuple[str, Array]]) -> str:
    """Return what to do about a column that is not the speed or turn rate that it should be; empty if it is."""
    is_input = name in log.inputs
    own, others = ([s for s in speeds if (s[0] == unit) == wanted] for wanted in (True, False))
    fit = speed_fit(log, name, own, is_input)
    quantity, as_it_is = QUANTITIES[unit], f"or take the column as it is with {unit_option(name, AS_IT_IS)}"
    if fit is not None:
        if not is_input and unit == "m/s" and _unsigned(span_means(log, name), [values for _, values in own]):
            return (
                f"{name} is positive while the robot drives backwards: it has no sign. Give it the sign of the motion "
                f"along the heading, {as_it_is}"
            )
        if 1.0 / FAR_GAIN[is_input] < fit.gain < FAR_GAIN[is_input]:
            return ""
        if is_input and (likely := likely_unit(fit.gain, unit)):
            return (
                f"{name} is {fit.gain:.3g} times the {quantity} of the positions: it may be in {likely}. Convert it "
                f"with {unit_option(name, likely)}, write it in {unit}, {as_it_is}"
            )
        return (
            f"{name} is {fit.gain:.3g} times the {quantity} of the positions, and no unit explains this. "
            f"Write {name} in {unit} and the positions in m, {as_it_is}"
        )
    if speed_fit(log, name, [(unit, -values) for _, values in own], is_input) is not None:
        if is_input:
            return ""  # its sign is the controller's
        return (
            f"{name} has the opposite sign of the {quantity} of the positions. Change the sign of the column, "
            f"{as_it_is}"
        )
    elsewhere = speed_fit(log, name, others, is_input)
    if elsewhere is None or best_fit(log, name, own, is_input).correlation > UNRELATED:
        return ""
    return (
        f"{name} follows the {QUANTITIES[elsewhere.unit]} of the positions, not their {quantity}: are two columns "
        f"swapped? Name the right one with --map {shlex.quote(name)}=COLUMN, {as_it_is}"
    )


def _world_speed_problem(log: AlignedLog, name: str, unit: str, heading: str) -> str:
    """Return what to do about a speed along x or y of a robot with a heading; empty if it is none."""
    text = world_speed_advice(log, name, heading) if unit == "m/s" else ""
    return f"{text}, or take the column as it is with {unit_option(name, AS_IT_IS)}" if text else ""


def _unsigned(means: Array, own: list[Array]) -> bool:
    """Return whether a speed is positive while the robot moves against its heading, and it moves along it only.

    Args:
        means: (n,) mean of the speed over each span.
        own: speeds of the motion of each span: along the heading, across it, and in all. Without a heading, they are
            along axes, which have no such sign.
    """
    if len(own) != 3 or not len(means) or (own[2] < 0.0).any():
        return False
    along, across = own[:2]
    back = along < -BACKWARDS * np.quantile(np.abs(along), 0.99)
    if np.abs(across).mean() > 0.3 * np.abs(along).mean() or np.count_nonzero(back) < FEWEST_SPANS:
        return False
    return bool((means[back] > 0.0).mean() > COHERENT)
