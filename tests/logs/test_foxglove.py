"""Foxglove scenes: positions, rates, and that a malformed message loses only its scene."""

import importlib
import json
import math
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

import brakeline.logs
from brakeline.logs import foxglove_scene
from brakeline.logs.foxglove import ArenaLayout, FoxgloveConverter
from brakeline.logs.reader import read
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.logs.segment import Entry
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.topics import EXCHANGE, STEP
from tests.logs.conftest import Say
from tests.robots import GROUND, QUADROTOR

WALLS = [pb.Obstacle(kind="wall", position=(-5 * math.cos(a), -5 * math.sin(a)), yaw=a) for a in (0.0, 1.5707963)]
OBSTACLES = [
    pb.Obstacle(kind="cylinder", position=(1.0, 2.0), size=(0.3,)),
    pb.Obstacle(kind="box", position=(-2.0, 1.0), size=(0.4, 0.6), yaw=0.5),
    *WALLS,
]


KEY = "ground/actor-0"


def episode(actor: str = "actor-0", robot: str = "ground", number: int = 0, **more: Any) -> pb.Episode:
    about: dict[str, Any] = {"obstacles": OBSTACLES, "goal": (4.0, 4.0), "goal_radius": 0.25, "start": (0.0,) * 5}
    return pb.Episode(robot=robot, actor=actor, episode=number, **(about | more))


def step(number: int, kind: int = pb.ALLOWED, actor: str = "actor-0", robot: str = "ground", **more: Any) -> pb.Step:
    about: dict[str, Any] = {"state": (0.1 * number, -0.5, math.pi / 2, 0.2, 0.0), "next_observation": [1.0] * 26}
    return pb.Step(robot=robot, actor=actor, step=number, decision=kind, **(about | more))


def exchange(number: int, kind: int = pb.ALLOWED) -> pb.Exchange:
    decision = pb.Decision(
        kind=kind, tube_center=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6), tube_half_width=(0.01, 0.02, 0.03, 0.04, 0.05, 0.06)
    )
    request = pb.Request(robot="ground", actor="actor-0", step=number, state=(0.0, 0.1, 0.0, 0.0, 0.0))
    return pb.Exchange(request=request, reply=pb.Reply(decision=decision))


class Studio:
    """Converts messages and decodes the resulting scenes."""

    def __init__(self, say: Say, rate: float = math.inf) -> None:
        self.say, self.pictures = say, FoxgloveConverter(rate)
        self.entries: list[Entry] = []

    def __call__(self, key: str, message: Any) -> dict[str, Any]:
        new = self.pictures.from_sample(self.say(key, message))
        self.entries += new
        return {entry.key: entry.type.FromString(entry.payload) for entry in new}


@pytest.fixture
def studio(say: Say) -> Studio:
    """A studio that has drawn the episode of an actor."""
    studio = Studio(say)
    studio(f"episode/{KEY}", episode())
    return studio


def entities(update: SceneUpdate) -> dict[str, Any]:
    return {entity.id: entity for entity in update.entities}


def test_an_episode_shows_its_obstacles_walls_and_goal_where_they_are(studio: Studio) -> None:
    drawn = studio(f"episode/{KEY}", episode())
    assert set(drawn) == {f"foxglove/arena/{KEY}", f"foxglove/frames/{KEY}"}
    room = entities(drawn[f"foxglove/arena/{KEY}"])["arena"]
    assert room.frame_id == "actor-0"
    pillar, goal = room.cylinders
    assert (pillar.pose.position.x, pillar.pose.position.y) == (1.0, 2.0) and pillar.size.x == pillar.size.y == 0.6
    assert (goal.pose.position.x, goal.size.x) == (4.0, 0.5)
    box, *walls = room.cubes
    assert (box.size.x, box.size.y) == (0.4, 0.6) and box.pose.orientation.z == pytest.approx(math.sin(0.25))
    assert len(walls) == 2 and all(wall.size.y == 10.0 for wall in walls)
    # A wall's free side is the plane through its position: all of what is drawn lies behind it.
    assert walls[0].pose.position.x + walls[0].size.x / 2 == pytest.approx(-5.0)
    body = entities(drawn[f"foxglove/arena/{KEY}"])["body"]
    assert body.frame_locked and body.frame_id == "actor-0/body" and body.cylinders[0].size.x == 2 * GROUND.footprint


def test_a_step_shows_the_robot_its_tube_and_its_lidar(studio: Studio) -> None:
    assert studio(f"exchange/{KEY}", exchange(3, pb.ADJUSTED)) == {}
    drawn = studio(f"step/{KEY}", step(3, pb.ADJUSTED))
    place, body = drawn[f"foxglove/frames/{KEY}"].transforms
    assert (place.parent_frame_id, place.child_frame_id) == ("world", "actor-0")
    assert (body.parent_frame_id, body.child_frame_id) == ("actor-0", "actor-0/body")
    assert (body.translation.x, body.translation.y) == pytest.approx((0.3, -0.5))
    assert (body.rotation.z, body.rotation.w) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    shown = entities(drawn[f"foxglove/decision/{KEY}"])["decision"]
    assert [(cube.pose.position.x, cube.pose.position.y) for cube in shown.cubes] == [
        (0.1, 0.2),
        (0.3, 0.4),
        (0.5, 0.6),
    ]
    assert [(cube.size.x, cube.size.y) for cube in shown.cubes] == [(0.02, 0.04), (0.06, 0.08), (0.1, 0.12)]
    stop = shown.cylinders[0]
    assert stop.size.x / 2 == pytest.approx(math.hypot(0.05, 0.06) + GROUND.footprint)
    assert [(p.x, p.y) for p in shown.lines[0].points] == [(0.0, 0.1), (0.1, 0.2), (0.3, 0.4), (0.5, 0.6)]
    assert shown.texts[0].text == "adjusted"
    scan = drawn[f"foxglove/lidar/{KEY}"]
    assert isinstance(scan, LaserScan) and list(scan.ranges) == [3.5] * 18
    assert (scan.start_angle, scan.end_angle) == pytest.approx((-math.pi / 2, math.pi / 2))


def test_a_tube_is_drawn_with_its_own_step_though_its_exchange_comes_later(studio: Studio) -> None:
    studio(f"exchange/{KEY}", exchange(0))
    assert set(studio(f"step/{KEY}", step(1))) == set(), "exchange 1 is on its way"
    assert f"foxglove/decision/{KEY}" in studio(f"exchange/{KEY}", exchange(1))
    studio(f"exchange/{KEY}", exchange(3))
    shown = studio(f"step/{KEY}", step(2))[f"foxglove/decision/{KEY}"]
    assert not shown.entities[0].cubes, "the tube of step 3 is not that of step 2"


def test_without_a_filter_and_without_an_answer_there_is_a_picture_too(studio: Studio) -> None:
    shown = studio(f"step/{KEY}", step(0, pb.UNKNOWN))[f"foxglove/decision/{KEY}"].entities[0]
    assert not shown.cubes and not shown.texts
    lost = exchange(1)
    lost.ClearField("reply")
    studio(f"exchange/{KEY}", lost)
    shown = studio(f"step/{KEY}", step(1, pb.FAILSAFE, fallback=True))[f"foxglove/decision/{KEY}"]
    assert shown.entities[0].texts[0].text == "no answer in time: braked along the plan verified before"


@pytest.mark.parametrize(("rate", "kinds"), [(0.1, {50: pb.FAILSAFE, 51: pb.ADJUSTED, 52: pb.ADJUSTED}), (1.0, None)])
def test_calm_steps_are_thinned_out_and_each_kind_of_intervention_too(
    say: Say, rate: float, kinds: dict[int, int] | None
) -> None:
    """Messages come every second. With a rate of 1 Hz, as of a real robot, all interventions are drawn."""
    studio = Studio(say, rate)
    studio(f"episode/{KEY}", episode())
    for number in range(100):
        kind = pb.ADJUSTED if kinds is None else kinds.get(number, pb.ALLOWED)
        studio(f"exchange/{KEY}", exchange(number, kind))
        studio(f"step/{KEY}", step(number, kind))
    drawn = Counter(entry.key.split("/")[1] for entry in studio.entries)
    assert drawn["decision"] == drawn["lidar"]
    scenes = [SceneUpdate.FromString(one.payload) for one in studio.entries if "/decision/" in one.key]
    words = [text.text for scene in scenes for text in scene.entities[0].texts]
    if kinds is None:
        assert words == ["adjusted"] * 100
    else:
        assert 2 + 18 <= drawn["decision"] <= 2 + 20  # a step comes every 2 s
        assert words == ["failsafe", "adjusted"], "the first of each kind is drawn at once"


def test_a_scene_has_the_time_of_receipt_and_no_sequence_number(studio: Studio, say: Say) -> None:
    sample = say(f"episode/{KEY}", episode())
    for entry in studio.pictures.from_sample(sample):
        assert entry.log_time == entry.publish_time == sample.received and entry.sequence == 0
    arena = SceneUpdate.FromString(studio.pictures.from_sample(sample)[0].payload)
    at = arena.entities[0].timestamp
    assert at.seconds * 10**9 + at.nanos == sample.received


def test_arenas_of_several_actors_do_not_overlap() -> None:
    layout = ArenaLayout()
    squares = [(layout.position("ground", f"a{i}", 10.0), 10.0) for i in range(3)]
    squares += [(layout.position("quadrotor", f"q{i}", 40.0), 40.0) for i in range(2)]
    for i, ((x, y), edge) in enumerate(squares):
        for (u, v), other in squares[:i]:
            assert max(abs(x - u), abs(y - v)) >= (edge + other) / 2
    assert layout.position("ground", "a1", 10.0) == squares[1][0], "an actor keeps its place"


def test_the_quadrotors_rays_are_a_cloud_of_the_points_that_were_hit() -> None:
    rays = QUADROTOR.task.rays
    observation = np.ones(QUADROTOR.task.observation_dim)
    observation[7] = 0.25
    cloud = foxglove_scene.lidar(rays, "actor-0", observation.tolist(), 5)
    assert isinstance(cloud, PointCloud) and cloud.point_stride == 12 and len(cloud.data) == 12
    assert struct.unpack("<3f", cloud.data) == pytest.approx(rays.directions[7] * 0.25 * rays.range, abs=1e-6)
    state = [1.0, 2.0, 3.0] + [0.0] * 6
    decision = pb.Decision(tube_center=[1.0, 2.0, 3.0] * 12, tube_half_width=[0.1] * 36)
    exchange = pb.Exchange(request=pb.Request(state=state), reply=pb.Reply(decision=decision))
    shown = foxglove_scene.decision(QUADROTOR, pb.Step(actor="a", state=state), exchange, 5).entities[0]
    assert len(shown.cubes) == 12 and shown.cubes[3].pose.position.z == 3.0 and shown.spheres
    body = foxglove_scene.frames(QUADROTOR, "a", (0.0, 0.0), state, 5).transforms[1]
    assert (body.translation.z, body.rotation.w) == (3.0, 1.0)


def test_a_robot_in_real_time_is_drawn_as_any_other(studio: Studio) -> None:
    key = "ground-late/actor-0"
    studio(f"episode/{key}", episode(robot="ground-late"))
    assert f"foxglove/lidar/{key}" in studio(f"step/{key}", step(0, pb.UNKNOWN, robot="ground-late"))
    assert studio.pictures.failures == 0


def test_a_room_in_space_is_drawn_without_its_lid() -> None:
    lid = pb.Obstacle(kind="box", position=(0.0, 0.0, 5.0), size=(14.0, 14.0, 2.0))
    walls = [pb.Obstacle(kind="wall", position=(*wall.position, 2.0), yaw=wall.yaw) for wall in WALLS]
    ball = pb.Obstacle(kind="sphere", position=(1.0, 1.0, 1.0), size=(0.5,))
    room = foxglove_scene.arena(
        QUADROTOR, episode(robot="quadrotor", obstacles=[ball, *walls, lid], goal=(4, 4, 2), start=(0,) * 9), 5
    ).entities[0]
    assert len(room.cubes) == 2 and room.cubes[0].size.z == 4.0, "two walls up to the ceiling, and no ceiling"
    assert {(ball.pose.position.z, ball.size.x) for ball in room.spheres} == {(1.0, 1.0), (2.0, 0.5)}


def test_log_lines_are_foxgloves(studio: Studio) -> None:
    drawn = studio("log/learner", pb.LogLine(process="learner", level="WARNING", text="slow"))
    line = drawn["foxglove/log"]
    assert isinstance(line, Log) and (line.level, line.name, line.message) == (Log.WARNING, "learner", "slow")


def test_a_message_that_cannot_be_drawn_costs_its_picture_only(say: Say, caplog: pytest.LogCaptureFixture) -> None:
    pictures = FoxgloveConverter()
    pictures.from_sample(say(f"episode/{KEY}", episode()))
    bad = [
        Sample(STEP, f"step/{KEY}", b"\xff\xff", 1),
        say("episode/submarine/actor-1", episode("actor-1", "submarine")),
        say(f"step/{KEY}", step(0, pb.UNKNOWN, state=(1.0,))),
    ]
    assert [pictures.from_sample(sample) for sample in bad] == [[], [], []]
    assert pictures.failures == 3 and len(caplog.records) == 1
    assert pictures.from_sample(say(f"step/{KEY}", step(1, pb.UNKNOWN)))


def test_a_recording_has_the_pictures_beside_the_messages(say: Say, tmp_path: Path) -> None:
    inbox = Inbox()
    recording = Recording(LogSettings(tmp_path / "run.mcap", derive=FoxgloveConverter(math.inf).from_sample), inbox)
    messages = [("episode", episode()), ("exchange", exchange(0)), ("step", step(0))]
    for topic, message in messages:
        inbox.put(say(f"{topic}/ground/actor-0", message))
    recording.finish()
    assert dict(recording.recorded) == {f"{topic}/ground/actor-0": 1 for topic, _ in messages}
    assert {record.topic for record in read(tmp_path)} == {"episode", "exchange", "step"}, "no pictures"


@pytest.fixture
def whole(studio: Studio) -> Studio:
    """A studio that has drawn one message of each kind."""
    studio(f"exchange/{KEY}", exchange(0))
    studio(f"step/{KEY}", step(0))
    studio("log/a", pb.LogLine(text="x"))
    return studio


def test_all_schemas_are_foxgloves_well_known_ones(whole: Studio) -> None:
    known = importlib.import_module("foxglove.messages")
    types = {entry.type for entry in whole.entries} | {PointCloud}
    assert types == {SceneUpdate, FrameTransforms, LaserScan, Log, PointCloud}
    for kind in types:
        package, name = kind.DESCRIPTOR.full_name.split(".")
        assert package == "foxglove" and hasattr(known, name)


def test_the_layout_speaks_of_topics_and_fields_that_there_are(whole: Studio) -> None:
    roots = {entry.key.rsplit("/", 2)[0] for entry in whole.entries} - {"foxglove"}
    layout = json.loads((Path(brakeline.logs.__file__).parent / "brakeline.foxglove-layout.json").read_text())
    panels = layout["configById"]
    topics = panels["3D!scene"]["topics"]
    assert {topic.rsplit("/", 2)[0] for topic in topics} == roots - {"foxglove/frames"}
    assert {topic.split("/")[2] for topic in topics} == {"ground", "quadrotor"}
    assert panels["RosOut!log"]["topicToRender"] == "foxglove/log"
    kinds = {"step": STEP.message, "exchange": EXCHANGE.message}
    paths = [path["value"] for name, panel in panels.items() for path in panel.get("paths", ())]
    assert len(paths) == 8
    for path in paths:
        topic, *fields = path.split(".")
        descriptor = kinds[topic.split("/")[0]].DESCRIPTOR
        for field in fields:
            described = descriptor.fields_by_name[field]
            descriptor = described.message_type
    placed = json.dumps(layout["layout"])
    assert all(f'"{name}"' in placed for name in panels)
