"""The keys of a topic, with the names filled in."""

from __future__ import annotations

from brakeline.messaging.message_checks import NAME
from brakeline.messaging.topics import Topic


def key_of(topic: Topic, names: dict[str, str]) -> str:
    """The topic's key without the prefix, wildcards where names are left out.

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
    """As `key_of`, where no name may be left out."""
    key = key_of(topic, names)
    if "*" in key:
        raise ValueError(f"{topic.key}: give every name, not only {', '.join(names) or 'none'}")
    return key


def own_key(key: str, who: object) -> str:
    """Where one of those that serve a question at `key` is asked by itself: its session's id comes last."""
    return f"{key}/{who}"


def names_of(topic: Topic, key: str) -> dict[str, str]:
    """The names in a key of the topic."""
    parts = zip(topic.key.split("/"), key.split("/"), strict=False)
    return {part[1:-1]: name for part, name in parts if part.startswith("{")}
