"""What a filter is told of an environment's moment: the measured state and the obstacles, read by callables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from brakeline.safety.action_mapping import Mismatch

# (environment, observation, info) -> what is wanted
View = Callable[[Any, Any, dict[str, Any]], Any]

WANTED = {
    "state": "the measured state, as the robot's description names its coordinates",
    "obstacles": "a list of messaging.shapes.Obstacle; none are needed beside a `scan`",
}


def in_info(name: str) -> View:
    """Reads `info[name]`.

    Raises (when called):
        Mismatch: there is no such thing, and what to give instead.
    """

    def view(env: Any, observation: Any, info: dict[str, Any]) -> Any:
        if name not in info:
            there = ", ".join(sorted(map(str, info))) or "nothing"
            raise Mismatch(
                f"the environment's info has no {name!r} ({WANTED[name]}; it has: {there}): "
                f"give {name}=, a callable (env, observation, info)"
            )
        return info[name]

    return view


def _obstacles(env: Any, observation: Any, info: dict[str, Any]) -> Any:
    """`info["obstacles"]`; None beside a scan, if there are none: only the scan says what is free."""
    return None if "scan" in info and "obstacles" not in info else in_info("obstacles")(env, observation, info)


STATE, OBSTACLES = in_info("state"), _obstacles
