"""What a message may say of times, names and sizes, whoever sent it: checked where it enters a process or is read from
a log, so that nothing behind needs to fear an infinite time or a name of a megabyte."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache
from typing import Any

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message

NAME = re.compile(r"[A-Za-z0-9_.-]{1,100}")  # of a process, a robot, an actor: a part of a key
NAMES = ("robot", "actor", "process", "source")  # the fields that hold one; empty: not said
LATEST = 2**62  # ns since the Unix epoch
LONGEST = 1e9  # s of a robot's own time
MOST_OBSTACLES = 1000  # in one message
MOST_NUMBERS = 10_000  # in one repeated field


class Implausible(ValueError):
    """No honest sender says this."""


def check(message: Message) -> None:
    """
    Raises:
        Implausible: a time, a name or a size is out of all bounds; it says which.
    """
    for part in _checks(message.DESCRIPTOR):
        part(message)


@cache
def _checks(kind: Descriptor) -> tuple[Callable[[Any], None], ...]:
    """What is to be looked at in messages of a kind."""
    fields = kind.fields_by_name
    found: list[Callable[[Any], None]] = []
    if "header" in fields:
        found.append(_check_header)
    if names := tuple(name for name in NAMES if name in fields and fields[name].type == fields[name].TYPE_STRING):
        found.append(lambda message: _check_names(message, names))
    for name, field in fields.items():
        if field.is_repeated and field.message_type is None:
            found.append(_size_check(name, MOST_NUMBERS))
    if "obstacles" in fields:
        found.append(_size_check("obstacles", MOST_OBSTACLES))
    if "reward" in fields:
        found.append(_check_figures)
    if "request" in fields:
        found.append(lambda message: check(message.request))
    return tuple(found)


def _check_header(message: Any) -> None:
    header = message.header
    if not 0 <= header.wall_time < LATEST:
        raise Implausible(f"wall_time {header.wall_time} ns")
    if not (math.isfinite(header.time) and abs(header.time) < LONGEST):
        raise Implausible(f"time {header.time} s")
    if header.source and not NAME.fullmatch(header.source):
        raise Implausible(f"source {header.source[:100]!r}")


def _check_figures(message: Any) -> None:
    """Those of a step, which are added up."""
    for value in (message.reward, message.penalty, message.speed):
        if not abs(value) < LONGEST:  # NaN fails too
            raise Implausible(f"reward {message.reward}, penalty {message.penalty}, speed {message.speed}")


def _check_names(message: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(message, name)
        if value and not NAME.fullmatch(value):
            raise Implausible(f"{name} {value[:100]!r}")


def _size_check(name: str, most: int) -> Callable[[Any], None]:
    def look(message: Any) -> None:
        if len(getattr(message, name)) > most:
            raise Implausible(f"{len(getattr(message, name))} {name}")

    return look
