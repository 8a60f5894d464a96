"""Decisions from scans alone: the filter keeps off all space that the scan does not show to be free."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from brakeline.errors import BadRequest
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import scan_message, scan_of
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import ALLOWED, FAILSAFE, check_for_filter
from brakeline.safety.perception.image_memory import memory_of
from brakeline.safety.service.client import request_message
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import batch_of, request_of
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import request
from tests.safety.test_scan_free_space import FAN, FAR, WIDTH, cast
from tests.safety.unicycle import FIX, Unicycle

ROOM = [
    *(Obstacle("wall", (-math.cos(a), -math.sin(a)), yaw=a) for a in (0.0, math.pi / 2, math.pi, -math.pi / 2)),
    Obstacle("box", (0.5, 0.3), (0.2, 0.2), 0.4),
    Obstacle("cylinder", (-0.4, -0.5), (0.1,)),
]


def taken(true, measured, rng, blind=0.0):
    ranges = cast(ROOM, true[:2], FAN + true[2])
    ranges = np.where(ranges < FAR, ranges + rng.uniform(-0.01, 0.01, len(FAN)), FAR)
    ranges[np.abs(FAN) > math.pi - blind] = 0.0
    error = {"range_error": 0.01, "position_error": math.sqrt(2) * FIX, "heading_error": FIX}
    return Scan(ranges, FAN, tuple(measured[:3].tolist()), far=FAR, least_width=WIDTH, **error)


def test_a_scan_without_known_beams_leaves_nothing_free_and_obstacles_count_beside_a_clear_one(ready):
    blind, clear = (Scan(np.full(360, far), FAN, (0.0, 0.0, 0.0)) for far in (0.0, FAR))
    decision = ready.decide(request(scan=blind))
    assert decision.kind == FAILSAFE and not decision.plan.any()
    assert ready.decide(request(scan=clear)).kind == ALLOWED
    assert ready.decide(request(scan=clear, obstacles=[Obstacle("cylinder", (0.25, 0.0), (0.1,))])).kind != ALLOWED


def test_a_standing_robot_stays_where_it_is_when_something_comes_near(ready):
    """It must not recover: only a standing obstacle can corner it."""
    for away in (0.25, 0.4, 0.55, -0.25, -0.4, -0.55):
        comes = [Obstacle("cylinder", (away + math.copysign(0.2, away), 0.0), (0.2,))]
        ranges = cast(comes, np.zeros(2), FAN)
        seen = Scan(ranges, FAN, (0.0, 0.0, 0.0), far=FAR, range_error=0.02, least_width=WIDTH, speed=1.2)
        decision = ready.decide(request(action=(0.0, 0.5), scan=seen))
        assert decision.kind == FAILSAFE and not decision.plan.any()


@pytest.mark.parametrize("blind", [0.0, math.radians(30.0)])
def test_a_hostile_driver_touches_nothing_and_is_not_held_for_good(ready, blind):
    rng = np.random.default_rng(1)
    robot, safety, memory = Unicycle((0.0, 0.0, 0.5), rng), InProcess(ready, accept_bound=1.0), memory_of(GROUND)
    shapes, closest, turned = Shapes.of(ROOM, 2), math.inf, 0.0
    for k in range(100):
        state = robot.measure()
        away = shapes.towards(state[:2])
        nearest = away[np.argmin(np.linalg.norm(away, axis=1))]
        turn = math.remainder(math.atan2(nearest[1], nearest[0]) - state[2], math.tau)
        action = (0.25, np.clip(turn / 0.2, -0.5, 0.5)) if k % 40 < 25 else (0.25, 0.5)
        scan = memory.fill(taken(robot.state, state, rng, blind), GROUND.period)
        before = robot.state[2]
        robot.step(safety.decide(state, action, scan=scan).action)
        turned += abs(robot.state[2] - before)
        closest = min(closest, shapes.distance(robot.state[:2]).min())
    assert closest > GROUND.footprint
    assert closest < GROUND.footprint + 0.1 and turned > 1.5


def test_a_scan_crosses_the_wire():
    ranges = np.linspace(0.2, 3.5, 360)
    sent = Scan(ranges, FAN, (1.0, 2.0, 3.0), (-0.03, 0.01), 3.4, 0.03, 0.01, 0.02, 0.15, 2, 1.6, 0.2)
    got = scan_of(scan_message(sent))
    assert np.allclose(got.ranges, sent.ranges) and np.allclose(got.angles, sent.angles)
    names = [field.name for field in fields(Scan) if field.name not in ("ranges", "angles")]
    assert [getattr(got, name) for name in names] == [getattr(sent, name) for name in names]
    message = request_message(BackupPlan(GROUND), np.zeros(5), np.zeros(2), scan=sent)
    assert request_of(message, GROUND).scan is not None and message.ByteSize() < 3500


def asked(robot, scan):
    return request_message(BackupPlan(robot), np.zeros(robot.state_dim), np.zeros(robot.action_dim), scan=scan)


GROUND_SCAN, SPACE_IMAGE = Scan(np.ones(360), FAN, (0.0,) * 3), RangeImage(np.ones((45, 90)), (0.0,) * 3)


@pytest.mark.parametrize(
    ("robot", "sensed", "change", "field"),
    [
        (GROUND, GROUND_SCAN, lambda m: m.scan.ranges.__setitem__(5, -1.0), "scan"),
        (QUADROTOR, GROUND_SCAN, lambda m: None, "scan"),
        (GROUND, SPACE_IMAGE, lambda m: None, "image"),
        (QUADROTOR, SPACE_IMAGE, lambda m: m.image.attitude.pop(), "image"),
        (GROUND, GROUND_SCAN, lambda m: m.image.CopyFrom(asked(QUADROTOR, SPACE_IMAGE).image), "scan"),
    ],
    ids=["negative range", "scan in space", "image in the plane", "malformed image", "both"],
)
def test_a_measurement_that_is_malformed_or_of_another_dimension_is_refused(robot, sensed, change, field):
    message = asked(robot, sensed)
    change(message)
    with pytest.raises(BadRequest) as error:
        check_for_filter(robot, request_of(message, robot))
    assert error.value.field == field
    check_for_filter(QUADROTOR, request_of(asked(QUADROTOR, SPACE_IMAGE), QUADROTOR))  # in space, an image is sound


BY_THRUST = replace(GROUND, action=("thrust [N]", "torque [N m]"))


@pytest.mark.parametrize(
    ("robot", "state", "sensed", "field"),
    [
        (GROUND, [0.4, 0.0, 0.9, 0.2, 0.0], GROUND_SCAN, ""),  # the robot's way in 2 s
        (GROUND, [3.0, 0.0, 0.0, 0.0, 0.0], GROUND_SCAN, "scan"),
        (GROUND, [3.0, 0.0, 0.0, 1.6, 0.0], GROUND_SCAN, ""),  # it is faster than its inputs allow, as downhill
        (GROUND, [3.0, 0.0, 0.0, 0.0, 0.0], replace(GROUND_SCAN, position_error=2.6), ""),
        (GROUND, [3.0, 0.0, 0.0, 0.0, 0.0], replace(GROUND_SCAN, age=2.1), ""),  # so old that it shows no free space
        (GROUND, [0.0, 0.0, 1.57, 0.0, 0.0], GROUND_SCAN, "scan"),
        (GROUND, [0.0, 0.0, 6.28, 0.0, 0.0], GROUND_SCAN, ""),
        (BY_THRUST, [3.0, 0.0, 1.57, 0.0, 0.0], GROUND_SCAN, ""),  # its largest speed is not known
        (QUADROTOR, [10.0] + [0.0] * 8, SPACE_IMAGE, ""),
        (QUADROTOR, [30.0] + [0.0] * 8, SPACE_IMAGE, "image"),
    ],
)
def test_a_measurement_from_a_pose_that_the_robot_cannot_have_come_from_is_refused(robot, state, sensed, field):
    """As with a state in another frame: the measurement would show space elsewhere as free."""
    message = request_message(BackupPlan(robot), state, np.zeros(robot.action_dim), scan=sensed)
    if not field:
        check_for_filter(robot, request_of(message, robot))
        return
    with pytest.raises(BadRequest, match=r"its pose is .* from the state, .*: give both in one frame") as error:
        check_for_filter(robot, request_of(message, robot))
    assert error.value.field == field


@pytest.mark.parametrize(
    ("robot", "sensed", "change"),
    [
        (GROUND, GROUND_SCAN, lambda m: m.scan.ranges.__setitem__(slice(None), [230.0] * 360)),
        (GROUND, GROUND_SCAN, lambda m: setattr(m.scan, "far", 3500.0)),
        (QUADROTOR, SPACE_IMAGE, lambda m: setattr(m.image, "far", 20_000.0)),
    ],
    ids=["ranges in mm", "far in mm", "far of an image in mm"],
)
def test_ranges_in_millimetres_do_not_show_free_space(robot, sensed, change):
    """A range beyond `far` hits nothing: a wall 0.23 m ahead would leave all space free."""
    message = asked(robot, sensed)
    request_of(message, robot)
    change(message)
    with pytest.raises(BadRequest, match="in m"):
        request_of(message, robot)


@pytest.mark.parametrize("far", [3.5, 20.0])
def test_a_masked_beam_shows_no_free_space(far):
    """A driver masks the beams that hit the robot's own mast; NumPy drops a mask without a word."""
    ranges = np.ma.masked_less(np.full((30, 60), far), 100.0)
    assert not Scan(ranges[0], FAN[:60], (0.0,) * 3, far=far).valid_beams.any()
    assert not RangeImage(ranges, (0.0,) * 3, far=far).valid_beams.any()
    ranges.mask = False
    assert RangeImage(ranges, (0.0,) * 3, far=far).valid_beams.all()


def test_a_batch_may_hold_24_images_but_not_48():
    image = RangeImage(np.ones((90, 180)), (0.0, 0.0, 0.0))
    message = request_message(BackupPlan(QUADROTOR), np.zeros(9), np.zeros(3), scan=image)
    assert len(batch_of(pb.RequestBatch(requests=[message] * 24).SerializeToString()).requests) == 24
    with pytest.raises(BadRequest, match="a request batch has at most"):
        batch_of(pb.RequestBatch(requests=[message] * 48).SerializeToString())
