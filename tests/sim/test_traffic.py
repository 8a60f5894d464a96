"""Moving obstacles keep their bounds and avoid static ones, and their measured motion is right; several robots share
one physics.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import NoFleet
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import room_boundary, same_room
from brakeline.sim.arena_generator import draw_arena, draw_fleet
from brakeline.sim.ground_robot import GroundRobot
from brakeline.sim.lidar import Lidar
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.shared_world import FleetEnv, GroundWorld
from brakeline.sim.sim_conditions import Conditions, Perception
from brakeline.sim.traffic import Crowd, CrowdSensor, MoverKind
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

AHEAD = np.array([0.25, 0.0])
STAND = np.zeros(2)


def world(*starts):
    arena = staged_arena()
    rngs = [np.random.default_rng(i) for i in range(len(starts))]
    return GroundWorld([same_room(arena, start=start) for start in starts], rngs, Conditions())


def test_a_contact_between_robots_is_no_collision():
    two = world((-0.4, 0.0, 0.0), (0.4, 0.02, math.pi), (0.0, 3.0, 0.0))
    contacts = [[(p.contact_robot, p.collision) for p in two.step([AHEAD, AHEAD, STAND])] for _ in range(20)]
    assert two.robot_contacts >= 1
    met = [k for k, now in enumerate(contacts) if now[0][0]]
    assert met and all(contacts[k][1][0] for k in met), "the contact counts for both"
    # 0.8 m apart at 0.5 m/s: the plates (0.069 m around a point 0.032 m behind the axle) meet after about 1.4 s.
    assert 5 <= met[0] <= 9
    assert not any(hit or touched for now in contacts for touched, hit in now[2:])
    assert not any(hit for now in contacts for _, hit in now)


def test_a_wall_is_a_collision_and_no_contact_between_robots():
    one = world((4.5, 0.0, 0.0), (0.0, 3.0, 0.0))
    periods = [one.step([AHEAD, STAND]) for _ in range(15)]
    assert any(p[0].collision for p in periods) and not any(p[1].collision for p in periods)
    assert one.robot_contacts == 0 and not any(p[0].contact_robot for p in periods)


def test_a_robot_of_a_world_drives_as_one_in_its_own_arena():
    arena = staged_arena()
    alone = GroundRobot(arena, np.random.default_rng(0))
    shared = world((0.0, 0.0, 0.0), (3.0, 3.0, 0.0))
    for k in range(20):
        u = np.array([0.25, 0.3 * math.sin(k)])
        one, other = alone.step(u), shared.step([u, STAND])[0]
        assert np.allclose(one.true, other.true, atol=1e-6)
    assert np.allclose(one.measured, other.measured, atol=1e-6)


def test_on_the_ring_every_goal_is_opposite_its_start():
    arenas = draw_fleet("crossing", np.random.default_rng(1), GROUND, 6)
    for arena in arenas:
        assert np.allclose(arena.goal, -np.array(arena.start[:2])) and arena.obstacles == arenas[0].obstacles
        assert arena.clearance_map is arenas[0].clearance_map
    starts = np.array([arena.start[:2] for arena in arenas])
    between = np.linalg.norm(starts[:, None] - starts, axis=-1) + 9.0 * np.eye(6)
    assert between.min() > 1.0


def test_the_seed_determines_a_world_and_its_members_know_each_other():
    paths = []
    for _ in range(2):
        env = FleetEnv(GROUND, "crossing", 3, seed=5)
        env.draw(7)
        seen = [member.reset(options={"episode_seed": i}) for i, member in enumerate(env.members)]
        policies = [scripted("random", GROUND, np.random.default_rng(i)) for i in range(3)]
        for _ in range(5):
            results = env.step([p(o, i) for p, (o, i) in zip(policies, seen, strict=True)])
            seen = [(r[0], r[4]) for r in results]
        infos = [info for _, info in seen]
        assert all(np.array_equal(infos[0]["others"][i - 1], infos[i]["state"]) for i in (1, 2))
        assert not any(obstacle.motion for info in infos for obstacle in info["obstacles"])
        paths.append(np.array([info["true_state"] for info in infos]))
    assert np.array_equal(*paths)


def test_a_lidar_sees_another_robot():
    env = FleetEnv(GROUND, "crossing", 2, seed=0)
    env.draw(0)
    (near, _), _ = (member.reset(options={"episode_seed": 0}) for member in env.members)
    me, other = env.world.robots
    heading = float(me.true[2])
    other._qpos[:2] = me.true[:2] + 0.5 * np.array([math.cos(heading), math.sin(heading)])
    other.true = other._true_state()
    facing, *_ = env.step([STAND, STAND])[0]
    middle = facing[8:10] * 3.5
    assert middle.max() < 0.5 and middle.max() < near[8:10].min() * 3.5


def test_an_impossible_fleet_is_refused():
    for robot, arena, size, conditions, why in (
        (QUADROTOR, "default", 2, None, "quadrotor"),
        (GROUND, "walkers", 2, None, "move"),
        (GROUND, "crossing", 0, None, "at least"),
        (GROUND, "crossing", 2, Conditions(perception=Perception("scan")), "map"),
    ):
        with pytest.raises(NoFleet, match=why):
            FleetEnv(robot, arena, size, 0, conditions)


KIND = MoverKind(count=(4, 4), radius=0.2, speed=1.2, acceleration=1.0, keep=1.0)
ROOM = (
    *room_boundary(2.0, None),
    Obstacle("box", (0.5, 0.5), (0.6, 0.4), 0.4),
    Obstacle("cylinder", (-1.0, -0.5), (0.3,)),
)
PLACES = np.array([[-1.0, 1.0], [1.2, -1.0], [0.0, -1.5], [-1.5, 0.3]])
TIMES = np.arange(0.0, 60.0, 0.01)


@pytest.fixture(scope="module")
def walked():
    crowd = Crowd(KIND, PLACES, Shapes.of(ROOM, 2), seed=3)
    return [np.array(part) for part in zip(*(crowd.at(t) for t in TIMES), strict=True)]


def test_moving_obstacles_never_enter_static_ones(walked):
    distance = Shapes.of(ROOM, 2).distance(walked[0].reshape(-1, 2)).min(axis=0)
    assert distance.min() >= KIND.radius


def test_moving_obstacles_keep_their_speed_and_acceleration(walked):
    places, velocities = walked
    assert np.linalg.norm(velocities, axis=-1).max() <= KIND.speed + 1e-9
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=-1).max() <= KIND.acceleration * 0.01 + 1e-9
    assert np.allclose(np.diff(places, axis=0), 0.5 * 0.01 * (velocities[1:] + velocities[:-1]), atol=1e-3)


def test_moving_obstacles_walk_turn_and_stop(walked):
    speeds = np.linalg.norm(walked[1], axis=-1)
    assert speeds.max() > 0.8 and (speeds < 0.01).mean() > 0.02
    assert (np.ptp(walked[0], axis=0) > 1.0).any(axis=1).all()


def test_positions_depend_on_the_time_alone():
    one, other = (Crowd(KIND, PLACES, Shapes.of(ROOM, 2), seed=5) for _ in range(2))
    one.at(7.0)
    for t in (0.0, 3.33, 1.0):
        assert np.array_equal(one.at(t)[0], other.at(t)[0])


def test_the_measured_motion_bounds_the_true_motion():
    crowd = Crowd(KIND, PLACES, Shapes.of(ROOM, 2), seed=9)
    sensor = CrowdSensor(crowd, np.random.default_rng(0))
    for k in range(200):
        time = 0.2 * k
        measured = sensor.measure(time)
        truth = crowd.at(time)
        for obstacle, place, pace in zip(measured, *truth, strict=True):
            motion = obstacle.motion
            assert np.linalg.norm(np.array(obstacle.position) - place) <= motion.position_error
            assert np.linalg.norm(np.array(motion.velocity) - pace) <= motion.velocity_error
            assert (motion.before is None) == (k == 0)
            assert motion.is_consistent(obstacle.position)
            for later in (0.1, 0.6):
                ahead = np.array(obstacle.position) + later * np.array(motion.velocity)
                i = [o is obstacle for o in measured].index(True)
                assert np.linalg.norm(crowd.at(time + later)[0][i] - ahead) <= motion.radius(later) + 1e-9


class Straight(Crowd):
    """One person who walks along x at a constant velocity."""

    kind = KIND

    def __init__(self, start, pace, dim=2):
        self._start, self._pace = np.zeros((1, dim)), np.zeros((1, dim))
        self._start[0, 0], self._pace[0, 0] = start, pace
        if dim == 3:
            self._start[0, 2] = 2.0
        self._next = (self._start, self._pace)

    def at(self, time):
        return self._start + self._pace * time, self._pace


def met(vehicle, input, periods=20):
    """Return whether a contact was moving, standing, or with a static obstacle."""
    reports = [vehicle.step(np.array(input)) for _ in range(periods)]
    return (
        any(p.contact_moving for p in reports),
        any(p.contact_standing for p in reports),
        any(p.collision for p in reports),
    )


def on_the_ground(crowd):
    return GroundRobot(replace(staged_arena(), crowd=crowd), np.random.default_rng(0))


def in_the_air(crowd):
    arena = replace(staged_arena(start=(0.0, 0.0, 2.0), goal=(4.0, 4.0, 2.0), height=4.0), crowd=crowd)
    return Quadrotor(arena, np.random.default_rng(0))


def test_a_contact_counts_as_moving_or_standing_by_the_robots_own_motion():
    assert met(on_the_ground(Straight(1.0, -0.5)), (0.0, 0.0), 8) == (False, True, False)
    assert met(on_the_ground(Straight(0.5, 0.0)), (0.25, 0.0)) == (True, False, False)
    assert met(on_the_ground(Straight(1.0, 0.5)), (0.25, 0.0)) == (False, False, False)


def test_contacts_in_the_air_count_the_same_way():
    assert met(in_the_air(Straight(1.5, -1.0, 3)), (0.0, 0.0, 0.0), 7) == (False, True, False)
    assert met(in_the_air(Straight(1.5, 0.0, 3)), (2.0, 0.0, 0.0)) == (True, False, False)


def test_a_lidar_sees_moving_obstacles_at_their_positions():
    crowd = Straight(1.0, -0.5)
    lidar = Lidar(replace(staged_arena(), crowd=crowd), LidarRays(np.array([[1.0, 0.0], [0.0, 1.0]]), 10.0))
    for time, there in ((0.0, 0.8), (1.0, 0.3)):
        lidar.move_obstacles(time)
        assert lidar.cast(np.zeros(2)) == pytest.approx([there, 5.0])


def test_info_has_the_moving_obstacles_and_a_contact_ends_the_episode():
    env = NavigationEnv(GROUND, draw=lambda *_: replace(staged_arena(), crowd=Straight(1.0, -0.5)))
    _, info = env.reset(seed=0)
    moving = [o for o in info["obstacles"] if o.motion is not None]
    assert len(moving) == 1 and moving[0].motion.acceleration == KIND.acceleration
    ended = False
    while not ended:
        _, reward, ended, _, info = env.step(np.zeros(2, np.float32))
    assert info["contact_standing"] and not info["contact_moving"] and not info["collision"] and reward < -40.0


class Stepping(Straight):
    """A person who steps over a robot that stands."""

    kind = replace(KIND, steps_over=True)


def test_an_episode_goes_on_after_a_person_steps_over_the_robot():
    env = NavigationEnv(GROUND, draw=lambda *_: replace(staged_arena(), crowd=Stepping(1.0, -0.5)))
    env.reset(seed=0)
    ends, contacts = [], []
    for _ in range(25):
        _, _, ended, _, info = env.step(np.zeros(2, np.float32))
        ends.append(ended)
        contacts.append((info["contact_moving"], info["contact_standing"]))
    assert not any(ends) and contacts.count((False, True)) == 1 and not any(moving for moving, _ in contacts)
    assert np.abs(env.vehicle.true[:2]).max() < 1e-3


def test_a_robot_that_starts_under_a_person_counts_as_moving():
    robot = on_the_ground(Stepping(1.0, -0.5))
    assert met(robot, (0.0, 0.0), 8) == (False, True, False)
    assert met(robot, (0.25, 0.0), 1) == (True, False, False)


def test_the_generator_determines_the_crowd_of_an_arena():
    arena = draw_arena("walkers", np.random.default_rng(4), GROUND)
    again = draw_arena("walkers", np.random.default_rng(4), GROUND)
    assert arena.crowd is not None and len(arena.crowd) >= 3
    assert np.array_equal(arena.crowd.at(9.0)[0], again.crowd.at(9.0)[0])
    places, _ = arena.crowd.at(0.0)
    assert np.linalg.norm(places - arena.start[:2], axis=1).min() > KIND.keep
    assert draw_arena("default", np.random.default_rng(4), GROUND).crowd is None
