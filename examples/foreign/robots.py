"""Whose robot is whose: each has its description and its adapter in the folder of its author's environments."""

from __future__ import annotations

from importlib import import_module

from examples.foreign.adapter import Adapter

FOLDERS = {"car": "safety_gymnasium", "point": "safety_gymnasium", "racecar": "bullet_safety_gym"}


def adapter_of(robot: str) -> Adapter:
    """The adapter of a robot; the author's package must be there."""
    made: Adapter = import_module(f"examples.{FOLDERS[robot]}.adapter").adapter_of(robot)
    return made
