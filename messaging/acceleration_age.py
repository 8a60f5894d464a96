"""The age of the horizontal acceleration in the measured states of a flying vehicle.

An autopilot follows a setpoint with limited acceleration and jerk. How far it has come is not in its velocity and its
acceleration now. The velocity now and the acceleration a period ago say more about it (docs/method.md §13). So a state
may hold the acceleration of some time ago. Then the recorded data say so in `about`, the model set takes it over, and
each request says it too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from brakeline.errors import BadData, BadModel

ENTRY = "acceleration_age"  # in `about` of data sets and model sets
OLDEST = 1.0  # s


def acceleration_age_in(about: Mapping[str, str]) -> float:
    """Return the age [s] that data or a model set state; 0 if they state none.

    Raises:
        BadModel: it is no number of seconds from 0 to `OLDEST`.
    """
    try:
        age = float(about.get(ENTRY, "0"))
    except ValueError:
        age = -1.0
    if not 0.0 <= age <= OLDEST:  # NaN fails too
        raise BadModel(f"the age of the acceleration is {about[ENTRY]!r:.40}, not a number of seconds up to {OLDEST:g}")
    return age


def about_age(ages: Iterable[float]) -> dict[str, str]:
    """Return the entry in `about` of data whose parts have these ages [s]; none if all are 0.

    Raises:
        BadData: the ages differ.
    """
    different = sorted(set(ages))
    if len(different) > 1:
        listed = ", ".join(f"{age:g} s" for age in different)
        raise BadData(f"the states hold horizontal accelerations of different ages ({listed}): use them one by one")
    return {ENTRY: f"{different[0]:g}"} if different and different[0] else {}
