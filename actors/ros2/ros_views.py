"""Messages that show the filter in ROS's tools: tube, plan and obstacles as markers, its decisions as diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.ros2.cdr_messages import (
    ColorRGBA,
    CompressedImage,
    DiagnosticArray,
    DiagnosticStatus,
    Duration,
    KeyValue,
    Marker,
    MarkerArray,
    MeshFile,
    Point,
    Pose,
    header,
    point,
    pose,
    vector,
)
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Decision
from brakeline.safety.service.wire import KINDS

Array = NDArray[np.float64]

OBSTACLE_HEIGHT = 0.2  # m
THICKNESS = 0.01  # m, of lines and of the tube's boxes
LIFETIME = Duration(sec=1, nanosec=0)  # of a marker that is not replaced
OBSTACLE = ColorRGBA(r=0.47, g=0.5, b=0.55, a=0.6)
COLORS = {
    ALLOWED: (0.2, 0.66, 0.39),
    ADJUSTED: (0.94, 0.59, 0.12),
    FAILSAFE: (0.84, 0.19, 0.24),
}
OTHER = (0.5, 0.3, 0.7)
CUBE, ROUND, LINE = Marker.CUBE, Marker.CYLINDER, Marker.LINE_STRIP


def markers(time: float, frame: str, decision: Decision, obstacles: Sequence[Obstacle]) -> MarkerArray:
    """Return the boxes of the tube, the path through their centers, and the obstacles (time in s)."""
    centers, halves = decision.tube_center, decision.tube_half_width
    red, green, blue = COLORS.get(decision.kind, OTHER)
    tube, plan = ColorRGBA(r=red, g=green, b=blue, a=0.35), ColorRGBA(r=red, g=green, b=blue, a=1.0)
    shown = [
        _marker(time, frame, "tube", i, CUBE, pose(*center), (*(2.0 * half), THICKNESS), tube)
        for i, (center, half) in enumerate(zip(centers.tolist(), halves, strict=True))
    ]
    path = [point(x, y, THICKNESS) for x, y in centers.tolist()]
    shown.append(_marker(time, frame, "plan", 0, LINE, pose(0.0, 0.0), (THICKNESS, 0.0, 0.0), plan, path))
    for i, obstacle in enumerate(obstacles):
        shown.append(_obstacle(time, frame, i, obstacle))
    return MarkerArray(markers=[_clear(time, frame), *shown])  # type: ignore[list-item]


def _obstacle(time: float, frame: str, number: int, obstacle: Obstacle) -> Marker:
    x, y = obstacle.position
    place = pose(x, y, obstacle.yaw, 0.5 * OBSTACLE_HEIGHT)
    if obstacle.kind == BOX:
        return _marker(time, frame, "obstacles", number, CUBE, place, (*obstacle.size[:2], OBSTACLE_HEIGHT), OBSTACLE)
    assert obstacle.kind == CYLINDER, "a scan gives boxes and discs"
    width = 2.0 * obstacle.size[0]
    return _marker(time, frame, "obstacles", number, ROUND, place, (width, width, OBSTACLE_HEIGHT), OBSTACLE)


def _clear(time: float, frame: str) -> Marker:
    """Return the marker that deletes all earlier ones."""
    return _marker(time, frame, "", 0, CUBE, pose(0.0, 0.0), (0.0, 0.0, 0.0), OBSTACLE, action=Marker.DELETEALL)


def _marker(
    time: float,
    frame: str,
    group: str,
    number: int,
    kind: int,
    place: Pose,
    scale: tuple[float, ...],
    color: ColorRGBA,
    points: Sequence[Point] = (),
    action: int = Marker.ADD,
) -> Marker:
    nothing = np.zeros(0, dtype=np.uint8)
    image = CompressedImage(header=header(0.0, ""), format="", data=nothing)
    return Marker(
        header=header(time, frame),
        ns=group,
        id=number,
        type=kind,
        action=action,
        pose=place,
        scale=vector(*map(float, scale)),
        color=color,
        lifetime=LIFETIME,
        frame_locked=False,
        points=list(points),
        colors=[],
        texture_resource="",
        texture=image,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=MeshFile(filename="", data=nothing),
        mesh_use_embedded_materials=False,
    )


def diagnostics(
    time: float, node: str, robot: str, kind: str, reason: str, figures: Mapping[str, float]
) -> DiagnosticArray:
    """Return the diagnostics of a decision.

    OK: the command is executed. WARN: another input or the committed plan is. ERROR: there is no decision, since an
    input of it is missing or the service does not answer, and the robot brakes.
    """
    level = DiagnosticStatus.OK if kind == ALLOWED else DiagnosticStatus.WARN
    status = DiagnosticStatus(
        level=level if kind in KINDS else DiagnosticStatus.ERROR,
        name=f"{node}: safety filter",
        message=f"{kind}: {reason}" if reason else kind,
        hardware_id=robot,
        values=[KeyValue(key=name, value=_text(value)) for name, value in figures.items()],
    )
    return DiagnosticArray(header=header(time, ""), status=[status])


def _text(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else "unknown"
