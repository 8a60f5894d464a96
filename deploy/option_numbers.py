"""Check the numbers of a command's options. A message names the option and the value."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

import tyro

MOST = 1e9  # of every number but seeds, and -MOST the least: 30 years in seconds, a petabyte in MiB


def check_option_numbers(command: Any) -> None:
    """Check a command's numbers: seeds from 0 on, and those for which it states `least` or `above`, without NaN.

    No other number may be larger than `MOST`, or NaN.

    Raises:
        ValueError: a number makes no sense.
    """
    for name, least in {"seed": 0, **getattr(command, "least", {})}.items():
        value = getattr(command, name, None)
        if value is not None and not least <= value < math.inf:
            raise ValueError(f"{_option(name)} is a number from {least:g} on, not {value:g}")
    for name, above in getattr(command, "above", {}).items():
        value = getattr(command, name)
        if value is not None and not above < value < math.inf:
            raise ValueError(f"{_option(name)} is a number above {above:g}, not {value:g}")
    for name, value in _numbers(command):
        if not abs(value) <= MOST:  # NaN too
            raise ValueError(f"{_option(name)} is a number from {-MOST:g} to {MOST:g}, not {value:g}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _numbers(options: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the name and the value of each number in options, and in the options in their fields, but not of seeds."""
    hints = get_type_hints(type(options), include_extras=True)
    for item in fields(options):
        value = getattr(options, item.name)
        if is_dataclass(value):
            bare = tyro.conf.OmitArgPrefixes in getattr(hints[item.name], "__metadata__", ())
            yield from _numbers(value, prefix if bare else f"{prefix}{item.name}.")
        elif item.name not in ("seed", "seeds"):
            several = value if isinstance(value, tuple) else (value,)
            yield from ((prefix + item.name, number) for number in several if isinstance(number, int | float))
