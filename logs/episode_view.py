"""Compute what the report draws of one episode, and its table of steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from brakeline.logs.arena_view import arena_view, obstacles_view
from brakeline.logs.decision_explanation import NO_ANSWER, bound_in, explain, limits_applied
from brakeline.logs.decision_view import body_discs, decision_view, reservations_json
from brakeline.logs.episode_stats import INTERVENTIONS, KINDS, Figures, closest_of, kind_of
from brakeline.logs.json_values import rounded
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, WALL
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import reserved_boxes

if TYPE_CHECKING:
    from brakeline.logs.episode_sampler import EpisodeRecord

MOST_TUBES, FEW_TUBES = 28, 12  # most tubes in the drawing of one episode; of an ordinary episode
CORNERS, HITS = 48, 90  # most corners of the free space's outline, and most scan hits, in the drawing of one step
NEAR = 8  # steps before and after the closest approach for which the drawing has tubes
SKETCHED = 2  # digits after the decimal point in a sketch: cm

# One letter for each step's decision: n (none), a(l)lowed, a(d)justed, f(a)ilsafe, r(e)covering.
LETTERS: dict[int, str] = {int(pb.UNKNOWN): "n", **{kind: name[1] for kind, name in KINDS.items()}}
ALARMING = "nlead"  # letters, the least alarming first; of several steps, a sketch shows the most alarming one


def picture(episode: EpisodeRecord, robot: Robot | None, tubes: int = MOST_TUBES) -> Figures:
    """Return what a drawing of each step needs, for JSON: arena, path [m], decisions by letter, some tubes.

    tubes: largest number of tubes.
    """
    steps, exchanges = episode.steps, episode.exchanges()
    closest = _closest(steps)
    return {
        **_summary(episode, closest),
        **_arena(episode.about, exchanges, robot),
        "footprint": robot.footprint if robot is not None else 0.0,
        "discs": body_discs(robot) if robot is not None else [],
        "dim": _dim(robot),
        "period": robot.period if robot is not None else None,
        "kinds": "".join(map(decision_letter, steps)),
        **_path(steps, robot),
        "heading": _headings(steps, robot),
        "clearance": rounded(step.clearance for step in steps),
        "speed": rounded(step.speed for step in steps),
        "tubes": _tubes(episode, exchanges, closest, robot, tubes),
        "movers": _movers(steps, exchanges),
    }


def sketch(episode: EpisodeRecord, robot: Robot | None, points: int) -> Figures:
    """Return an episode in short, for JSON: as `picture`, without tubes, at `points` of its steps.

    The steps are `at` evenly spaced indices, and the index of the closest approach. The walls are left out: they are
    the edges of the arena's square.
    """
    steps, last = episode.steps, len(episode.steps) - 1
    closest = _closest(steps)
    at = sorted({round(k * last / max(1, points - 1)) for k in range(points)} | {closest})
    some = [steps[k] for k in at]
    parts = [steps[before + 1 : k + 1] for before, k in zip((-1, *at), at, strict=False)]
    arena = _arena(episode.about, {}, robot, SKETCHED)
    inside = [o for o in arena["obstacles"] if o["kind"] != WALL]
    summary = _summary(episode, closest)
    return {
        **{name: round(value, 3) if isinstance(value, float) else value for name, value in summary.items()},
        **{name: value for name, value in arena.items() if value is not None},
        "obstacles": [{name: value for name, value in o.items() if value} for o in inside],
        "at": at,
        "kinds": "".join(max(map(decision_letter, part), key=ALARMING.index) for part in parts),
        **_path(some, robot, SKETCHED),
        "clearance": rounded((step.clearance for step in some), SKETCHED),
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
            "limited": _limited(step, exchange, robot),
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


def _summary(episode: EpisodeRecord, closest: int) -> Figures:
    """Return who drove, how it ended, and its counts."""
    first = episode.steps[0]
    return {
        "actor": episode.actor,
        "robot": first.robot,
        "episode": episode.number,
        "outcome": episode.outcome(),
        "steps": episode.count,
        "first": first.step,
        "reward": episode.reward,
        "interventions": episode.interventions,
        "failsafes": episode.failsafes,
        "closest": episode.closest if math.isfinite(episode.closest) else None,
        "closest_at": closest,
    }


def _closest(steps: Sequence[pb.Step]) -> int:
    return min(range(len(steps)), key=lambda k: closest_of(steps[k]))


def decision_letter(step: pb.Step) -> str:
    """Return the letter of a step's decision (`LETTERS`)."""
    return LETTERS.get(kind_of(step), "n")


def _dim(robot: Robot | None) -> int:
    return 2 if robot is None else robot.position_dim


def _path(steps: Sequence[pb.Step], robot: Robot | None, digits: int = 3) -> Figures:
    """Return the coordinates of the measured positions by axis; z is None in the plane."""

    def axis(k: int) -> list[float]:
        return rounded((step.state[k] if len(step.state) > k else 0.0 for step in steps), digits)

    return {"x": axis(0), "y": axis(1), "z": axis(2) if _dim(robot) == 3 else None}


def _arena(
    about: pb.Episode | None, exchanges: Mapping[int, pb.Exchange], robot: Robot | None, digits: int = 4
) -> Figures:
    """Return arena, goal and obstacles. Without the Episode message, the obstacles come from the requests."""
    if about is not None:
        return {"arena": about.arena, **arena_view(about, _dim(robot), digits)}
    requested = (item for exchange in exchanges.values() for item in exchange.request.obstacles)
    distinct = {item.SerializeToString(deterministic=True): item for item in requested if not item.HasField("motion")}
    unknown = dict.fromkeys(("arena", "half", "floor", "ceiling", "goal", "goal_radius", "start"))
    return {**unknown, "obstacles": obstacles_view(distinct.values())}


def _limited(step: pb.Step, exchange: pb.Exchange | None, robot: Robot | None) -> str:
    """Return which of the robot's limits changed an allowed proposal; empty if none did, or if that is unknown."""
    if robot is None or step.fallback or step.decision != pb.ALLOWED or len(step.proposed) != robot.action_dim:
        return ""
    before = () if exchange is None else exchange.request.input_in_force
    return limits_applied(robot, np.array(step.proposed), np.array(before), np.array(step.action))


def _explanation(exchange: pb.Exchange | None, robot: Robot | None) -> str:
    """Return why the filter changed the proposal; empty if it did not, or if that is unknown."""
    if exchange is None or robot is None or exchange.reply.decision.kind not in INTERVENTIONS:
        return ""
    explanation = explain(robot, exchange.request, exchange.reply.decision)
    return "" if explanation is None else explanation.sentence


def _tubes(
    episode: EpisodeRecord, exchanges: Mapping[int, pb.Exchange], closest: int, robot: Robot | None, most: int
) -> dict[int, Figures]:
    """Return decisions by index of the step: around the closest approach, then interventions by their clearance."""
    steps, others = episode.steps, episode.exchanges_of_others()
    near = [k for k in range(len(steps)) if abs(k - closest) <= min(NEAR, most // 4)]
    interventions = [k for k, step in enumerate(steps) if step.decision in INTERVENTIONS and k not in near]
    interventions.sort(key=lambda k: steps[k].clearance)
    tubes: dict[int, Figures] = {}
    for k in sorted(near + interventions[: most - len(near)]):
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
    perceived = view.perceived_json(HITS) | {"reservations": reservations_json(view.reservations)}
    return {
        "from": rounded(request.state[: view.centers.shape[1]]),
        "boxes": view.boxes_json(),
        "proposed": rounded(request.action),
        "plan": rounded(decision.plan[: len(request.action)]),
        "margin": rounded([decision.margin])[0],
        "at_least": decision.at_least,
        "reason": decision.reason,
        **view.explanation_json(),
        **{name: marks for name, marks in perceived.items() if marks},
    }


def _movers(steps: Sequence[pb.Step], exchanges: Mapping[int, pb.Exchange]) -> dict[int, list[list[float]]]:
    """Return by index of each second step where the request's moving obstacles were: center and largest radius."""
    movers: dict[int, list[list[float]]] = {}
    for k, step in enumerate(steps[::2]):
        exchange = exchanges.get(step.step)
        moving = [] if exchange is None else [o for o in exchange.request.obstacles if o.HasField("motion")]
        if moving:
            movers[2 * k] = [rounded((*o.position, _reach(o)), SKETCHED) for o in moving]
    return movers


def _reach(obstacle: pb.Obstacle) -> float:
    """Return the radius of an obstacle from above; of a box, that of the circle around it."""
    sizes = obstacle.size[:2]
    return 0.5 * math.hypot(*sizes) if obstacle.kind == BOX else max(sizes[:1], default=0.0)


def _headings(steps: Sequence[pb.Step], robot: Robot | None) -> list[float] | None:
    if robot is None or robot.heading is None or any(len(step.state) <= robot.heading for step in steps):
        return None
    return rounded(step.state[robot.heading] for step in steps)
