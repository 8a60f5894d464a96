"""The displayed map: it shows no occupied space as free, and every mover stays in its discs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.scan import BeamTracks
from brakeline.messaging.sensor_messages import scan_message, scan_of
from brakeline.safety.perception.displayed_map import map_for_display, reserved_boxes
from brakeline.sim.range_sensors import FanScanner
from brakeline.sim.sim_conditions import Perception
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR


def scanned(seed):
    """Return a request with an exact scan from the middle of a room with obstacles, and the arena."""
    rng = np.random.default_rng(seed)
    angles = np.arange(4) * 0.5 * math.pi + rng.uniform(0.0, 1.0, 4)
    places = np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(0.6, 2.5, 4)[:, None]
    obstacles = [Obstacle(CYLINDER, tuple(place), (0.15,)) for place in places[:2]]
    obstacles += [Obstacle(BOX, tuple(place), (0.3, 0.2), yaw=float(rng.uniform(0.0, 3.0))) for place in places[2:]]
    arena, state = staged_arena(*obstacles, half_width=3.0), np.array([0.0, 0.0, 0.7, 0.0, 0.0])
    scan = FanScanner(GROUND, arena, rng, 0.0, Perception("scan")).scan(state, state, 0.0)
    return pb.Request(state=state, scan=scan_message(scan)), arena


@pytest.mark.parametrize("seed", range(5))
def test_space_drawn_as_free_is_free_and_hits_lie_on_surfaces(seed):
    request, arena = scanned(seed)
    about = map_for_display(GROUND, request, corners=60)
    assert 20 < len(about.free) <= 60 and len(about.hits) > 100
    assert np.abs(arena.shapes.distance(about.hits).min(axis=0)).max() < 1e-5
    corners, sensor = about.free, np.array([-0.032 * math.cos(0.7), -0.032 * math.sin(0.7)])
    rng = np.random.default_rng(seed)
    k, share = rng.integers(len(corners), size=2000), rng.random((2000, 1))
    edge = corners[k] + share * (np.roll(corners, -1, axis=0)[k] - corners[k])
    inside = sensor + np.sqrt(rng.random((2000, 1))) * (edge - sensor)
    assert arena.shapes.distance(inside).min() > 0.0
    assert np.linalg.norm(corners - sensor, axis=1).max() > 1.5, "some space is free"


def test_a_request_without_scan_and_obstacles_has_an_empty_map():
    local_map = map_for_display(GROUND, pb.Request(state=[0.0] * 5))
    assert all(values == [] for values in local_map.flat().values())


def test_the_discs_contain_every_position_of_a_mover():
    motion = Motion((0.5, -0.2), 0.03, 0.05, acceleration=1.0, age=0.1)
    crate = Obstacle(BOX, (1.0, 0.5), (0.4, 0.3), yaw=0.4, motion=motion)
    request = pb.Request(obstacles=obstacle_messages([crate, Obstacle(CYLINDER, (0.0, 1.0), (0.2,))]))
    about = map_for_display(GROUND, request)
    assert about.movers.shape == (1, 3) and about.swept.shape == (1, GROUND.horizon, 3)
    assert about.movers[0] == pytest.approx((1.0, 0.5, math.hypot(0.2, 0.15)))
    rng = np.random.default_rng(0)
    for k, (x, y, radius) in enumerate(about.swept[0], 1):
        t = 0.1 + k * GROUND.period
        ways = rng.normal(size=(3, 500, 2))
        ways /= np.linalg.norm(ways, axis=2, keepdims=True)
        place = np.array([1.0, 0.5]) + 0.03 * ways[0]
        place += t * (np.array([0.5, -0.2]) + 0.05 * ways[1]) + 0.5 * t * t * ways[2]
        away = np.linalg.norm(place - (x, y), axis=1) + math.hypot(0.2, 0.15)
        assert away.max() <= radius + 1e-9 and away.max() > radius - 0.1


def test_the_flat_map_of_a_flying_mover_has_the_radius_last():
    plane = Obstacle("sphere", (1.0, 2.0, 3.0), (0.5,), motion=Motion((0.0, 1.0, 0.0), 0.1, speed=1.0))
    request = pb.Request(obstacles=obstacle_messages([plane]))
    assert map_for_display(QUADROTOR, request).flat()["movers"] == [[1.0, 2.0, 3.0, 0.5]]


def test_the_reserved_boxes_are_the_new_ones_or_the_rest_of_the_old_ones():
    old, new = (pb.Reservation(center=[x, 0.0], half_width=[0.1, 0.2], radius=[0.15]) for x in (1.0, 2.0))
    exchange = pb.Exchange(request=pb.Request(reservation=old))
    assert reserved_boxes(GROUND, exchange).tolist() == [[1.0, 0.0, 0.1, 0.2, 0.15]]
    exchange.reply.decision.reservation.CopyFrom(new)
    assert reserved_boxes(GROUND, exchange)[0, 0] == 2.0
    exchange.reply.decision.reservation.radius.append(1.0)
    assert len(reserved_boxes(GROUND, exchange)) == 0, "the sizes do not match"


def test_a_tracked_surface_is_drawn_where_it_may_go():
    request, _ = scanned(0)
    plain = map_for_display(GROUND, request)
    scan = scan_of(request.scan)
    near = int(np.argmin(scan.ranges))
    which = np.zeros(len(scan.ranges), np.uint8)
    which[near - 2 : near + 3] = 1
    which[:20] = 2  # stands
    ways = np.array([[0.5, 0.0, 0.3, 1.0], [0.0, 0.0, 0.4, 1.0]])
    request.scan.CopyFrom(scan_message(replace(scan, tracks=BeamTracks(which, ways))))
    about = map_for_display(GROUND, request)
    assert len(plain.movers) == 0 and about.movers.shape == (1, 3) and about.swept.shape == (1, GROUND.horizon, 3)
    assert np.linalg.norm(plain.hits - about.movers[0, :2], axis=1).min() < 0.05
    ends = about.swept[0]
    assert np.allclose(np.diff(ends[:, 0]), 0.5 * GROUND.period)
    assert ends[0, 2] - about.movers[0, 2] == pytest.approx(0.3 * 0.2 + 0.5 * 0.2**2)
