"""Views: callables that read the measured state and the obstacles from an environment, for the filter."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np

from brakeline.errors import Mismatch
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import Scan

# (environment, observation, info) -> the state or the obstacles
View = Callable[[Any, Any, dict[str, Any]], Any]

CONTENTS = {
    "state": "the measured state, as the robot's description names its coordinates",
    "obstacles": "a list of brakeline.Obstacle; not needed with a `scan`",
}


def in_info(name: str) -> View:
    """Return a view of `info[name]`. The view raises Mismatch if `info` has no such entry."""

    def view(env: Any, observation: Any, info: dict[str, Any]) -> Any:
        if name not in info:
            names = ", ".join(sorted(map(str, info))) or "nothing"
            raise Mismatch(
                f"the environment's info has no {name!r} ({CONTENTS[name]}; it has: {names}): "
                f"return it in the info of `reset` and `step`, or give {name}=, a callable (env, observation, info)"
            )
        return info[name]

    return view


def _obstacles(env: Any, observation: Any, info: dict[str, Any]) -> Any:
    """Return `info["obstacles"]`, or None if there is a scan instead, which alone shows free space."""
    return None if "scan" in info and "obstacles" not in info else in_info("obstacles")(env, observation, info)


STATE, OBSTACLES = in_info("state"), _obstacles


def copied(value: Any) -> Any:
    """Return an observation or an info with copies of its arrays, lists and scans: a policy may overwrite them."""
    if isinstance(value, np.ndarray):
        whole = value.copy()
        if value.dtype.hasobject:  # such as a list of obstacles for each environment
            for place, part in np.ndenumerate(value):
                whole[place] = copied(part)
        return whole
    if isinstance(value, dict):
        return {name: copied(part) for name, part in value.items()}
    if isinstance(value, Scan | RangeImage):
        return deepcopy(value)
    if type(value) is list:
        return value.copy()  # not its parts: it may hold thousands of numbers
    return tuple(map(copied, value)) if type(value) is tuple else value
