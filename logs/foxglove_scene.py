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

from brakeline.logs.arena_view import closes, half_width
from brakeline.logs.decision_explanation import NO_ANSWER, Explanation
from brakeline.logs.decision_view import DecisionView, decision_view
from brakeline.logs.episode_stats import INTERVENTIONS, KINDS, kind_of
from brakeline.logs.viewer import rgb_color
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


def _color(name: str, alpha: float = 1.0) -> Color:
    red, green, blue = rgb_color(name)
    return Color(r=red / 255, g=green / 255, b=blue / 255, a=alpha)


SOLID, WALLS, GOAL = _color("obstacle-edge"), _color("obstacle-edge", 0.25), _color("goal", 0.35)
PROPOSED, EXECUTED, EDGE = _color("proposed"), _color("executed"), _color("halfspace", 0.5)
FREE, HIT, RESERVED = _color("free"), _color("hit"), _color("reserved", 0.18)
MOVER, SWEPT = _color("mover"), _color("mover", 0.15)
BODY, NOSE, NAME = _color("body"), _color("field"), _color("soft")


def body_frame(actor: str) -> str:
    """Return the name of the frame that is fixed to an actor's body."""
    return f"{actor}/body"


def stamp(time: int) -> Timestamp:
    """Convert ns since the Unix epoch."""
    return Timestamp(seconds=time // 10**9, nanos=time % 10**9)


def arena(robot: Robot, episode: pb.Episode, time: int) -> SceneUpdate:
    """Draw obstacles, walls, goal and the robot's body. Sent once, at the start of an episode."""
    half = half_width(episode)
    room = SceneEntity(timestamp=stamp(time), frame_id=episode.actor, id="arena")
    ceilings = [o.position[2] - 0.5 * o.size[2] for o in episode.obstacles if closes(o, half)]
    height = max(ceilings, default=0.0) or HEIGHT
    for obstacle in episode.obstacles:
        if not closes(obstacle, half):  # a floor or a ceiling would hide the room
            _draw_obstacle(room, obstacle, half, height)
    _round(room, episode.goal[: robot.position_dim], episode.goal_radius, FLAT, GOAL)
    return SceneUpdate(entities=[room, _body(robot, episode.actor, time)])


def _draw_obstacle(room: SceneEntity, obstacle: pb.Obstacle, half: float, height: float) -> None:
    """Add an obstacle; walls and obstacles in the plane get this height."""
    flat = len(obstacle.position) == 2
    position = (*obstacle.position, 0.5 * height) if flat else tuple(obstacle.position)
    if obstacle.kind == WALL:
        x, y = (at - FLAT * turn(obstacle.yaw) for at, turn in zip(position, (math.cos, math.sin), strict=False))
        _cube(room, _pose((x, y, 0.5 * height), obstacle.yaw), (2.0 * FLAT, 2.0 * half, height), WALLS)
    elif obstacle.kind == BOX:
        _cube(room, _pose(position, obstacle.yaw), (*obstacle.size, *([height] if flat else [])), SOLID)
    elif obstacle.kind == CYLINDER or flat:
        _cylinder(room, position, obstacle.size[0], height if flat else obstacle.size[1], SOLID)
    elif obstacle.kind == SPHERE:
        _round(room, position, obstacle.size[0], height, SOLID)


def _body(robot: Robot, actor: str, time: int) -> SceneEntity:
    """Draw the discs or spheres of the body in the body frame."""
    body = SceneEntity(timestamp=stamp(time), frame_id=body_frame(actor), id="body", frame_locked=True)
    tall = 0.5 * HEIGHT
    for disc in robot.body:
        _round(body, disc.at, disc.radius, tall, BODY, lift=0.5 * tall)
    if robot.position_dim == 2:
        _cube(body, _pose((0.5 * robot.front_extent, 0.0, tall)), (robot.front_extent, 2.0 * FLAT, FLAT), NOSE)
    body.texts.append(_text(actor, (0.0, 0.0, HEIGHT + robot.footprint), NAME))
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
    kind = kind_of(step)
    entity = SceneEntity(timestamp=stamp(time), frame_id=step.actor, id="decision")
    color, words = KINDS.get(kind, "unfiltered"), KINDS.get(kind, "")
    if exchange is not None:
        view = decision_view(robot, exchange, reservations)
        start = exchange.request.state[: robot.position_dim]
        if exchange.reply.HasField("decision"):
            _draw_tube(entity, view, start, robot.footprint, color)
        if view.explanation is not None and kind in INTERVENTIONS and not step.fallback:
            words = f"{KINDS[kind]}: {view.explanation.sentence}"
            _draw_explanation(entity, start, view.explanation, robot.footprint)
        if view.perceived is not None:
            _draw_perceived(entity, view.perceived, view.reservations)
    if kind in INTERVENTIONS:
        above = HEIGHT + 3.0 * robot.footprint
        text = NO_ANSWER if step.fallback else words
        entity.texts.append(_text(text, step.state[: robot.position_dim], _color(color), above))
    return SceneUpdate(entities=[entity])


def _draw_tube(entity: SceneEntity, view: DecisionView, start: Sequence[float], footprint: float, color: str) -> None:
    """Add the boxes of the tube, the area where the robot stops, and the plan from the robot through the centers."""
    for center, half in zip(view.centers, view.half_widths, strict=True):
        _cube(entity, _pose(center), _edges(half), _color(color, 0.6))
    if len(view.centers):  # the body is in this disc or sphere, wherever in the last box the robot stops
        stop = math.hypot(*view.half_widths[-1]) + footprint
        _round(entity, view.centers[-1], stop, FLAT, _color(color, 0.2))
    _line(entity, LinePrimitive.LINE_STRIP, (start, *view.centers), 3.0, _color(color))


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
        across = 5.0 * size
        _cube(entity, _along(about.at, about.normal), (FLAT, across, across if len(about.at) == 3 else FLAT), EDGE)


def _draw_perceived(entity: SceneEntity, about: DisplayedMap, reservations: np.ndarray) -> None:
    """Add scan hits, the outline of free space, moving obstacles with their reachable sets, and the reservations."""
    if len(about.free):
        _line(entity, LinePrimitive.LINE_LOOP, about.free, 2.0, FREE)
        _line(entity, LinePrimitive.LINE_LIST, _hit_marks(about.hits), 4.0, HIT)
    swept = about.swept.reshape(-1, about.swept.shape[-1])
    for discs, color, tall in ((about.movers, MOVER, HEIGHT), (swept, SWEPT, FLAT)):
        for *at, radius in discs:
            _round(entity, at, radius, tall, color, lift=0.5 * tall)
    for box in reservations:
        d = len(box) // 2
        _cube(entity, _pose(box[:d]), _edges(box[d:-1] + box[-1]), RESERVED)


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


def frames(robot: Robot, actor: str, site: tuple[float, float], state: Sequence[float], time: int) -> FrameTransforms:
    """Return the transforms from the world to the actor's arena and from the arena to the robot's body."""
    d, yaw = robot.position_dim, 0.0 if robot.heading is None else state[robot.heading]

    def frame(parent: str, child: str, position: Iterable[float], turn: float) -> FrameTransform:
        pose = _pose(position, turn)
        return FrameTransform(
            timestamp=stamp(time),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=pose.position,
            rotation=pose.orientation,
        )

    return FrameTransforms(transforms=[frame(WORLD, actor, site, 0.0), frame(actor, body_frame(actor), state[:d], yaw)])


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


def _cube(entity: SceneEntity, pose: Pose, edges: Iterable[float], color: Color) -> None:
    entity.cubes.append(CubePrimitive(pose=pose, size=_vector(*edges), color=color))


def _cylinder(entity: SceneEntity, at: Iterable[float], radius: float, height: float, color: Color) -> None:
    size = _vector(2.0 * radius, 2.0 * radius, height)
    entity.cylinders.append(CylinderPrimitive(pose=_pose(at), size=size, color=color, bottom_scale=1.0, top_scale=1.0))


def _round(
    entity: SceneEntity, at: Sequence[float], radius: float, height: float, color: Color, lift: float = 0.0
) -> None:
    """Add a sphere in space; in the plane, a cylinder whose middle is at `lift` above the floor, m."""
    if len(at) == 3:
        size = _vector(*[2.0 * radius] * 3)
        entity.spheres.append(SpherePrimitive(pose=_pose(at), size=size, color=color))
    else:
        _cylinder(entity, (*at, lift), radius, height, color)


def _line(
    entity: SceneEntity,
    kind: LinePrimitive.Type.ValueType,
    points: Iterable[Iterable[float]],
    thickness: float,
    color: Color,
) -> None:
    """Add a line whose thickness does not depend on the distance."""
    line = LinePrimitive(type=kind, pose=_pose(()), thickness=thickness, scale_invariant=True, color=color)
    line.points.extend(Point3(**dict(zip("xyz", point, strict=False))) for point in points)
    entity.lines.append(line)


def _edges(half_widths: np.ndarray) -> list[float]:
    """Return the edges of a box; in the plane, it is flat."""
    return [*(2.0 * half_widths), *[FLAT] * (3 - len(half_widths))]


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


def _pose(position: Iterable[float], yaw: float = 0.0) -> Pose:
    turn = Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))
    return Pose(position=_vector(*[*position, 0.0, 0.0, 0.0][:3]), orientation=turn)


def _text(words: str, at: Iterable[float], color: Color, above: float = 0.0) -> TextPrimitive:
    pose = _pose(at)
    pose.position.z += above
    return TextPrimitive(pose=pose, billboard=True, font_size=14.0, scale_invariant=True, color=color, text=words)
