"""Refuse a model set whose stated bound is above the robot's limit (docs/method.md §1, §12).

A model set states the largest share of plans that leave their tubes, at 99 % confidence. A robot's description limits
this share (`accept_bound`). To use a model set above the limit, the caller must accept its bound explicitly.
Every process that loads a model set imports this module, so it imports nothing that loads slowly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from brakeline.errors import TooLoose
from brakeline.messaging.robot import Robot
from brakeline.messaging.stated_share import CONFIDENCE, UNSTATED, percent, rounded_up, valid_bound
from brakeline.safety.model.model_set import ModelSet


def stated_bound(about: Mapping[str, str]) -> float:
    """Return the largest share of plans outside their tubes that a model set states, or `UNSTATED`."""
    try:
        bound = float(about["bound_plan"])
    except (KeyError, TypeError, ValueError):
        return UNSTATED
    return valid_bound(bound)


def accepted_bound(robot: Robot, accept_bound: float | None = None) -> float:
    """Return the limit of the stated share: `accept_bound`, or by default the robot's own limit.

    Raises:
        ValueError: `accept_bound` is not above 0 and at most 1.
    """
    if accept_bound is None:
        return robot.accept_bound
    if not 0.0 < accept_bound <= 1.0:
        raise ValueError(f"--accept-bound is a share above 0 and at most 1, not {accept_bound:g}")
    return accept_bound


def check_bound(model: object, robot: Robot, accept_bound: float | None = None) -> None:
    """Check that the stated bound of a model set is within the limit for this robot.

    A rival's networks verify nothing, so they need no statement and always pass.

    Args:
        model: a model set, or a rival's networks.
        robot: the robot that the model set is for.
        accept_bound: the largest accepted share. Defaults to the robot's own limit.

    Raises:
        TooLoose: the stated share is above the limit.
        ValueError: `accept_bound` is not above 0 and at most 1.
    """
    if isinstance(model, ModelSet) and (why := refusal(robot, model.about, accept_bound)):
        raise TooLoose(f"{robot.name}: {why}")


def plans_needed(limit: float) -> int:
    """Return how many held-out plans, none of them outside its tube, bound the share by `limit`.

    With n plans the bound is about `ln(100)/n` at 99 % confidence (docs/method.md §12).
    """
    return math.ceil(math.log(1.0 - CONFIDENCE) / math.log1p(-limit))


def refusal(robot: Robot, about: Mapping[str, str], accept_bound: float | None = None) -> str:
    """Return why the filter must not use a model set on this robot, or an empty string if it may.

    Args:
        robot: the robot that the model set is for.
        about: the metadata of the model set.
        accept_bound: the largest accepted share. Defaults to the robot's own limit.

    Returns:
        The stated bound, the limit and a remedy, as one message.

    Raises:
        ValueError: `accept_bound` is not above 0 and at most 1.
    """
    bound, limit = stated_bound(about), accepted_bound(robot, accept_bound)
    if bound <= limit:
        return ""
    whose = f"the limit of {robot.name}" if accept_bound is None else "what --accept-bound accepts"
    if "bound_plan" not in about:
        statement = "the model set has no statement about held-out plans, so any share may leave their tubes"
    elif bound == UNSTATED:
        statement = (
            f"the model set states no bound (bound_plan is {about['bound_plan']!r}), so any share may leave their tubes"
        )
    else:
        statement = (
            f"the model set states only that at most {percent(bound)} of plans leave their tubes (99 % confidence)"
        )
    accepted = f"{rounded_up(bound):g}"
    return (
        f"{statement}; {whose} is {percent(limit)}. {_remedy(about, limit)}. "
        f"Or accept the bound, in this command alone: --accept-bound {accepted} (in Python accept_bound={accepted}). "
        f"For every command: write accept_bound = {accepted} into the description of {robot.kind}, and run "
        "`brakeline certify --use` again"
    )


def _remedy(about: Mapping[str, str], limit: float) -> str:
    """Return the step that would bring the stated share below the limit."""
    try:
        windows, violations, minutes = (float(about[name]) for name in ("windows", "violations", "minutes"))
        more = minutes * (plans_needed(limit) / windows - 1.0)
    except (KeyError, ValueError, ZeroDivisionError):
        return "Certify it: `brakeline certify`"
    if violations or not 0.0 < more < math.inf:
        left = f"{violations:g} of {windows:g} held-out plans left their tubes"
        return f"{left}: `brakeline certify` says where, and what to do"
    return f"Record {math.ceil(more)} more minute{'s' * (more > 1.0)} like these"
