"""Tracking from scan to scan: a person within the bounds stays inside the occupied cells, even if hidden before."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from brakeline.errors import BadScan
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import scan_message, scan_of
from brakeline.safety.filter.request import ALLOWED
from brakeline.safety.perception import scan_free_space, scan_tracking
from brakeline.safety.perception.occlusion_exits import occlusion_exits
from brakeline.safety.perception.scan_coverage import gaps_and_motions
from brakeline.safety.perception.scan_free_space import OccupiedCells, occupied_cells
from brakeline.safety.perception.scan_tracking import ScanTracker
from brakeline.safety.perception.visibility_memory import FanMemory
from tests.robots import GROUND
from tests.safety.asked import request
from tests.safety.test_scan_free_space import FAN, FAR, WIDTH, cast

SPEED, PUSH, SIZE = 1.2, 1.0, 0.2  # m/s, m/s², m
DT = GROUND.period
AHEAD = (0.1, 0.2, 0.4, 0.6)  # s
ROOM = [Obstacle("wall", (-3.0 * math.cos(a), -3.0 * math.sin(a)), yaw=a) for a in np.arange(4) * math.pi / 2]


def taken(obstacles, at, rng, **more):
    """Return a scan from a true position, with errors within the stated bounds."""
    ranges = cast(obstacles, at, FAN)
    noise = np.clip(rng.normal(0.0, 0.01, len(FAN)), -0.02, 0.02)
    ranges = np.where(ranges < FAR, np.clip(ranges + noise, 1e-3, FAR), FAR)
    pose = (*(at + rng.uniform(-0.01, 0.01, 2)).tolist(), float(rng.uniform(-0.02, 0.02)))
    known = {"position_error": 0.0142, "heading_error": 0.02, "range_error": 0.02, "least_width": WIDTH, "far": FAR}
    return Scan(ranges, FAN, pose, speed=SPEED, acceleration=PUSH, least_radius=SIZE, **known, **more)


def disc(place):
    return Obstacle("cylinder", (float(place[0]), float(place[1])), (SIZE,))


# --- persons stay inside the occupied cells -------------------------------------------------------------------------


def starts(rng, sensor, still):
    """Return a person's path: stand, then come at the largest acceleration and speed."""
    way = rng.uniform(0.0, math.tau)
    begin = sensor + rng.uniform(0.5, 1.1) * np.array([math.cos(way), math.sin(way)])
    wait = rng.uniform(0.3, 1.4)

    def at(t):
        t = max(0.0, t - wait)
        gone = 0.5 * PUSH * min(t, SPEED / PUSH) ** 2 + SPEED * max(0.0, t - SPEED / PUSH)
        return begin + gone * (sensor - begin) / np.linalg.norm(sensor - begin)

    return at


def turns(rng, sensor, still):
    """Return a person's path: pass by, then turn to the sensor at the largest acceleration."""
    way, side = rng.uniform(0.0, math.tau), rng.choice([-1.0, 1.0])
    begin = sensor + rng.uniform(0.6, 1.3) * np.array([math.cos(way), math.sin(way)])
    velocity = side * rng.uniform(0.3, SPEED) * np.array([-math.sin(way), math.cos(way)])
    begin, wait, step = begin - velocity * 0.9, rng.uniform(0.6, 1.4), 0.01
    places = [begin]
    for k in range(400):
        if k * step >= wait:
            wanted = SPEED * (sensor - places[-1]) / max(np.linalg.norm(sensor - places[-1]), 1e-9)
            change = wanted - velocity
            velocity = velocity + change * min(1.0, PUSH * step / max(np.linalg.norm(change), 1e-9))
        places.append(places[-1] + step * velocity)
    return lambda t: places[round(t / step)]


def comes_out(rng, sensor, still):
    """Return a person's path: straight at full speed past an obstacle that hides the person."""
    hiding = still[int(rng.integers(len(still)))]
    off = np.array(hiding.position) - sensor
    out = off / np.linalg.norm(off)
    across = rng.choice([-1.0, 1.0]) * np.array([-out[1], out[0]])
    behind = np.array(hiding.position) + (hiding.size[0] + SIZE + rng.uniform(0.02, 0.8)) * out
    aim = np.array(hiding.position) + (hiding.size[0] + SIZE + 0.02) * across - rng.uniform(0.0, 0.5) * out
    way = (aim - behind) / np.linalg.norm(aim - behind)
    begin = behind - way * SPEED * rng.uniform(0.0, 0.9)
    return lambda t: begin + SPEED * t * way


def outside(rng, kind):
    """Return the largest distance [m] of a person's edge from all occupied cells."""
    sensor, drives = rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.2, 0.2, 2)
    still = []
    while kind is comes_out and len(still) < 2:  # only these paths need something to hide behind
        obstacle = Obstacle("cylinder", tuple((sensor + rng.uniform(-1.3, 1.3, 2)).tolist()), (rng.uniform(0.1, 0.35),))
        if Shapes.of([*still, obstacle], 2).distance(sensor).min() > 0.3:
            still.append(obstacle)
    at = kind(rng, sensor, still)
    walls = Shapes.of([*ROOM, *still], 2)
    memory, worst = FanMemory(GROUND.footprint), -math.inf
    ring = np.linspace(0.0, math.tau, 24, endpoint=False)
    around = SIZE * np.column_stack([np.cos(ring), np.sin(ring)])
    for k in range(9):
        now, place = k * DT, sensor + drives * k * DT
        scan = memory.fill(taken([*ROOM, *still, disc(at(now))], place, rng), DT)
        way = np.array([at(now + t) for t in np.arange(0.0, AHEAD[-1] + 0.01, 0.05)])
        if (walls.distance(way).min(axis=0) < SIZE).any() or np.linalg.norm(way - place, axis=1).min() < SIZE + 0.1:
            continue  # the person would go through something
        near = (
            occupied_cells(scan, 2.0)
            if kind is comes_out
            else scan_free_space._unseen_cells(scan, 2.0, *gaps_and_motions(scan))
        )
        for t in AHEAD:
            points = at(now + t) + around
            points = points[np.linalg.norm(points - place, axis=1) < 1.2]
            worst = max(worst, away(points, near, t).max(initial=-math.inf))
    return worst


def away(points, near: OccupiedCells, t):
    """Return the distance [m] from each point to all that may be occupied t s after the scan."""
    least = np.full(len(points), math.inf)
    for corners, error, (cx, cy, v, a) in zip(near.corners, near.error, near.motions, strict=True):
        least = np.minimum(least, off(points - t * np.array([cx, cy]), corners) - error.max() - v * t - 0.5 * a * t * t)
    return least


def off(points, corners):
    """Return distances to the convex hull of corners, with SciPy's hull."""
    corners = np.unique(corners.round(9), axis=0)
    flat = len(corners) < 3 or np.linalg.matrix_rank(corners - corners[0], tol=1e-6) < 2
    if not flat:
        corners = corners[ConvexHull(corners).vertices]  # counter-clockwise
    inside, least = np.full(len(points), not flat), np.full(len(points), math.inf)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side, along = b - a, points - a
        share = np.clip(along @ side / max(side @ side, 1e-18), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(along - share[:, None] * side, axis=1))
        inside &= side[0] * along[:, 1] - side[1] * along[:, 0] >= 0.0
    return np.where(inside, 0.0, least)


@settings(max_examples=25)
@given(st.integers(0, 100_000), st.sampled_from([starts, turns, comes_out]))
def test_a_person_within_the_bounds_stays_inside_the_occupied_cells(seed, kind):
    assert outside(np.random.default_rng(seed), kind) <= 1e-6


def standing(scan, motions=scan_free_space.possible_motions):
    """A mutant: standing surfaces never move."""
    bounds = motions(scan)
    return np.where((bounds[:, :2] == 0.0).all(axis=1)[:, None] & (bounds[:, 3:] > 0.0), 0.0, bounds)


def exact(scan, motions=scan_free_space.possible_motions):
    """A mutant: measured velocities are exact and constant."""
    return np.where(motions(scan)[:, 3:] > 0.0, motions(scan) * [1.0, 1.0, 0.0, 0.0], motions(scan))


def none(scan, *rest, exits=scan_free_space._exit_cells):
    """A mutant: nothing comes out of a shadow."""
    return exits(scan, *rest).take(np.zeros(0, dtype=int))


@pytest.mark.parametrize(
    ("kind", "name", "mutant"),
    [(starts, "possible_motions", standing), (turns, "possible_motions", exact), (comes_out, "_exit_cells", none)],
)
def test_a_mutated_bound_loses_the_person(monkeypatch, kind, name, mutant):
    monkeypatch.setattr(scan_free_space, name, mutant)
    assert any(outside(np.random.default_rng(seed), kind) > 0.02 for seed in range(25))


def test_what_no_beam_hits_may_be_faster_than_the_surfaces_behind_it():
    """Between two beams 2.9° apart, a box of the least width comes unseen to within 2 m, and stays in the cells."""
    fan = np.linspace(-math.pi, math.pi, 124, endpoint=False)
    between, memory = 0.5 * (fan[62] + fan[63]), FanMemory(GROUND.footprint)
    way = np.array([math.cos(between), math.sin(between)])
    known = {"far": FAR, "range_error": 0.0, "least_width": WIDTH, "speed": 2.0, "acceleration": PUSH}
    for now in DT * np.arange(4):
        at = (2.9 - 1.1 * now - 0.5 * PUSH * now**2) * way
        ranges = cast([Obstacle("box", tuple(at), (WIDTH, WIDTH), between)], np.zeros(2), fan, 3.0)
        assert (ranges == 3.0).all(), "of the wall behind it"
        scan = memory.fill(Scan(ranges, fan, (0.0, 0.0, 0.0), **known), DT)
    assert scan.tracks.track_index.all()
    gone = 1.7 * 0.3 + 0.5 * PUSH * 0.3**2 + 2.0 * 0.3  # in 0.6 s, from 1.7 m/s on
    assert away((at - (gone + 0.5 * WIDTH) * way)[None], occupied_cells(scan, 2.5), 0.6)[0] <= 0.0


# --- tracks ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("missing", "doubt", "followed"), [(0, 0, True), (1, 0, False), (0, 1, False)])
def test_no_group_is_tracked_across_a_missing_scan_or_with_doubted_beams(missing, doubt, followed):
    """Otherwise a group could be matched to another's place."""
    rng, follower, now = np.random.default_rng(0), ScanTracker(), 0.0
    for k in range(5):
        scan = taken([*ROOM, disc(np.array([1.0, -0.5 + 0.8 * now]))], np.zeros(2), rng, doubt=doubt)
        tracks = follower.follow(scan).tracks
        passed = DT * (1 + missing * (k == 3))
        now += passed
        follower.later(passed)
    assert bool((np.abs(tracks.motions[:, :2]).max(axis=1) > 0.4).any()) is followed


def followed(world):
    """Return the last scan of a world that changes with time, from a standing sensor."""
    memory, rng = FanMemory(GROUND.footprint), np.random.default_rng(0)
    for k in range(4):
        scan = memory.fill(taken(world(k * DT), np.zeros(2), rng), DT)
    return scan


def test_the_tracker_separates_standing_surfaces_from_moving_groups():
    pillar = Obstacle("cylinder", (0.8, 0.0), (0.15,))
    velocity = np.array([0.5, -0.3])
    scan = followed(lambda t: [*ROOM, pillar, disc(np.array([-1.0, 0.6]) + t * velocity)])
    which, ways = scan.tracks.track_index, scan.tracks.motions
    hit = np.abs(scan.ranges * np.cos(FAN) - 0.8) < 0.16
    hit &= np.abs(scan.ranges * np.sin(FAN)) < 0.1
    (stood,) = set(which[hit])
    assert stood and not ways[stood - 1, :2].any() and 0.2 < ways[stood - 1, 2] < 0.5 and ways[stood - 1, 3] == PUSH
    there = np.array([-1.0, 0.6]) + 3 * DT * velocity
    at = np.column_stack([np.cos(FAN), np.sin(FAN)]) * scan.ranges[:, None]
    (moved,) = set(which[np.linalg.norm(at - there, axis=1) < SIZE + 0.05]) - {0, stood}
    assert np.linalg.norm(ways[moved - 1, :2] - velocity) < 0.15 and ways[moved - 1, 2] < 0.5


def test_a_group_that_comes_into_the_field_of_view_has_no_velocity_yet():
    """The middle of what is seen of it is slower than the group itself."""
    memory, rng, across = FanMemory(GROUND.footprint), np.random.default_rng(0), np.array([1.0, 0.0])
    ahead, tracked = np.abs(FAN) < math.radians(135.5), 0
    for k in range(12):
        at = np.array([-1.6, 0.8]) + k * DT * across
        whole = taken([*ROOM, Obstacle("cylinder", tuple(at), (0.38,))], np.zeros(2), rng)
        scan = memory.fill(replace(whole, ranges=whole.ranges[ahead], angles=whole.angles[ahead]), DT)
        for motion in scan.tracks.motions[np.abs(scan.tracks.motions[:, 0]) > 0.1]:
            tracked += 1
            assert np.linalg.norm(motion[:2] - across) <= motion[2] + 0.1  # the pose has errors, too
    assert tracked > 0


def test_an_ambiguous_group_is_not_tracked():
    """The group ahead may have been either of the two before. The group behind was too far from the other."""
    velocity, legs = np.array([0.5, 0.0]), [np.array([-0.5, 0.8]), np.array([-0.25, 0.8])]
    world = [lambda t, leg=leg: Obstacle("cylinder", tuple(leg + t * velocity), (0.06,)) for leg in legs]
    for some, count in ((world, 1), (world[:1], 1), (world[1:], 1)):
        scan = followed(lambda t, some=some: [*ROOM, *(one(t) for one in some)])
        assert np.count_nonzero(scan.tracks.motions[:, 0]) == count


def test_a_new_surface_may_go_anywhere_and_without_bounds_nothing_is_tracked():
    new = followed(lambda t: [*ROOM, *([disc((0.8, 0.0))] if t > 2.5 * DT else [])])
    assert not new.tracks.track_index[np.abs(FAN) < 0.1].any() and new.tracks.track_index[np.abs(FAN) > 0.5].any()
    scan = taken(ROOM, np.zeros(2), np.random.default_rng(0))
    for unknown in (replace(scan, acceleration=0.0), replace(scan, speed=0.0)):
        assert scan_tracking.ScanTracker().follow(unknown) is unknown


def test_tracks_age_while_no_scan_comes():
    memory, rng = FanMemory(GROUND.footprint), np.random.default_rng(0)
    for _ in range(4):
        last = memory.fill(taken(ROOM, np.zeros(2), rng), DT)
    missed = memory.fill(None, DT)
    assert missed.age == pytest.approx(DT) and missed.tracks is last.tracks
    memory.reset()
    assert not memory.fill(taken(ROOM, np.zeros(2), rng), DT).tracks.track_index.any()


def test_a_hidden_person_needs_room_behind_the_surface():
    """The narrower the pillar, the farther behind it the shadow is wide enough for a person."""
    angles, free = np.radians(np.arange(-180.0, 180.0)), np.full(360, FAR)
    width = np.full(360, math.radians(1.0))
    for half, least, most in ((0.2, 1.0, 1.1), (0.1, 1.3, 1.8)):  # the smallest disc is 1.0 and 2.0 m off
        shadow = np.where(np.abs(angles + 0.5 * width) < math.asin(half), 1.0, free)
        near = occlusion_exits(angles, width, shadow, SIZE).near
        assert len(near) == 2 and (least < near).all() and (near < most).all()
        assert (occlusion_exits(angles, width, shadow, 0.0).near == 1.0).all()
    narrow = np.where(np.abs(angles + 0.5 * width) < math.asin(0.05), 1.0, free)
    assert occlusion_exits(angles, width, narrow, SIZE).near.min() > 2.0  # only beyond sight is room: 4 m off


def test_the_filter_allows_driving_past_standing_surfaces_but_not_past_exits(ready, monkeypatch):
    wall = Obstacle("wall", (0.0, -0.55), yaw=math.pi / 2)
    scan = followed(lambda t: [*ROOM, wall])
    assert ready.decide(request(scan=scan)).kind == ALLOWED
    assert ready.decide(request(scan=replace(scan, tracks=None))).kind != ALLOWED
    scan = followed(lambda t: [*ROOM, disc((0.45, 0.6))])
    assert ready.decide(request(scan=scan)).kind != ALLOWED
    monkeypatch.setattr(scan_free_space, "_exit_cells", none)
    assert ready.decide(request(scan=scan)).kind == ALLOWED


def test_tracks_survive_the_wire():
    scan = followed(lambda t: [*ROOM, disc((-1.0 + 0.5 * t, 0.6))])
    got = scan_of(scan_message(scan))
    assert np.array_equal(got.tracks.track_index, scan.tracks.track_index)
    assert np.array_equal(got.tracks.motions, scan.tracks.motions)
    assert (got.acceleration, got.least_radius) == (PUSH, SIZE)
    message = scan_message(scan)
    message.ways.pop()
    with pytest.raises(BadScan):
        scan_of(message)
