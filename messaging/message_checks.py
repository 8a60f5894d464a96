"""Check times, names and sizes in messages from other processes and from logs, before any other code uses them."""

from __future__ import annotations

import re
from functools import cache, lru_cache
from typing import Any, NamedTuple

from google.protobuf.descriptor import Descriptor

from brakeline.errors import Implausible

NAME = re.compile(r"[A-Za-z0-9_.-]{1,100}")  # a name that can be part of a key
NAME_FIELDS = ("robot", "actor", "process", "source")  # fields with such a name; they may be empty
MAX_WALL_TIME = 2**62  # [ns since the Unix epoch]
MAX_VALUE = 1e9  # of a robot's time [s], and of the numbers of a step
MAX_OBSTACLES = 1000  # in one message
MAX_NUMBERS = 10_000  # in one repeated field
MAX_ENTRIES = 2048  # in one map, or in one field with messages: a learner permits so many actors
STEP_NUMBERS = ("reward", "penalty", "speed")  # the numbers of a step that statistics add up


class _CheckedFields(NamedTuple):
    header: bool
    names: tuple[str, ...]
    sizes: tuple[tuple[str, int], ...]  # repeated field, largest size; the smallest ones first
    numbers: tuple[str, ...]
    request: bool


@cache
def _checked_fields(kind: Descriptor) -> _CheckedFields:
    fields = kind.fields_by_name
    names = tuple(name for name in NAME_FIELDS if name in fields and fields[name].type == fields[name].TYPE_STRING)
    repeated = [field for field in fields.values() if field.is_repeated]
    sizes = [(field.name, MAX_NUMBERS if field.message_type is None else MAX_ENTRIES) for field in repeated]
    if "obstacles" in fields:
        sizes.append(("obstacles", MAX_OBSTACLES))
    sizes.sort(key=lambda one: one[1])
    numbers = STEP_NUMBERS if "reward" in fields else ()
    return _CheckedFields("header" in fields, names, tuple(sizes), numbers, "request" in fields)


def check(message: Any, size: int) -> None:
    """Check a message.

    Args:
        size: of its payload [bytes]. A number takes at least one byte, an obstacle or an entry two.

    Raises:
        Implausible: a time, a name or a size is out of bounds; the error names the field.
    """
    fields = _checked_fields(message.DESCRIPTOR)
    if fields.header:
        header = message.header
        if not 0 <= header.wall_time < MAX_WALL_TIME:
            raise Implausible(f"wall_time {header.wall_time} ns")
        if not abs(header.time) < MAX_VALUE:  # NaN fails too
            raise Implausible(f"time {header.time} s")
        _check_name(header, "source")
    for name in fields.names:
        _check_name(message, name)
    for name, most in fields.sizes:
        if size <= most:  # too small for this field, and for the following ones, to be too large
            break
        if (count := len(getattr(message, name))) > most:
            raise Implausible(f"{count} {name}")
    for name in fields.numbers:
        if not abs(value := getattr(message, name)) < MAX_VALUE:
            raise Implausible(f"{name} {value}")
    if fields.request:
        check(message.request, size)


def _check_name(message: Any, field: str) -> None:
    if (value := getattr(message, field)) and not _is_name(value):
        raise Implausible(f"{field} {value[:100]!r}")


@lru_cache(4096)
def _is_name(value: str) -> bool:
    return NAME.fullmatch(value) is not None
