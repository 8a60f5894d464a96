"""Check the names in a message against its key. The router compares only the key with the publisher's certificate."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from google.protobuf.descriptor import Descriptor

from brakeline.errors import Implausible
from brakeline.messaging.bus.identity import role_of, speaks_for
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.topics import topic_of

SOURCES = ("actor",)  # fields with the name of a process, or of a robot that it drives


def check_names(names: Mapping[str, str], message: Any) -> None:
    """Check the robot, the sources and the published keys that a message states.

    Args:
        names: `robot` and `source` in the key of the message, if the key has them.

    Raises:
        Implausible: the message speaks for another robot, or for another process.
    """
    fields = _NameFields(message.DESCRIPTOR)
    if (robot := names.get("robot")) is not None:
        for stated in fields.robots(message):
            if stated not in ("", robot):
                raise Implausible(f"says that its robot is {stated!r}")
    if (source := names.get("source")) is not None:
        for stated in fields.sources(message):
            if stated and not speaks_for(source, stated):
                raise Implausible(f"says that its source is {stated!r}")
        if fields.process and message.process not in ("", source):  # each further name would take a place in tables
            raise Implausible(f"says that its process is {message.process!r}")
        for key in message.published if fields.counts else ():
            if not _publishes(source, key):
                raise Implausible(f"says that it publishes at {key[:200]!r}")


def _publishes(source: str, key: str) -> bool:
    """Return whether a process may publish at a key: under its own names, or by its role.

    Keys without a source, and those of logged steps, which name the actor of the log, are a matter of the role.
    """
    topic = topic_of(key)
    if topic is None:
        return False
    stated = names_of(topic, key).get("source")
    if stated is not None and topic.own:
        return speaks_for(source, stated)
    try:
        return role_of(source) in topic.publishers
    except ValueError:  # without keys, a process may have any name
        return True


@cache
class _NameFields:
    """The fields of a message type, and of the request in it, that hold names."""

    def __init__(self, kind: Descriptor) -> None:
        request = kind.fields_by_name["request"].message_type if "request" in kind.fields_by_name else None
        self._robots, self._robots_within = _names_in(kind, "robot"), _names_in(request, "robot")
        self._sources, self._sources_within = _names_in(kind, *SOURCES), _names_in(request, *SOURCES)
        self._header = "header" in kind.fields_by_name
        self.counts, self.process = "published" in kind.fields_by_name, "process" in kind.fields_by_name

    def robots(self, message: Any) -> list[str]:
        return _stated(message, self._robots, self._robots_within)

    def sources(self, message: Any) -> list[str]:
        stated = _stated(message, self._sources, self._sources_within)
        return [message.header.source, *stated] if self._header else stated


def _names_in(kind: Descriptor | None, *names: str) -> tuple[str, ...]:
    return () if kind is None else tuple(name for name in names if name in kind.fields_by_name)


def _stated(message: Any, names: tuple[str, ...], within: tuple[str, ...]) -> list[str]:
    """Return the values of fields of a message, and of fields of the request in it."""
    values = [getattr(message, name) for name in names]
    if within:
        request = message.request
        values += [getattr(request, name) for name in within]
    return values
