"""Name the files of robots and tasks, and read those of tasks without a check of their values.

This module imports nothing slow, because the options of commands depend on it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from brakeline.messaging.structured_text import TOML_ENCODING, parse_toml

ROBOTS_FOLDER = Path(__file__).parents[1] / "robots"
REAL_TIME_SUFFIX = "-late"  # suffix of a robot's name in real time
TASK_SEPARATOR = "+"  # between a robot's name and the name of an additional task
TASK_SUFFIX = ".task.toml"


def task_file(name: str) -> Path:
    """Return the path of the task of a robot's name or path, whether or not there is one.

    >>> task_file("ground+tracks").name, task_file("my/car.toml").name
    ('ground+tracks.task.toml', 'car.task.toml')
    """
    base = name.removesuffix(REAL_TIME_SUFFIX)
    return Path(base).with_suffix(TASK_SUFFIX) if base.endswith(".toml") else ROBOTS_FOLDER / f"{base}{TASK_SUFFIX}"


def task_values(path: Path) -> dict[str, Any]:
    """Return the values in a task's file, with those of the task that it is `like` as defaults.

    Raises:
        OSError, BadText: there is no such file, or it is not TOML.
    """
    values = parse_toml(path.read_text(TOML_ENCODING))
    base = values.pop("like", None)
    return ({} if base is None else task_values(path.with_name(f"{base}{TASK_SUFFIX}"))) | values
