"""Explain a decision: what the filter executed instead of the proposal and why, as a sentence and as marks to draw."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.stated_share import UNSTATED, describe_verification, percent, valid_bound

EXACT = 1e-4  # of an input's range: two inputs that differ by less are the same
LEAST = 0.02  # of an input's range: smaller changes are not described
AHEAD = math.radians(40.0)
BEHIND = math.radians(140.0)
UPRIGHT = 0.8  # vertical part of a unit vector above which a direction counts as up or down
NO_ANSWER = "no answer in time: braked along the plan verified before"  # the sentence for a step without a decision
NEARER = "verified, but nearer than the clearance margin"
ARROW = 3  # periods: an arrow ends where the input would take the robot in that time without delay


@dataclass(frozen=True)
class Explanation:
    """Why the filter changed a proposal. Lengths in m, in the world frame.

    Attributes:
        sentence: why the filter decided so.
        inputs: (name, unit, proposed value, executed value) of each input.
        proposed, executed: (d,), arrows of the inputs.
        at, normal: (d,), a point on the edge of the half-space that blocks the proposal, and the normal from the free
            side to the blocked side; empty without such a half-space.
        trust: what the verification is worth, if the sentence does not contain it.
        limited: which of the robot's own limits changed an allowed proposal; empty: none.
    """

    sentence: str
    inputs: list[tuple[str, str, float, float]]
    proposed: Array
    executed: Array
    at: Array
    normal: Array
    trust: str = ""
    limited: str = ""


def explain(robot: Robot, request: pb.Request, decision: pb.Decision) -> Explanation | None:
    """Explain a decision; None if the messages do not have the robot's dimensions.

    A proposal with NaN or infinity has an arrow of length zero.
    """
    sizes = len(request.state), len(request.action), len(decision.plan)
    edge = {len(decision.stopped.normal), len(decision.stopped.at)}
    whole = sizes == (robot.state_dim, robot.action_dim, robot.horizon * robot.action_dim)
    if not whole or edge not in ({0}, {robot.position_dim}):
        return None
    proposed, executed = np.array(request.action), np.array(decision.plan[: robot.action_dim])
    heading = 0.0 if robot.heading is None else request.state[robot.heading]
    names = [split_label(label) for label in robot.action]
    limited = ""
    if decision.kind == pb.ALLOWED:
        limited = limits_applied(robot, proposed, np.array(request.input_in_force), executed)
    said_already = decision.kind in (pb.FAILSAFE, pb.RECOVERING)
    return Explanation(
        sentence(robot, request, decision),
        [(*name, float(p), float(e)) for name, p, e in zip(names, proposed, executed, strict=True)],
        arrow(robot, heading, proposed if np.isfinite(proposed).all() else np.zeros(robot.action_dim)),
        arrow(robot, heading, executed),
        np.array(decision.stopped.at),
        np.array(decision.stopped.normal),
        "" if said_already else describe_verification(decision.verified, bound_in(decision)),
        limited,
    )


def limits_applied(robot: Robot, proposed: Array, before: Array, executed: Array) -> str:
    """Say which of the robot's limits changed a proposal that was allowed; empty if it was executed as it is.

    Args:
        robot: has the limits.
        proposed: (m,), by the policy.
        before: (m,), executed in the period before; empty if it is unknown.
        executed: (m,).

    Returns:
        e.g. "slew-limited", "clipped to its bounds", or both.
    """
    if len(proposed) != len(executed) or not np.isfinite(proposed).all():
        return ""
    tolerance = EXACT * (robot.high() - robot.low())
    if (np.abs(executed - proposed) <= tolerance).all():
        return ""
    clipped = np.clip(proposed, robot.low(), robot.high())
    outside = (np.abs(clipped - proposed) > tolerance).any()
    slewed = (np.abs(clipped - executed) > tolerance) & np.isfinite(robot.slew)
    if len(before) == len(executed):
        slewed &= np.abs(executed - before) >= robot.slew - tolerance
    words = ["clipped to its bounds"] * bool(outside) + ["slew-limited"] * bool(slewed.any())
    return ", ".join(words) or "limited by the robot"


def plan_score(decision: pb.Decision) -> float:
    """Return the score of the errors that decide about obstacles. A log from before has only that of all errors."""
    return decision.plan_score if decision.HasField("plan_score") else decision.score


def bound_in(decision: pb.Decision) -> float | None:
    """Return the bound that the model set states; None if the decision has none."""
    return valid_bound(decision.bound) if decision.HasField("bound") else None


def arrow(robot: Robot, heading: float, inputs: Array) -> Array:
    """Return where an input would take the robot in `ARROW` periods, (d,), m, world frame.

    Turning rotates the arrow by half the turn.
    """
    seconds, d = ARROW * robot.period, robot.position_dim
    vector = seconds * _moves(robot, inputs)[:d]
    if robot.heading is None:
        return vector
    turning = [
        value * (0.5 * seconds if split_label(label)[1] == "rad/s" else 0.5)
        for value, label, moves in zip(inputs, robot.action, robot.translates, strict=True)
        if not moves and split_label(label)[1] in ("rad", "rad/s")
    ]
    angle = heading + sum(turning)
    cos, sin = math.cos(angle), math.sin(angle)
    vector[:2] = cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]
    return vector


def sentence(robot: Robot, request: pb.Request, decision: pb.Decision) -> str:
    """Return e.g. "turned left: straight on, the stop would have come 3 cm too close to the cylinder ahead"."""
    why = _why(robot, request, decision)
    if decision.kind == pb.ADJUSTED:
        did, instead = change(robot, np.array(request.action), np.array(decision.plan[: robot.action_dim]))
        return f"{did}: {instead}, {why}" if why else f"{did}: {decision.reason}"
    if decision.kind == pb.FAILSAFE:
        how = _fell_back_on(decision) if decision.verified else "braked, though no plan is verified"
        return f"{how}: as proposed, {why}" if why else f"{how}: {decision.reason}"
    if decision.kind == pb.RECOVERING:
        return f"slowly backs out of where not even standing is verified: as proposed, {why or decision.reason}"
    return "as proposed"


def _fell_back_on(decision: pb.Decision) -> str:
    """Say that the robot follows the committed plan, and what the plan's verification is worth."""
    bound = bound_in(decision)
    if bound is None:
        return "braked along the plan verified before"
    worth = "no bound is stated" if bound == UNSTATED else f"at most {percent(bound)} of such plans leave their tube"
    return f"braked along the plan verified before ({worth})"


def _why(robot: Robot, request: pb.Request, decision: pb.Decision) -> str:
    """Say what the proposal would have caused; empty if the decision does not contain it."""
    if not decision.HasField("stopped") or decision.broken:
        return ""
    stopped = decision.stopped
    if any(limit.name == stopped.by for limit in robot.limits):
        return f"the limit {stopped.by} would have been passed by {-stopped.room:.2g} after {stopped.after:.1f} s"
    end = robot.horizon * robot.period
    what = "the stop" if stopped.after >= end - 1e-9 else f"it (after {stopped.after:.1f} s)"
    if stopped.by == "sight" and decision.for_clearance:
        return f"the stop could have come within {_length(stopped.room)} of the end of sight: {NEARER}"
    if stopped.by == "sight":
        return "the stop could have been beyond what is seen"
    blocker = "what is not seen" if stopped.by == "unseen" else f"the {stopped.by}"
    place = f"{blocker}{_where(robot, request, stopped)}"
    if not stopped.normal:
        return f"{place} is touched already"
    if stopped.room < 0.0:
        return f"{what} would have come {_length(-stopped.room)} too close to {place}"
    worth = f": {NEARER}" if decision.for_clearance else ", too near to move from there"
    return f"{what} would have come within {_length(stopped.room)} of {place}{worth}"


def _length(metres: float) -> str:
    if metres < 0.0095:
        return f"{1000.0 * metres:.0f} mm" if metres >= 0.0005 else "less than 1 mm"
    return f"{100.0 * metres:.0f} cm" if metres < 0.995 else f"{metres:.1f} m"


def _where(robot: Robot, request: pb.Request, stopped: pb.Stopped) -> str:
    """Return the obstacle's direction relative to the heading; without a heading, to the proposed motion."""
    normal = np.array(stopped.normal)
    if not len(normal):
        return ""
    if len(normal) == 3 and abs(normal[2]) > UPRIGHT:
        return " above" if normal[2] > 0.0 else " below"
    if robot.heading is not None:
        looks = request.state[robot.heading]
        if sum(robot.translates) == 1 and _moves(robot, np.array(request.action))[0] < 0.0:
            looks += math.pi  # the direction is relative to the driving direction
    else:
        moves = _moves(robot, np.array(request.action))
        if np.hypot(*moves[:2]) < 1e-6:
            return ""
        looks = math.atan2(moves[1], moves[0])
    angle = math.remainder(math.atan2(normal[1], normal[0]) - looks, 2.0 * math.pi)
    if abs(angle) < AHEAD:
        return " in its way" if robot.heading is None else " ahead"
    if abs(angle) > BEHIND:
        return " behind"
    return " on the left" if angle > 0.0 else " on the right"


def change(robot: Robot, proposed: Array, executed: Array) -> tuple[str, str]:
    """Return the executed action and a name for the proposal: ("turned left", "straight on")."""
    width = robot.high() - robot.low()
    difference = np.abs(executed - proposed) / np.where(width > 0.0, width, 1.0)
    most = int(difference.argmax())  # the input that changed most
    before, now = proposed[most], executed[most]
    small = LEAST * width[most]
    if difference[most] < LEAST:
        return "changed it a little", "as proposed"
    if robot.heading is not None and not robot.translates[most]:
        return f"turned {'left' if now > before else 'right'}", "straight on" if abs(before) < small else "as proposed"
    if robot.heading is None or sum(robot.translates) > 1:
        by_velocity = _describe_velocity(_moves(robot, proposed), _moves(robot, executed))
        name, unit = split_label(robot.action[most])
        return by_velocity or (f"{name} {before:.2f} became {now:.2f} {unit}".rstrip(), "as proposed")
    if before * now < 0.0:
        return ("backed off" if now < 0.0 else "went forward"), "as proposed"
    if abs(now) < small:
        return "stopped", "going on"
    return ("slowed down" if abs(now) < abs(before) else "sped up"), "as proposed"


def _moves(robot: Robot, inputs: Array) -> Array:
    """Return the inputs that translate the robot, padded to at least 2 elements."""
    vector = inputs[np.asarray(robot.translates)]
    return np.concatenate([vector, np.zeros(max(0, 2 - len(vector)))])


def _describe_velocity(before: Array, now: Array) -> tuple[str, str] | None:
    """Describe the change of a velocity vector; None if the input is none."""
    fast, slow = float(np.linalg.norm(before)), float(np.linalg.norm(now))
    if len(before) not in (2, 3) or fast < 1e-9:
        return None
    if slow < 0.05 * fast:
        return "stopped", "going on"
    if now @ before > 0.985 * fast * slow:
        return ("slowed down" if slow < fast else "sped up"), "as proposed"
    aside = now - before * float(now @ before) / fast**2
    if len(aside) == 3 and abs(aside[2]) > UPRIGHT * float(np.linalg.norm(aside)):
        return ("climbed" if aside[2] > 0.0 else "sank"), "straight on"
    left = before[0] * now[1] - before[1] * now[0] > 0.0
    return f"turned to the {'left' if left else 'right'} of the proposal", "straight on"
