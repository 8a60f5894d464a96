"""The units that a log may use, and the options `--unit NAME=UNIT` that name them."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import NoSource

# For each SI unit: other units and their factor.
UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254},
    "rad": {"rad": 1.0, "deg": math.radians(1.0), "rev": 2.0 * math.pi},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600, "ft/s": 0.3048},
    "rad/s": {"rad/s": 1.0, "deg/s": math.radians(1.0), "mrad/s": 1e-3, "rpm": math.pi / 30.0},
    "m/s2": {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "cm/s2": 1e-2, "mm/s2": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
}
NAMES = {
    **{
        "°": "deg",
        "degree": "deg",
        "degrees": "deg",
        "radian": "rad",
        "radians": "rad",
        "°/s": "deg/s",
        "dps": "deg/s",
    },
    **{"rad*s^-1": "rad/s", "rad s^-1": "rad/s", "kmh": "km/h", "kph": "km/h", "mps": "m/s", "m s^-1": "m/s"},
    **{"knots": "kn", "m/s^2": "m/s2", "m/s²": "m/s2", "m s^-2": "m/s2", "m s-2": "m/s2", "µs": "us", "μs": "us"},
    **{"usec": "us", "nsec": "ns", "msec": "ms", "sec": "s", "secs": "s", "seconds": "s", "meter": "m", "meters": "m"},
    **{"metre": "m", "metres": "m", "minutes": "min", "mins": "min", "hours": "h", "hour": "h", "hrs": "h"},
}
COMPASS = "compass"  # a heading in degrees, clockwise from north
AS_IT_IS = "1"  # a column that is not converted
WITH_UNIT = re.compile(r"(.+?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]")


def factor(unit: str, si: str = "") -> float | None:
    """Return the factor to SI of a unit (of the quantity whose SI unit is `si`, if given); None if it is unknown."""
    unit = NAMES.get(unit.lower(), unit)
    known = [UNITS[si]] if si in UNITS else [] if si else [*UNITS.values()]
    return next((units[name] for units in known for name in (unit, unit.lower()) if name in units), None)


def in_si(values: NDArray[np.float64], unit: str, si: str) -> NDArray[np.float64] | None:
    """Return values in the SI unit `si`; None if `unit` is of another quantity.

    >>> in_si(np.array([90.0]), "compass", "rad")  # degrees clockwise from north (y)
    array([0.])
    """
    if unit == COMPASS and si == "rad":
        return np.asarray(np.radians(90.0 - values))
    scale = factor(unit, si)
    return None if scale is None else values * scale


def from_si(values: NDArray[np.float64], unit: str, si: str) -> NDArray[np.float64]:
    """Return values in the SI unit `si` in another unit of the same quantity: the inverse of `in_si`.

    >>> from_si(np.array([0.0]), "compass", "rad")
    array([90.])
    """
    if unit == COMPASS:
        return np.asarray(90.0 - np.degrees(values))
    return values / (factor(unit, si) or 1.0)


def si_of(unit: str) -> str:
    """Return the SI unit of a unit's quantity; empty for `1`."""
    unit = NAMES.get(unit.lower(), unit)
    return next((si for si, units in UNITS.items() if unit in units), "rad" if unit == COMPASS else "")


def split_header(name: str) -> tuple[str, str]:
    """Split a header `NAME [UNIT]` or `NAME (UNIT)` into name and unit; the unit is empty if it is not known."""
    match = WITH_UNIT.fullmatch(name.strip())
    if match and factor(match[2]) is not None:
        return match[1], NAMES.get(match[2].lower(), match[2])
    return name.strip(), ""


def unknown_unit(name: str) -> str:
    """Return what a header `NAME [UNIT]` or `NAME (UNIT)` has in place of a known unit; empty if there is nothing."""
    match = WITH_UNIT.fullmatch(name.strip())
    return match[2] if match and factor(match[2]) is None else ""


def unit_option(name: str, unit: str) -> str:
    """Return the option that converts a column from a unit, as a shell takes it.

    >>> unit_option("turn rate", "rpm")
    "--unit 'turn rate=rpm'"
    """
    return f"--unit {shlex.quote(f'{name}={unit}')}"


def chosen_units(words: Iterable[str]) -> dict[str, str]:
    """Parse `--unit` options to {name: unit}.

    Raises:
        NoSource: an option is malformed, or its unit is unknown.
    """
    chosen: dict[str, str] = {}
    for word in words:
        name, _, unit = word.rpartition("=")
        if not name or (factor(unit) is None and unit not in (AS_IT_IS, COMPASS)):
            units = ", ".join((*(one for kind in UNITS.values() for one in kind), COMPASS))
            raise NoSource(f"--unit {word!r} must be NAME=UNIT, where UNIT is one of {units}")
        unit = NAMES.get(unit.lower(), unit)
        if chosen.setdefault(name, unit) != unit:
            raise NoSource(f"--unit names {name!r} twice: {chosen[name]} and {unit}")
    return chosen
