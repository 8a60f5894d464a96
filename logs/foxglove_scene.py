"""Convert messages to Foxglove's well-known schemas: arena, robot, tube, plan, lidar, frames, log lines.

Frames: `world` → ACTOR (the frame of the actor's arena, in which messages give coordinates) → ACTOR/body. Lengths in m,
axes east, north, up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from brakeline.logs.decision_explanation import Explanation, fell_back
from brakeline.logs.decision_view import DecisionView, decision_view
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import DisplayedMap

WORLD = "world"
HEIGHT = 0.4  # m, drawn height of obstacles in the plane
MOST_HITS = 400  # scan hits in one scene; the request in the log has all of them
FLAT = 0.02  # m, height of marks on the floor; walls are twice as thick
LEVELS = {"DEBUG": Log.DEBUG, "INFO": Log.INFO, "WARNING": Log.WARNING, "ERROR": Log.ERROR}


def _color(red: int, green: int, blue: int, alpha: float = 1.0) -> Color:
    return Color(r=red / 255, g=green / 255, b=blue / 255, a=alpha)


SOLID, WALLS, GOAL = _color(120, 128, 140), _color(120, 128, 140, 0.25), _color(52, 168, 100, 0.35)
PROPOSED, EXECUTED, EDGE = _color(199, 125, 0), _color(31, 95, 191), _color(192, 32, 48, 0.5)
FREE, HIT, RESERVED = _color(20, 140, 120), _color(90, 40, 140), _color(40, 96, 190, 0.18)
MOVER, SWEPT = _color(170, 90, 40), _color(170, 90, 40, 0.15)
BODY, NOSE = _color(40, 96, 190), _color(250, 250, 250)
KINDS: dict[int, tuple[int, int, int]] = {
    pb.ALLOWED: (52, 168, 100),
    pb.ADJUSTED: (240, 150, 30),
    pb.FAILSAFE: (214, 48, 60),
    pb.RECOVERING: (142, 68, 173),
}
WORDS = {pb.ADJUSTED: "adjusted", pb.FAILSAFE: "failsafe", pb.RECOVERING: "recovering"}


def body_frame(actor: str) -> str:
    """Return the name of the frame that is fixed to an actor's body."""
    return f"{actor}/body"


def stamp(time: int) -> Timestamp:
    """Convert ns since the Unix epoch."""
    return Timestamp(seconds=time // 10**9, nanos=time % 10**9)


def half_width(episode: pb.Episode) -> float:
    """Return half the edge of the smallest square around the origin that holds the episode's arena, m."""
    walls = [o.position[:2] for o in episode.obstacles if o.kind == WALL]
    points = walls or [o.position[:2] for o in episode.obstacles] + [episode.goal[:2], episode.start[:2]]
    return max((abs(value) for point in points for value in point), default=1.0) or 1.0


def arena(robot: Robot, episode: pb.Episode, time: int) -> SceneUpdate:
    """Draw obstacles, walls, goal and the robot's body. Sent once, at the start of an episode."""
    half = half_width(episode)
    room = SceneEntity(timestamp=stamp(time), frame_id=episode.actor, id="arena")
    height = _ceiling(episode, half)
    for obstacle in episode.obstacles:
        _draw_obstacle(room, obstacle, half, height)
    radius = 2.0 * episode.goal_radius
    if robot.position_dim == 3:
        room.spheres.append(SpherePrimitive(pose=_pose(episode.goal), size=_vector(radius, radius, radius), color=GOAL))
    else:
        disc = CylinderPrimitive(pose=_pose(episode.goal), size=_vector(radius, radius, FLAT), color=GOAL)
        disc.bottom_scale = disc.top_scale = 1.0
        room.cylinders.append(disc)
    return SceneUpdate(entities=[room, _body(robot, episode.actor, time)])


def _ceiling(episode: pb.Episode, half: float) -> float:
    """Return the drawn height of the walls, m: up to the ceiling, if the arena has one."""
    lids = [o.position[2] - 0.5 * o.size[2] for o in episode.obstacles if _closes(o, half)]
    return max(lids, default=0.0) or HEIGHT


def _closes(obstacle: pb.Obstacle, half: float) -> bool:
    """Return whether the obstacle is a floor or a ceiling."""
    return obstacle.kind == BOX and len(obstacle.size) == 3 and min(obstacle.size[:2]) >= 2.0 * half


def _draw_obstacle(room: SceneEntity, obstacle: pb.Obstacle, half: float, height: float) -> None:
    """Add an obstacle, except a floor or a ceiling, which would hide the room."""
    if _closes(obstacle, half):
        return
    flat = len(obstacle.position) == 2
    position = (*obstacle.position, 0.5 * height) if flat else tuple(obstacle.position)
    if obstacle.kind == WALL:
        x, y = (at - FLAT * turn(obstacle.yaw) for at, turn in zip(position, (math.cos, math.sin), strict=False))
        size = _vector(2.0 * FLAT, 2.0 * half, height)
        room.cubes.append(CubePrimitive(pose=_pose((x, y, 0.5 * height), obstacle.yaw), size=size, color=WALLS))
    elif obstacle.kind == BOX:
        size = _vector(*obstacle.size, *([height] if flat else []))
        room.cubes.append(CubePrimitive(pose=_pose(position, obstacle.yaw), size=size, color=SOLID))
    elif obstacle.kind == CYLINDER or flat:
        radius = 2.0 * obstacle.size[0]
        size = _vector(radius, radius, height if flat else obstacle.size[1])
        shape = CylinderPrimitive(pose=_pose(position), size=size, color=SOLID, bottom_scale=1.0, top_scale=1.0)
        room.cylinders.append(shape)
    elif obstacle.kind == SPHERE:
        radius = 2.0 * obstacle.size[0]
        room.spheres.append(SpherePrimitive(pose=_pose(position), size=_vector(radius, radius, radius), color=SOLID))


def _body(robot: Robot, actor: str, time: int) -> SceneEntity:
    """Draw the discs or spheres of the body in the body frame."""
    body = SceneEntity(timestamp=stamp(time), frame_id=body_frame(actor), id="body", frame_locked=True)
    tall = 0.5 * HEIGHT
    for disc in robot.body:
        edge = 2.0 * disc.radius
        if robot.position_dim == 3:
            body.spheres.append(SpherePrimitive(pose=_pose(disc.at), size=_vector(edge, edge, edge), color=BODY))
            continue
        place = _pose((*disc.at, 0.5 * tall))
        drum = CylinderPrimitive(
            pose=place, size=_vector(edge, edge, tall), color=BODY, bottom_scale=1.0, top_scale=1.0
        )
        body.cylinders.append(drum)
    if robot.position_dim == 2:
        nose = _pose((0.5 * robot.front_extent, 0.0, tall))
        body.cubes.append(CubePrimitive(pose=nose, size=_vector(robot.front_extent, 2.0 * FLAT, FLAT), color=NOSE))
    body.texts.append(_text(actor, (0.0, 0.0, HEIGHT + robot.footprint), _color(60, 60, 60)))
    return body


def decision(
    robot: Robot, step: pb.Step, exchange: pb.Exchange | None, time: int, reservations: Iterable[np.ndarray] = ()
) -> SceneUpdate:
    """Draw the decision for the period that ended with this step.

    The scene has the tube, the robot's stopping area, the plan, the explanation of an intervention, and the perceived
    surroundings.

    Args:
        exchange: request and decision of the step; None if the log does not have it.
        time: ns since the Unix epoch.
        reservations: of each other robot of the world, as `displayed_map.reserved_boxes` returns them.

    Raises:
        ValueError: the tube or the scan is malformed.
    """
    kind = pb.FAILSAFE if step.fallback else step.decision
    entity = SceneEntity(timestamp=stamp(time), frame_id=step.actor, id="decision")
    color, words = KINDS.get(kind, (120, 120, 120)), WORDS.get(kind, "")
    if exchange is not None:
        view = decision_view(robot, exchange, reservations)
        start = exchange.request.state[: robot.position_dim]
        if exchange.reply.HasField("decision"):
            _draw_tube(entity, view, start, robot.footprint, color)
        if view.explanation is not None and kind in WORDS and not step.fallback:
            words = f"{WORDS[kind]}: {view.explanation.said}"
            _draw_explanation(entity, start, view.explanation, robot.footprint)
        if view.perceived is not None:
            _draw_perceived(entity, view.perceived, view.reservations)
    if kind in WORDS:
        above = HEIGHT + 3.0 * robot.footprint
        text = fell_back() if step.fallback else words
        entity.texts.append(_text(text, step.state[: robot.position_dim], _color(*color), above))
    return SceneUpdate(entities=[entity])


def _draw_tube(
    entity: SceneEntity, view: DecisionView, start: Sequence[float], footprint: float, color: tuple[int, int, int]
) -> None:
    """Add the boxes of the tube, the area where the robot stops, and the plan from the robot through the centers."""
    for center, half in zip(view.centers, view.half_widths, strict=True):
        edges = [*(2.0 * half), *[FLAT] * (3 - len(half))]
        entity.cubes.append(CubePrimitive(pose=_pose(center), size=_vector(*edges), color=_color(*color, 0.6)))
    if len(view.centers):
        across = 2.0 * (math.hypot(*view.half_widths[-1]) + footprint)
        _draw_stop(entity, view.centers[-1], across, _color(*color, 0.2))
    plan = LinePrimitive(type=LinePrimitive.LINE_STRIP, pose=_pose(()), thickness=3.0, scale_invariant=True)
    plan.points.extend([_point(at) for at in (start, *view.centers)])
    plan.color.CopyFrom(_color(*color))
    entity.lines.append(plan)


def _draw_explanation(entity: SceneEntity, start: Sequence[float], about: Explanation, size: float) -> None:
    """Add the proposed and the executed input as arrows, and the edge of the half-space that blocks the proposal."""
    for way, color in ((about.proposed, PROPOSED), (about.executed, EXECUTED)):
        length = float(np.linalg.norm(way))
        if length > 0.0:
            thick = 0.15 * size
            shape = ArrowPrimitive(pose=_along(start, way / length), color=color)
            shape.shaft_length, shape.head_length = 0.8 * length, 0.2 * length
            shape.shaft_diameter, shape.head_diameter = thick, 2.0 * thick
            entity.arrows.append(shape)
    if len(about.at):
        edge = CubePrimitive(pose=_along(about.at, about.normal), color=EDGE)
        across = 5.0 * size
        edge.size.CopyFrom(_vector(FLAT, across, across if len(about.at) == 3 else FLAT))
        entity.cubes.append(edge)


def _draw_perceived(entity: SceneEntity, about: DisplayedMap, reservations: np.ndarray) -> None:
    """Add scan hits, the outline of free space, moving obstacles with their reachable sets, and the reservations."""
    if len(about.free):
        free = LinePrimitive(type=LinePrimitive.LINE_LOOP, pose=_pose(()), thickness=2.0, scale_invariant=True)
        free.points.extend(map(_point, about.free))
        free.color.CopyFrom(FREE)
        hits = LinePrimitive(type=LinePrimitive.LINE_LIST, pose=_pose(()), thickness=4.0, scale_invariant=True)
        hits.points.extend(map(_point, _hit_marks(about.hits)))
        hits.color.CopyFrom(HIT)
        entity.lines.extend([free, hits])
    swept = about.swept.reshape(-1, about.swept.shape[-1])
    for discs, color, tall in ((about.movers, MOVER, HEIGHT), (swept, SWEPT, FLAT)):
        for *at, radius in discs:
            if len(at) == 3:
                ball = _vector(*[2.0 * radius] * 3)
                entity.spheres.append(SpherePrimitive(pose=_pose(at), size=ball, color=color))
                continue
            size, place = _vector(2.0 * radius, 2.0 * radius, tall), _pose((*at, 0.5 * tall))
            entity.cylinders.append(
                CylinderPrimitive(pose=place, size=size, color=color, bottom_scale=1.0, top_scale=1.0)
            )
    for box in reservations:
        d = len(box) // 2
        edges = [2.0 * (half + box[-1]) for half in box[d:-1]] + [FLAT] * (3 - d)
        entity.cubes.append(CubePrimitive(pose=_pose(box[:d]), size=_vector(*edges), color=RESERVED))


def _hit_marks(hits: np.ndarray) -> list[list[float]]:
    """Return the two ends of a short upright line at each of at most `MOST_HITS` points (k, d)."""
    some = hits[:: max(1, -(-len(hits) // MOST_HITS))]
    ends = np.zeros((len(some), 2, 3))
    ends[..., : some.shape[1]] = some[:, None]
    ends[:, 1, 2] += FLAT
    return list(ends.reshape(-1, 3).tolist())


def _along(at: Iterable[float], way: Sequence[float] | np.ndarray) -> Pose:
    """Return a pose whose x axis points along a unit vector."""
    x, y, z = [*way, 0.0, 0.0][:3]
    yaw, pitch = math.atan2(y, x), -math.asin(max(-1.0, min(1.0, z)))
    cy, sy, cp, sp = math.cos(0.5 * yaw), math.sin(0.5 * yaw), math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    pose = _pose(at)
    pose.orientation.CopyFrom(Quaternion(x=-sy * sp, y=cy * sp, z=sy * cp, w=cy * cp))
    return pose


def _draw_stop(entity: SceneEntity, center: Sequence[float] | np.ndarray, across: float, color: Color) -> None:
    """Add the disc or sphere that holds the body wherever in the tube's last box the robot stops."""
    if len(center) == 3:
        entity.spheres.append(SpherePrimitive(pose=_pose(center), size=_vector(across, across, across), color=color))
        return
    disc = CylinderPrimitive(pose=_pose(center), size=_vector(across, across, FLAT), color=color)
    disc.bottom_scale = disc.top_scale = 1.0
    entity.cylinders.append(disc)


def frames(robot: Robot, actor: str, site: tuple[float, float], state: Sequence[float], time: int) -> FrameTransforms:
    """Return the transforms from the world to the actor's arena and from the arena to the robot's body."""
    at, d = stamp(time), robot.position_dim
    yaw = 0.0 if robot.heading is None else state[robot.heading]
    place = FrameTransform(timestamp=at, parent_frame_id=WORLD, child_frame_id=actor)
    place.translation.CopyFrom(_vector(*site, 0.0))
    place.rotation.CopyFrom(_turn(0.0))
    body = FrameTransform(timestamp=at, parent_frame_id=actor, child_frame_id=body_frame(actor))
    body.translation.CopyFrom(_vector(*state[:d], *[0.0] * (3 - d)))
    body.rotation.CopyFrom(_turn(yaw))
    return FrameTransforms(transforms=[place, body])


def lidar(rays: LidarRays, actor: str, observation: Sequence[float], time: int) -> LaserScan | PointCloud:
    """Convert the rays of an observation: in the plane to a scan, in space to a cloud of the hit points."""
    ranges = np.asarray(observation[: len(rays.directions)], float) * rays.range
    frame, at = body_frame(actor), stamp(time)
    if rays.directions.shape[1] == 2:
        first, last = (math.atan2(y, x) for x, y in rays.directions[[0, -1]])
        return LaserScan(
            timestamp=at, frame_id=frame, pose=_pose(()), start_angle=first, end_angle=last, ranges=ranges.tolist()
        )
    hit = ranges < rays.range
    points = (rays.directions[hit] * ranges[hit, None]).astype("<f4")
    fields = [
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32) for i, name in enumerate("xyz")
    ]
    return PointCloud(
        timestamp=at, frame_id=frame, pose=_pose(()), point_stride=12, fields=fields, data=points.tobytes()
    )


def log_line(line: pb.LogLine, time: int) -> Log:
    """Convert a log line. `time`: ns since the Unix epoch."""
    return Log(timestamp=stamp(time), level=LEVELS.get(line.level, Log.UNKNOWN), message=line.text, name=line.process)


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


def _point(values: Iterable[float]) -> Point3:
    return Point3(**dict(zip("xyz", values, strict=False)))


def _pose(position: Iterable[float], yaw: float = 0.0) -> Pose:
    return Pose(position=_vector(*[*position, 0.0, 0.0, 0.0][:3]), orientation=_turn(yaw))


def _turn(yaw: float) -> Quaternion:
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def _text(words: str, at: Iterable[float], color: Color, above: float = 0.0) -> TextPrimitive:
    pose = _pose(at)
    pose.position.z += above
    return TextPrimitive(pose=pose, billboard=True, font_size=14.0, scale_invariant=True, color=color, text=words)
