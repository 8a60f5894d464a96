"""Moving obstacles keep their bounds and avoid static ones, and their measured motion is right."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import room_boundary
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_robot import GroundRobot
from brakeline.sim.lidar import Lidar
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.traffic import Crowd, CrowdSensor, MoverKind
from tests.arenas import staged_arena
from tests.robots import GROUND

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
