"""Compute what of one decision is to be drawn. The report, the live page and Foxglove draw this view of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from brakeline.logs.decision_explanation import Explanation, explain
from brakeline.logs.episode_stats import Figures
from brakeline.logs.json_values import rounded
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.perception.displayed_map import OUTLINE, DisplayedMap, map_for_display


@dataclass(frozen=True)
class DecisionView:
    """One request with its decision, in the world frame, m.

    Attributes:
        centers, half_widths: (N, d), the tube: one box for the end of each period of the plan; N = 0 without a tube.
        explanation: why the filter changed the proposal; None if the robot is unknown or the message does not fit it.
        perceived: the scan and the moving obstacles of the request; None if the robot is unknown.
        reservations: (k, 2d + 1), boxes that the other robots of the fleet reserve: center, half-width, body radius.
    """

    centers: Array
    half_widths: Array
    explanation: Explanation | None
    perceived: DisplayedMap | None
    reservations: Array

    def perceived_json(self, hits: int = OUTLINE) -> Figures:
        """Return the scan and the moving obstacles for JSON, with at most `hits` points of the scan."""
        return {} if self.perceived is None else self.perceived.flat(hits)

    def boxes_json(self) -> list[list[float]]:
        """Return the tube for JSON: center (d) and half-width (d) of each box."""
        return [rounded(row, 3) for row in np.column_stack([self.centers, self.half_widths])]

    def explanation_json(self) -> Figures:
        """Return the explanation, the inputs, their arrows and the edge of the blocking half-space.

        Empty without an explanation.
        """
        if (about := self.explanation) is None:
            return {}
        return {
            "said": about.sentence,
            "trust": about.trust,
            "limited": about.limited,
            "inputs": [[name, unit, *rounded((proposed, done))] for name, unit, proposed, done in about.inputs],
            "arrows": [rounded(about.proposed), rounded(about.executed)],
            "edge": [*rounded(about.at), *rounded(about.normal)] if len(about.at) else None,
        }


def decision_view(
    robot: Robot | None, exchange: pb.Exchange, reservations: Iterable[Array] = (), corners: int = OUTLINE
) -> DecisionView:
    """Compute the view of one exchange.

    Args:
        robot: None if no robot of this name is known; then only the tube is drawn.
        reservations: boxes of each other robot, as `displayed_map.reserved_boxes` returns them.
        corners: approximate number of corners of the free space's outline.

    Raises:
        ValueError: the tube or the scan is malformed.
    """
    request, decision = exchange.request, exchange.reply.decision
    centers, half_widths = tube_boxes(exchange, None if robot is None else robot.position_dim)
    boxes = list(reservations)
    if robot is None:
        return DecisionView(centers, half_widths, None, None, np.zeros((0, 5)))
    if len(centers) > robot.horizon:
        raise ValueError(f"a tube has {len(centers)} boxes; the horizon is {robot.horizon} periods")
    return DecisionView(
        centers,
        half_widths,
        explain(robot, request, decision),
        map_for_display(robot, request, corners),
        np.concatenate(boxes) if boxes else np.zeros((0, 2 * robot.position_dim + 1)),
    )


def tube_boxes(exchange: pb.Exchange, dim: int | None = None) -> tuple[Array, Array]:
    """Return the centers and half-widths (N, d) of a decision's tube.

    Args:
        dim: d of the robot; None: computed from the lengths of the plan and of the input.

    Raises:
        ValueError: the sizes do not match.
    """
    decision, inputs = exchange.reply.decision, len(exchange.request.action)
    centers, half_widths = np.array(decision.tube_center), np.array(decision.tube_half_width)
    if dim is None:
        periods = len(decision.plan) // max(inputs, 1)
        dim = len(centers) // max(periods, 1)
    if len(centers) != len(half_widths) or (len(centers) and (dim < 1 or len(centers) % dim)):
        raise ValueError(f"a tube has {len(centers)} coordinates of centers and {len(half_widths)} half-widths")
    return centers.reshape(-1, max(dim, 1)), half_widths.reshape(-1, max(dim, 1))


def reservations_json(reservations: Array) -> list[list[float]]:
    """Return reservations (k, 2d + 1) for JSON: center (d) and half-width (d) with the body radius added."""
    d = reservations.shape[1] // 2
    return [rounded((*box[:d], *(box[d:-1] + box[-1]))) for box in reservations]


def body_discs(robot: Robot) -> list[list[float]]:
    """Return the position (d) in the body frame and the radius of each disc or ball of the robot's body, m."""
    return [[*disc.at, disc.radius] for disc in robot.body]
