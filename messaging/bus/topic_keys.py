"""Build the keys of topics, and read the names in keys."""

from __future__ import annotations

from functools import lru_cache

from brakeline.messaging.bus.identity import identity_of
from brakeline.messaging.message_checks import NAME
from brakeline.messaging.topics import Topic


def key_of(topic: Topic, names: dict[str, str]) -> str:
    """Return the topic's key without the prefix, with wildcards for names that are left out.

    Raises:
        ValueError: the topic's key has no such name, or a name cannot be part of a key.
    """
    for field, name in names.items():
        if f"{{{field}}}" not in topic.key and field != "source":
            raise ValueError(f"{topic.key} has no {field!r}")
        if not NAME.fullmatch(name):
            raise ValueError(f"{field}={name!r}: letters, digits, '_', '.' and '-' only")
    return topic.at(**names)


def exact_key(topic: Topic, names: dict[str, str]) -> str:
    """Return the topic's key like `key_of`, but refuse to leave out a name."""
    key = key_of(topic, names)
    if "*" in key:
        raise ValueError(f"{topic.key}: give every name, not only {', '.join(names) or 'none'}")
    return key


def own_key(key: str, session_id: object) -> str:
    """Return the key that addresses one of several services at `key`, by the id of its session."""
    return f"{key}/{session_id}"


def sender_of(topic: Topic, key: str) -> str:
    """Return the identity that answers for the samples at a key; the topic's name if its keys name no source."""
    return _sender_of(topic.name, topic.key, key)


def names_of(topic: Topic, key: str) -> dict[str, str]:
    """Return the names in a key of the topic, by field."""
    return dict(_names_of(topic.key, key))


@lru_cache(4096)
def _sender_of(topic: str, form: str, key: str) -> str:
    source = dict(_names_of(form, key)).get("source")
    return topic if source is None else identity_of(source)


@lru_cache(4096)
def _names_of(form: str, key: str) -> tuple[tuple[str, str], ...]:
    parts = zip(form.split("/"), key.split("/"), strict=False)
    return tuple((part[1:-1], name) for part, name in parts if part.startswith("{"))
