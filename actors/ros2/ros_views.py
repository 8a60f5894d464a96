"""Messages that show the filter in ROS's tools: tube, plan and obstacles as markers, its decisions as diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.ros2 import cdr_messages as ros
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Decision
from brakeline.safety.service.wire import KIND_NUMBERS

OBSTACLE_HEIGHT = 0.2  # m
THICKNESS = 0.01  # m, of lines and of the tube's boxes
LIFETIME = ros.Duration(sec=1, nanosec=0)  # of a marker that is not replaced
OBSTACLE = ros.ColorRGBA(r=0.47, g=0.5, b=0.55, a=0.6)
COLORS = {ALLOWED: (0.2, 0.66, 0.39), ADJUSTED: (0.94, 0.59, 0.12), FAILSAFE: (0.84, 0.19, 0.24)}
OTHER = (0.5, 0.3, 0.7)
NO_DATA = np.zeros(0, dtype=np.uint8)
CLEAR = ros.Marker(  # deletes all earlier markers
    header=ros.header(0.0, ""),
    ns="",
    id=0,
    type=ros.Marker.CUBE,
    action=ros.Marker.DELETEALL,
    pose=ros.pose(0.0, 0.0),
    scale=ros.vector(),
    color=OBSTACLE,
    lifetime=LIFETIME,
    frame_locked=False,
    points=[],
    colors=[],
    texture_resource="",
    texture=ros.CompressedImage(header=ros.header(0.0, ""), format="", data=NO_DATA),
    uv_coordinates=[],
    text="",
    mesh_resource="",
    mesh_file=ros.MeshFile(filename="", data=NO_DATA),
    mesh_use_embedded_materials=False,
)


def markers(time: float, frame: str, decision: Decision, obstacles: Sequence[Obstacle]) -> ros.MarkerArray:
    """Return the boxes of the tube, the path through their centers, and the obstacles (time in s)."""
    red, green, blue = COLORS.get(decision.kind, OTHER)
    clear = replace(CLEAR, header=ros.header(time, frame))
    box = replace(clear, action=ros.Marker.ADD, ns="tube", color=ros.ColorRGBA(r=red, g=green, b=blue, a=0.35))
    centers, widths = decision.tube_center.tolist(), (2.0 * decision.tube_half_width).tolist()
    tube = [
        replace(box, id=i, pose=ros.pose(x, y), scale=ros.vector(length, width, THICKNESS))
        for i, ((x, y), (length, width)) in enumerate(zip(centers, widths, strict=True))
    ]
    plan = replace(
        box,
        ns="plan",
        type=ros.Marker.LINE_STRIP,
        color=ros.ColorRGBA(r=red, g=green, b=blue, a=1.0),
        scale=ros.vector(THICKNESS),
        points=[ros.point(x, y, THICKNESS) for x, y in centers],
    )
    shapes = [
        replace(
            box,
            ns="obstacles",
            id=i,
            type=ros.Marker.CUBE if obstacle.kind == BOX else ros.Marker.CYLINDER,
            color=OBSTACLE,
            pose=ros.pose(obstacle.position[0], obstacle.position[1], obstacle.yaw, 0.5 * OBSTACLE_HEIGHT),
            scale=ros.vector(*_widths(obstacle), OBSTACLE_HEIGHT),
        )
        for i, obstacle in enumerate(obstacles)
    ]
    return ros.MarkerArray(markers=[clear, *tube, plan, *shapes])  # type: ignore[list-item]


def _widths(obstacle: Obstacle) -> tuple[float, float]:
    """Return the widths of a box or a disc [m]."""
    if obstacle.kind == BOX:
        return float(obstacle.size[0]), float(obstacle.size[1])
    assert obstacle.kind == CYLINDER, "a scan gives boxes and discs"
    return 2.0 * float(obstacle.size[0]), 2.0 * float(obstacle.size[0])


def diagnostics(
    time: float, node: str, robot: str, kind: str, reason: str, figures: Mapping[str, float]
) -> ros.DiagnosticArray:
    """Return the diagnostics of a decision.

    OK: the command is executed. WARN: another input or the committed plan is. ERROR: there is no decision, since an
    input of it is missing or the service does not answer, and the robot brakes.
    """
    level = ros.DiagnosticStatus.OK if kind == ALLOWED else ros.DiagnosticStatus.WARN
    status = ros.DiagnosticStatus(
        level=level if kind in KIND_NUMBERS else ros.DiagnosticStatus.ERROR,
        name=f"{node}: safety filter",
        message=f"{kind}: {reason}" if reason else kind,
        hardware_id=robot,
        values=[ros.KeyValue(key=name, value=_text(value)) for name, value in figures.items()],
    )
    return ros.DiagnosticArray(header=ros.header(time, ""), status=[status])


def _text(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else "unknown"
