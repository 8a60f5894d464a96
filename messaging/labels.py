"""The labels of a robot's coordinates and inputs: a name and an SI unit."""

from __future__ import annotations


def split_label(label: str) -> tuple[str, str]:
    """Return the name and the unit in a label.

    >>> split_label("turn rate [rad/s]")
    ('turn rate', 'rad/s')
    """
    name, _, unit = label.rpartition(" [")
    return name, unit.removesuffix("]")
