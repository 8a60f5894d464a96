"""How loose the statement of a model set may be that is used without a question (docs/method.md §1, §12).

A model set carries its statement: the largest share of plans that leave their tubes, at 99 % confidence. A robot's
description has the largest share that is used without a question (`accept_bound`); who accepts more says so.
Nothing heavy here: every process that loads a model set reads it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from brakeline.errors import TooLoose
from brakeline.messaging.robot import Robot
from brakeline.messaging.stated_share import CONFIDENCE, UNSTATED, percent, rounded_up, valid_bound
from brakeline.safety.model.model_set import ModelSet


def stated_bound(about: Mapping[str, str]) -> float:
    """The largest share of plans outside their tubes that a model set states; `UNSTATED` if it states none."""
    try:
        bound = float(about["bound_plan"])
    except (KeyError, TypeError, ValueError):
        return UNSTATED
    return valid_bound(bound)


def accepted_bound(robot: Robot, accept_bound: float | None = None) -> float:
    """The largest stated share that is used: the robot's own limit, or what is accepted explicitly.

    Raises:
        ValueError: it is no share.
    """
    if accept_bound is None:
        return robot.accept_bound
    if not 0.0 < accept_bound <= 1.0:
        raise ValueError(f"--accept-bound is a share above 0 and at most 1, not {accept_bound:g}")
    return accept_bound


def check_bound(model: object, robot: Robot, accept_bound: float | None = None) -> None:
    """See that a model set may be put to use on that robot. A rival's networks verify nothing: they need no statement.

    Raises:
        TooLoose: it states more than the robot's limit, or than is accepted; ValueError: `accept_bound` is no share.
    """
    if isinstance(model, ModelSet) and (why := refusal(robot, model.about, accept_bound)):
        raise TooLoose(f"{robot.name}: {why}")


def plans_needed(limit: float) -> int:
    """So many held-out plans, none of which leaves its tube, state that share (`ln(100)/n`, docs/method.md §12)."""
    return math.ceil(math.log(1.0 - CONFIDENCE) / math.log1p(-limit))


def refusal(robot: Robot, about: Mapping[str, str], accept_bound: float | None = None) -> str:
    """Why a model set is not used on that robot: its bound, the limit, and what to do. Empty: it is used.

    Raises:
        ValueError: `accept_bound` is no share.
    """
    bound, limit = stated_bound(about), accepted_bound(robot, accept_bound)
    if bound <= limit:
        return ""
    whose = f"the limit of {robot.name}" if accept_bound is None else "what --accept-bound accepts"
    if "bound_plan" not in about:
        said = "the model set has no statement about held-out plans, so any share may leave their tubes"
    elif bound == UNSTATED:
        said = (
            f"the model set states no bound (bound_plan is {about['bound_plan']!r}), so any share may leave their tubes"
        )
    else:
        said = f"the model set states only that at most {percent(bound)} of plans leave their tubes (99 % confidence)"
    accepted = f"{rounded_up(bound):g}"
    return (
        f"{said}; {whose} is {percent(limit)}. {_remedy(about, limit)}. Or accept the bound: --accept-bound {accepted} "
        f"(in Python accept_bound={accepted}; the limit itself is `accept_bound` in the description of {robot.kind})"
    )


def _remedy(about: Mapping[str, str], limit: float) -> str:
    """What would bring a statement below the limit."""
    try:
        windows, violations, minutes = (float(about[name]) for name in ("windows", "violations", "minutes"))
        more = minutes * (plans_needed(limit) / windows - 1.0)
    except (KeyError, ValueError, ZeroDivisionError):
        return "Certify it: `brakeline certify`"
    if violations or not 0.0 < more < math.inf:
        left = f"{violations:g} of {windows:g} held-out plans left their tubes"
        return f"{left}: `brakeline certify` says where, and what to do"
    return f"Record {math.ceil(more)} more minutes like these"
