"""Compute what of an episode's arena is to be drawn. The report, the live page and Foxglove draw this view of it."""

from __future__ import annotations

from collections.abc import Iterable

from brakeline.logs.episode_stats import Figures
from brakeline.logs.json_values import rounded
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, WALL


def half_width(episode: pb.Episode) -> float:
    """Return half the edge of the smallest square around the origin that holds the episode's arena, m."""
    walls = [o.position[:2] for o in episode.obstacles if o.kind == WALL]
    points = walls or [o.position[:2] for o in episode.obstacles] + [episode.goal[:2], episode.start[:2]]
    return max((abs(value) for point in points for value in point), default=1.0) or 1.0


def closes(obstacle: pb.Obstacle, half: float) -> bool:
    """Return whether the obstacle is the floor or the ceiling of an arena with this half-width."""
    return obstacle.kind == BOX and len(obstacle.size) == 3 and min(obstacle.size[:2]) >= 2.0 * half


def arena_view(episode: pb.Episode, dim: int, digits: int = 4) -> Figures:
    """Return the arena for JSON, in m.

    `floor` and `ceiling` are heights, or None without one. They are not among the `obstacles`: seen from above, each of
    them would cover everything. The `start` is the position.

    Args:
        episode: begins in this arena.
        dim: of positions; the goal and the start are cut to it.
        digits: after the decimal point.
    """
    half = half_width(episode)
    lids = [(o.position[2], 0.5 * o.size[2]) for o in episode.obstacles if closes(o, half)]
    middle = episode.start[2] if len(episode.start) > 2 else 0.0
    return {
        "half": round(half, digits),
        "floor": max((at + thick for at, thick in lids if at < middle), default=None),
        "ceiling": min((at - thick for at, thick in lids if at >= middle), default=None),
        "obstacles": obstacles_view((o for o in episode.obstacles if not closes(o, half)), digits),
        "goal": rounded(episode.goal[:dim], digits) if len(episode.goal) > 1 else None,
        "goal_radius": episode.goal_radius,
        "start": rounded(episode.start[:dim], digits) if len(episode.start) > 1 else None,
    }


def obstacles_view(obstacles: Iterable[pb.Obstacle], digits: int = 4) -> list[Figures]:
    """Return obstacles for JSON."""
    return [
        {
            "kind": o.kind,
            "at": rounded(o.position, digits),
            "size": rounded(o.size, digits),
            "yaw": rounded([o.yaw], digits)[0],
        }
        for o in obstacles
    ]
