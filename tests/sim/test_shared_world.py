"""Several robots share one physics."""

import math

import numpy as np
import pytest

from brakeline.errors import NoFleet
from brakeline.sim.arena import same_room
from brakeline.sim.arena_generator import draw_fleet
from brakeline.sim.ground_robot import GroundRobot
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.shared_world import FleetEnv, GroundWorld
from brakeline.sim.sim_conditions import Conditions, Perception
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
