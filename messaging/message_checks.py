"""Check times, names and sizes in messages from other processes and from logs, before any other code uses them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache
from typing import Any

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message

from brakeline.errors import Implausible

NAME = re.compile(r"[A-Za-z0-9_.-]{1,100}")  # a name that can be part of a key
NAME_FIELDS = ("robot", "actor", "process", "source")  # fields with such a name; they may be empty
MAX_WALL_TIME = 2**62  # [ns since the Unix epoch]
MAX_VALUE = 1e9  # of a robot's time [s], and of the numbers of a step
MAX_OBSTACLES = 1000  # in one message
MAX_NUMBERS = 10_000  # in one repeated field
STEP_NUMBERS = ("reward", "penalty", "speed")

Check = Callable[[Any], None]


def check(message: Message) -> None:
    """Check a message.

    Raises:
        Implausible: a time, a name or a size is out of bounds; the error names the field.
    """
    for part in _checks(message.DESCRIPTOR):
        part(message)


@cache
def _checks(kind: Descriptor) -> tuple[Check, ...]:
    """Return the checks for a kind of message."""
    fields = kind.fields_by_name
    checks: list[Check] = []
    if "header" in fields:
        checks.append(_check_header)
    names = [name for name in NAME_FIELDS if name in fields and fields[name].type == fields[name].TYPE_STRING]
    checks += [_name_check(name) for name in names]
    lists = {name: MAX_NUMBERS for name, field in fields.items() if field.is_repeated and field.message_type is None}
    if "obstacles" in fields:
        lists["obstacles"] = MAX_OBSTACLES
    checks += [_size_check(name, most) for name, most in lists.items()]
    if "reward" in fields:
        checks.append(_check_step_numbers)
    if "request" in fields:
        checks.append(lambda message: check(message.request))
    return tuple(checks)


def _check_header(message: Any) -> None:
    header = message.header
    if not 0 <= header.wall_time < MAX_WALL_TIME:
        raise Implausible(f"wall_time {header.wall_time} ns")
    if not (math.isfinite(header.time) and abs(header.time) < MAX_VALUE):
        raise Implausible(f"time {header.time} s")
    if header.source and not NAME.fullmatch(header.source):
        raise Implausible(f"source {header.source[:100]!r}")


def _check_step_numbers(message: Any) -> None:
    """Check the numbers of a step that statistics add up."""
    for name in STEP_NUMBERS:
        if not abs(value := getattr(message, name)) < MAX_VALUE:  # NaN fails too
            raise Implausible(f"{name} {value}")


def _name_check(name: str) -> Check:
    def check_name(message: Any) -> None:
        if (value := getattr(message, name)) and not NAME.fullmatch(value):
            raise Implausible(f"{name} {value[:100]!r}")

    return check_name


def _size_check(name: str, most: int) -> Check:
    def check_size(message: Any) -> None:
        if len(getattr(message, name)) > most:
            raise Implausible(f"{len(getattr(message, name))} {name}")

    return check_size
