"""Map where the filter saw what made it intervene, in the robot's frame: a bounded grid from above, over all episodes.

Arenas differ from episode to episode, so a place in the arena says little. A place relative to the robot says on which
side and how far away the obstacle was.
"""

from __future__ import annotations

import math

from brakeline.logs.episode_stats import INTERVENTIONS, Figures
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot

FIRST_CELL = 0.25  # of the robot's footprint
MOST_CELLS = 6400
STILL = 1e-6  # of a proposed motion that has no direction

COLUMNS = {int(pb.ADJUSTED): 0, int(pb.FAILSAFE): 1, int(pb.RECOVERING): 2}  # of the counts of a cell


class InterventionMap:
    """Counts of interventions by the cell of the blocking half-space's edge. If there are too many cells, they double.

    x points ahead, y to the left. Without a heading, x points in the direction of the proposed motion.

    Attributes:
        robot: None if no robot of this name is known; then no place is known either.
        cell: width of a cell, m.
        cells: adjusted, failsafe and recovering decisions, by cell.
        elsewhere: interventions without a place, such as those for a limit of the speed.
    """

    def __init__(self, robot: Robot | None) -> None:
        self.robot, self.elsewhere = robot, 0
        self.cell = FIRST_CELL * (robot.footprint if robot is not None else 0.1)
        self.cells: dict[tuple[int, int], list[int]] = {}

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add an exchange; one without an intervention does not count."""
        decision = exchange.reply.decision
        if decision.kind not in INTERVENTIONS:
            return
        place = self._place(exchange.request, decision.stopped)
        if place is None:
            self.elsewhere += 1
            return
        key = math.floor(place[0] / self.cell), math.floor(place[1] / self.cell)
        self.cells.setdefault(key, [0, 0, 0])[COLUMNS[decision.kind]] += 1
        if len(self.cells) > MOST_CELLS:
            self._coarsen()

    def _place(self, request: pb.Request, stopped: pb.Stopped) -> tuple[float, float] | None:
        """Return where the half-space's edge is, m ahead and m to the left of the robot; None if that is unknown."""
        robot = self.robot
        if robot is None or len(stopped.at) < 2 or len(request.state) != robot.state_dim:
            return None
        ahead = self._heading(robot, request)
        x, y = stopped.at[0] - request.state[0], stopped.at[1] - request.state[1]
        cos, sin = math.cos(ahead), math.sin(ahead)
        place = cos * x + sin * y, cos * y - sin * x
        return place if math.isfinite(place[0]) and math.isfinite(place[1]) else None

    @staticmethod
    def _heading(robot: Robot, request: pb.Request) -> float:
        if robot.heading is not None:
            return float(request.state[robot.heading])
        if len(request.action) != robot.action_dim:
            return 0.0
        moves = [value for value, moves in zip(request.action, robot.translates, strict=True) if moves][:2]
        return math.atan2(moves[1], moves[0]) if len(moves) == 2 and math.hypot(*moves) > STILL else 0.0

    def _coarsen(self) -> None:
        self.cell *= 2.0
        coarse: dict[tuple[int, int], list[int]] = {}
        for (x, y), counts in self.cells.items():
            sums = coarse.setdefault((x // 2, y // 2), [0, 0, 0])
            for i, count in enumerate(counts):
                sums[i] += count
        self.cells = coarse

    def figures(self) -> Figures:
        """Return `cells`: [x, y of the lower left corner in cells, adjusted, failsafes, recovering]."""
        return {
            "cell": self.cell,
            "cells": [[x, y, *counts] for (x, y), counts in sorted(self.cells.items())],
            "elsewhere": self.elsewhere,
            "heading": self.robot is not None and self.robot.heading is not None,
            "footprint": 0.0 if self.robot is None else self.robot.footprint,
        }
