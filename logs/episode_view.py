"""What is told of one episode: its picture from above, and its steps row by row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from brakeline.logs.decision_explanation import bound_in, explain, fell_back, fits
from brakeline.logs.episode_stats import KINDS, Figures
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import map_for_display, reserved_boxes

MOST_TUBES = 40  # of a picture
CORNERS, HITS = 48, 90  # of the outline of free space, and beams that hit, in a picture of a step
NEAR = 8  # steps before and after the closest approach whose tubes are drawn

# Of decisions, one for each step: none, a(l)lowed, a(d)justed, f(a)ilsafe, r(e)covering.
LETTERS: dict[int, str] = {int(pb.UNKNOWN): "n", **{kind: name[1] for kind, name in KINDS.items()}}
STEPPED_IN = (pb.ADJUSTED, pb.FAILSAFE, pb.RECOVERING)


class Seen(Protocol):
    """An episode as far as it was seen; it has at least one step."""

    number: int
    about: pb.Episode | None
    steps: list[pb.Step]
    closest: float
    failsafes: int

    @property
    def actor(self) -> str: ...

    def exchanges(self) -> dict[int, pb.Exchange]: ...

    def beside(self) -> dict[int, list[pb.Exchange]]: ...

    def outcome(self) -> str: ...


def picture(seen: Seen, robot: Robot | None) -> Figures:
    """What a drawing needs: arena, path in m (rounded to mm), decisions by letter, some tubes; x and y only."""
    first, steps, about, exchanges = seen.steps[0], seen.steps, seen.about, seen.exchanges()
    closest = min(range(len(steps)), key=lambda k: steps[k].clearance)
    return {
        "actor": seen.actor,
        "robot": first.robot,
        "episode": seen.number,
        **_arena(about, exchanges),
        "footprint": robot.footprint if robot is not None else 0.0,
        "discs": discs(robot) if robot is not None else [],
        "outcome": seen.outcome(),
        "steps": len(steps),
        "first": first.step,
        "reward": math.fsum(step.reward for step in steps),
        "interventions": sum(step.fallback or step.decision in STEPPED_IN for step in steps),
        "failsafes": seen.failsafes,
        "closest": seen.closest if math.isfinite(seen.closest) else None,
        "closest_at": closest,
        "kinds": "".join("a" if step.fallback else LETTERS.get(step.decision, "n") for step in steps),
        "x": _rounded(step.state[0] if step.state else 0.0 for step in steps),
        "y": _rounded(step.state[1] if len(step.state) > 1 else 0.0 for step in steps),
        "heading": _headings(steps, robot),
        "clearance": _rounded(step.clearance for step in steps),
        "speed": _rounded(step.speed for step in steps),
        "tubes": _tubes(seen, exchanges, closest, robot),
    }


def discs(robot: Robot) -> list[list[float]]:
    """x and y in the robot's frame, and the radius, of each disc of its body, m."""
    return [[*disc.at[:2], disc.radius] for disc in robot.body]


def rows(seen: Seen, robot: Robot | None) -> Iterable[Figures]:
    """One row for each step of the episode."""
    exchanges = seen.exchanges()
    for step in seen.steps:
        exchange = exchanges.get(step.step)
        decision = exchange.reply.decision if exchange is not None else None
        why = fell_back() if step.fallback else _said(exchange, robot)
        yield {
            "actor": seen.actor,
            "episode": seen.number,
            "step": step.step,
            "time": step.header.time,
            "state": list(step.state),
            "proposed": list(step.proposed),
            "action": list(step.action),
            "decision": "no decision" if step.fallback else KINDS.get(step.decision),
            "reason": decision.reason if decision is not None else None,
            "said": why,
            "margin": decision.margin if decision is not None and decision.tube_center else None,
            "at_least": decision.at_least if decision is not None else False,
            "verified": decision.verified if decision is not None else None,
            "bound": bound_in(decision) if decision is not None else None,
            "decide_ms": decision.time_ms if decision is not None else None,
            "round_trip_ms": exchange.round_trip_ms if exchange is not None else None,
            "iterations": decision.iterations if decision is not None else None,
            "clearance": step.clearance,
            "speed": step.speed,
            "reward": step.reward,
            "penalty": step.penalty,
            "weights_version": step.weights_version,
            "end": seen.outcome() if step is seen.steps[-1] else "",
        }


def _arena(about: pb.Episode | None, exchanges: Mapping[int, pb.Exchange]) -> Figures:
    """Arena, goal and obstacles; of an episode whose beginning is in no file, the obstacles that questions told of."""
    if about is None:
        told = (item for exchange in exchanges.values() for item in exchange.request.obstacles)
        found = {item.SerializeToString(deterministic=True): item for item in told}
        obstacles = [_obstacle(item) for item in found.values()]
        return {"arena": None, "goal": None, "goal_radius": None, "start": None, "obstacles": obstacles}
    return {
        "arena": about.arena,
        "goal": _rounded(about.goal[:2]) if len(about.goal) > 1 else None,
        "goal_radius": about.goal_radius,
        "start": _rounded(about.start[:2]) if len(about.start) > 1 else None,
        "obstacles": [_obstacle(item) for item in about.obstacles],
    }


def _said(exchange: pb.Exchange | None, robot: Robot | None) -> str:
    """Why it was not as proposed; empty if it was, or nobody knows."""
    if exchange is None or robot is None or exchange.reply.decision.kind not in STEPPED_IN:
        return ""
    request, decision = exchange.request, exchange.reply.decision
    return explain(robot, request, decision).said if fits(robot, request, decision) else ""


def _tubes(seen: Seen, exchanges: Mapping[int, pb.Exchange], closest: int, robot: Robot | None) -> dict[int, Figures]:
    """By place in the picture: those about the closest approach, then those of the nearest interventions."""
    steps, beside = seen.steps, seen.beside()
    near = [k for k in range(len(steps)) if abs(k - closest) <= NEAR]
    others = [k for k, step in enumerate(steps) if step.decision in STEPPED_IN and k not in near]
    others.sort(key=lambda k: steps[k].clearance)
    found: dict[int, Figures] = {}
    for k in sorted(near + others[: MOST_TUBES - len(near)]):
        exchange = exchanges.get(steps[k].step)
        tube = None if exchange is None else _tube(exchange.request, exchange.reply.decision)
        if exchange is not None and tube is not None:
            found[k] = tube | _explained(exchange, robot) | _told(exchange, beside.get(steps[k].step, ()), robot)
    return found


def _tube(request: pb.Request, decision: pb.Decision) -> Figures | None:
    """Where the robot was when it asked, and a box for each step of its plan: x, y of the centre, half-widths."""
    inputs = len(request.action)
    horizon = len(decision.plan) // max(1, inputs)
    dim = len(decision.tube_center) // max(1, horizon)
    if dim < 2:
        return None
    centers, widths = decision.tube_center[:], decision.tube_half_width[:]
    starts = range(0, horizon * dim, dim)
    return {
        "from": _rounded(request.state[:2]),
        "boxes": [_rounded((*centers[i : i + 2], *widths[i : i + 2])) for i in starts],
        "proposed": _rounded(request.action),
        "plan": _rounded(decision.plan[:inputs]),
        "margin": _rounded([decision.margin])[0],
        "at_least": decision.at_least,
        "reason": decision.reason,
    }


def _explained(exchange: pb.Exchange, robot: Robot | None) -> Figures:
    """The sentence; inputs with names and units; arrows; the edge of what stopped the proposal. Nothing where the robot
    is not known, or the log holds what does not fit it."""
    request, decision = exchange.request, exchange.reply.decision
    if robot is None or not fits(robot, request, decision):
        return {}
    about = explain(robot, request, decision)
    return {
        "said": about.said,
        "trust": about.trust,
        "inputs": [[name, unit, *_rounded((proposed, executed))] for name, unit, proposed, executed in about.inputs],
        "arrows": [_rounded(about.proposed[:2]), _rounded(about.executed[:2])],
        "edge": [*_rounded(about.at[:2]), *_rounded(about.normal[:2])] if len(about.at) else None,
    }


def _told(exchange: pb.Exchange, beside: Iterable[pb.Exchange], robot: Robot | None) -> Figures:
    """What the filter was told of the surroundings, of which there is any; and where others promised to be."""
    if robot is None:
        return {}
    try:
        around = map_for_display(robot, exchange.request, CORNERS).flat(HITS)
    except ValueError:  # it tells of what can't be: it was refused
        return {}
    d = robot.position_dim
    boxes = [box for other in beside for box in reserved_boxes(robot, other)]
    reservations = [_rounded((*box[:2], *(box[d : d + 2] + box[-1]))) for box in boxes]
    return {name: told for name, told in (around | {"promises": reservations}).items() if told}


def _obstacle(item: pb.Obstacle) -> Figures:
    return {"kind": item.kind, "at": _rounded(item.position), "size": _rounded(item.size), "yaw": round(item.yaw, 4)}


def _headings(steps: Sequence[pb.Step], robot: Robot | None) -> list[float] | None:
    if robot is None or robot.heading is None or any(len(step.state) <= robot.heading for step in steps):
        return None
    return _rounded(step.state[robot.heading] for step in steps)


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), 4) if math.isfinite(value) else 0.0 for value in values]
