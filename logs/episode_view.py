"""Compute what the report draws of one episode, and its table of steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from brakeline.logs.decision_explanation import NO_ANSWER, bound_in, explain
from brakeline.logs.decision_view import body_discs, boxes_from_above, decision_view
from brakeline.logs.episode_stats import INTERVENTIONS, KINDS, Figures, kind_of
from brakeline.logs.json_values import rounded
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import reserved_boxes

if TYPE_CHECKING:
    from brakeline.logs.episode_sampler import EpisodeRecord

MOST_TUBES = 40  # tubes in one picture
CORNERS, HITS = 48, 90  # corners of the free space's outline and scan hits in the picture of one step
NEAR = 8  # steps before and after the closest approach for which the picture has tubes

# One letter for each step's decision: n (none), a(l)lowed, a(d)justed, f(a)ilsafe, r(e)covering.
LETTERS: dict[int, str] = {int(pb.UNKNOWN): "n", **{kind: name[1] for kind, name in KINDS.items()}}


def picture(episode: EpisodeRecord, robot: Robot | None) -> Figures:
    """Return what a drawing from above needs, for JSON: arena, path [m], decisions by letter, some tubes."""
    first, steps, exchanges = episode.steps[0], episode.steps, episode.exchanges()
    closest = min(range(len(steps)), key=lambda k: steps[k].clearance)
    return {
        "actor": episode.actor,
        "robot": first.robot,
        "episode": episode.number,
        **_arena(episode.about, exchanges),
        "footprint": robot.footprint if robot is not None else 0.0,
        "discs": body_discs(robot) if robot is not None else [],
        "outcome": episode.outcome(),
        "steps": len(steps),
        "first": first.step,
        "reward": math.fsum(step.reward for step in steps),
        "interventions": sum(kind_of(step) in INTERVENTIONS for step in steps),
        "failsafes": episode.failsafes,
        "closest": episode.closest if math.isfinite(episode.closest) else None,
        "closest_at": closest,
        "kinds": "".join(LETTERS.get(kind_of(step), "n") for step in steps),
        "x": rounded(step.state[0] if step.state else 0.0 for step in steps),
        "y": rounded(step.state[1] if len(step.state) > 1 else 0.0 for step in steps),
        "heading": _headings(steps, robot),
        "clearance": rounded(step.clearance for step in steps),
        "speed": rounded(step.speed for step in steps),
        "tubes": _tubes(episode, exchanges, closest, robot),
    }


def rows(episode: EpisodeRecord, robot: Robot | None) -> Iterable[Figures]:
    """Yield one row of the table for each step of the episode."""
    exchanges = episode.exchanges()
    for step in episode.steps:
        exchange = exchanges.get(step.step)
        decision = exchange.reply.decision if exchange is not None else None
        yield {
            "actor": episode.actor,
            "episode": episode.number,
            "step": step.step,
            "time": step.header.time,
            **{name: list(getattr(step, name)) for name in ("state", "proposed", "action")},
            "decision": "no decision" if step.fallback else KINDS.get(step.decision),
            "reason": getattr(decision, "reason", None),
            "said": NO_ANSWER if step.fallback else _explanation(exchange, robot),
            "margin": decision.margin if decision is not None and decision.tube_center else None,
            "at_least": decision is not None and decision.at_least,
            "verified": getattr(decision, "verified", None),
            "bound": bound_in(decision) if decision is not None else None,
            "decide_ms": getattr(decision, "time_ms", None),
            "round_trip_ms": getattr(exchange, "round_trip_ms", None),
            "iterations": getattr(decision, "iterations", None),
            **{name: getattr(step, name) for name in ("clearance", "speed", "reward", "penalty", "weights_version")},
            "end": episode.outcome() if step is episode.steps[-1] else "",
        }


def _arena(about: pb.Episode | None, exchanges: Mapping[int, pb.Exchange]) -> Figures:
    """Return arena, goal and obstacles. Without the Episode message, the obstacles come from the requests."""
    if about is None:
        requested = (item for exchange in exchanges.values() for item in exchange.request.obstacles)
        distinct = {item.SerializeToString(deterministic=True): item for item in requested}
        obstacles = [_obstacle(item) for item in distinct.values()]
        return {"arena": None, "goal": None, "goal_radius": None, "start": None, "obstacles": obstacles}
    return {
        "arena": about.arena,
        "goal": rounded(about.goal[:2]) if len(about.goal) > 1 else None,
        "goal_radius": about.goal_radius,
        "start": rounded(about.start[:2]) if len(about.start) > 1 else None,
        "obstacles": [_obstacle(item) for item in about.obstacles],
    }


def _explanation(exchange: pb.Exchange | None, robot: Robot | None) -> str:
    """Return why the filter changed the proposal; empty if it did not, or if that is unknown."""
    if exchange is None or robot is None or exchange.reply.decision.kind not in INTERVENTIONS:
        return ""
    explanation = explain(robot, exchange.request, exchange.reply.decision)
    return "" if explanation is None else explanation.said


def _tubes(
    episode: EpisodeRecord, exchanges: Mapping[int, pb.Exchange], closest: int, robot: Robot | None
) -> dict[int, Figures]:
    """Return decisions by index of the step: around the closest approach, then interventions by their clearance."""
    steps, others = episode.steps, episode.exchanges_of_others()
    near = [k for k in range(len(steps)) if abs(k - closest) <= NEAR]
    interventions = [k for k, step in enumerate(steps) if step.decision in INTERVENTIONS and k not in near]
    interventions.sort(key=lambda k: steps[k].clearance)
    tubes: dict[int, Figures] = {}
    for k in sorted(near + interventions[: MOST_TUBES - len(near)]):
        number = steps[k].step
        if number in exchanges and (tube := _tube(exchanges[number], others.get(number, ()), robot)) is not None:
            tubes[k] = tube
    return tubes


def _tube(exchange: pb.Exchange, others: Iterable[pb.Exchange], robot: Robot | None) -> Figures | None:
    """Return one decision for JSON; None if it has no tube or is malformed."""
    request, decision = exchange.request, exchange.reply.decision
    try:
        reservations = [] if robot is None else [reserved_boxes(robot, other) for other in others]
        view = decision_view(robot, exchange, reservations, CORNERS)
    except ValueError:  # the filter has rejected this request
        return None
    if not len(view.centers) or view.centers.shape[1] < 2:
        return None
    perceived = view.perceived_json(HITS) | {"promises": boxes_from_above(view.reservations)}
    return {
        "from": rounded(request.state[:2]),
        "boxes": view.boxes_json(),
        "proposed": rounded(request.action),
        "plan": rounded(decision.plan[: len(request.action)]),
        "margin": rounded([decision.margin])[0],
        "at_least": decision.at_least,
        "reason": decision.reason,
        **view.explanation_json(),
        **{name: marks for name, marks in perceived.items() if marks},
    }


def _obstacle(item: pb.Obstacle) -> Figures:
    return {"kind": item.kind, "at": rounded(item.position), "size": rounded(item.size), "yaw": round(item.yaw, 4)}


def _headings(steps: Sequence[pb.Step], robot: Robot | None) -> list[float] | None:
    if robot is None or robot.heading is None or any(len(step.state) <= robot.heading for step in steps):
        return None
    return rounded(step.state[robot.heading] for step in steps)
