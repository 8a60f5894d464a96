"""The environment keeps Gymnasium's rules, and episodes, rewards, info and observations are as documented.
Observations come from the measured state, the lidar's position from the true one.
"""

import copy
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import matplotlib
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from brakeline.deploy.data.collect import record
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadWeights, UnknownName, UnknownRobot, UnknownTask
from brakeline.messaging.arena_kinds import MoverKind
from brakeline.messaging.obstacle import CYLINDER, Obstacle, Shapes
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.robot import robot_named
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import RobotWithTask, address, read_task, robot_with_task, with_task
from brakeline.sim.arena import same_room
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.lidar import Lidar
from brakeline.sim.navigation_env import NavigationEnv, Reward
from brakeline.sim.observations import GroundObservation, QuadrotorObservation, TrackingObservation
from brakeline.sim.quadrotor import SAMPLES, Quadrotor
from brakeline.sim.registration import ENVIRONMENTS, register
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.shared_world import FleetEnv
from brakeline.sim.sim_conditions import Conditions, Perception, QuadrotorNoise
from brakeline.sim.top_view import GOAL, OBSTACLE, ROBOT
from brakeline.sim.traffic import Crowd
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

INFO_KEYS = {
    *("robot", "state", "true_state", "outside", "input_in_force", "obstacles", "arena", "goal", "time"),
    *("collision", "contact_moving", "contact_robot", "contact_standing", "at_goal"),
    *("clearance", "closest", "speed", "subsamples", "turned", "episode_seed", "acceleration_age"),
}
ENVS = {
    "ground": partial(NavigationEnv, GROUND),
    "quadrotor": partial(NavigationEnv, QUADROTOR, make_vehicle=Quadrotor),
}
each_robot = pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
Make = Callable[..., NavigationEnv]


def episode(env: NavigationEnv, policy: str, seed: int, steps: int = 60) -> list[tuple[Any, ...]]:
    """Return (observation, reward, terminated, truncated, info) at the start, and after the first steps."""
    act = scripted(policy, env.robot, np.random.default_rng(0))
    observation, info = env.reset(options={"episode_seed": seed})
    results: list[tuple[Any, ...]] = [(observation, 0.0, False, False, info)]
    while len(results) <= steps and not (results[-1][2] or results[-1][3]):
        results.append(env.step(act(results[-1][0], results[-1][4])))
    return results


def observed(env: NavigationEnv, policy: str, seed: int) -> np.ndarray:
    return np.array([result[0] for result in episode(env, policy, seed)])


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*")  # actions are physical: speed is not negative
@pytest.mark.parametrize(
    ("robot", "arena", "perception"),
    [
        ("ground", "dense", "map"),
        ("ground", "walkers", "map"),
        ("ground", "walkers", "scan"),
        ("ground", "crossing", "map"),
        ("quadrotor", "traffic", "map"),
        ("quadrotor", "default", "scan"),
    ],
)
def test_gymnasiums_checker_accepts_the_environment(robot: str, arena: str, perception: str) -> None:
    conditions = Conditions(perception=Perception(perception))
    check_env(ENVS[robot](arena=arena, conditions=conditions), skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*")
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_gymnasium_makes_the_environment_by_its_id_in_every_render_mode(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brakeline.sim.top_view.PIXELS", 60)  # the checker draws a hundred images
    register()
    register()
    env = gymnasium.make(name, arena="dense", conditions=Conditions(payload_kg=0.1))
    assert env.reset(seed=0)[1]["arena"].name == "dense" and env.unwrapped.robot.name == ENVIRONMENTS[name]
    with matplotlib.rc_context({"backend": "agg"}):
        check_env(env.unwrapped)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_gymnasium_makes_many_robots_at_once_by_the_id(name: str) -> None:
    register()
    envs = gymnasium.make_vec(name, num_envs=2, arena="dense")
    assert isinstance(envs, BatchNavigationEnv) and envs.robot.name == ENVIRONMENTS[name]
    assert [arena.name for arena in envs.reset(seed=0)[1]["arena"]] == ["dense"] * 2
    envs.close()


def test_an_environment_takes_a_robot_by_its_name() -> None:
    assert NavigationEnv("ground").robot == GROUND
    with pytest.raises(UnknownRobot, match="grond"):
        NavigationEnv("grond")
    with pytest.raises(ValueError, match="render_mode is None, 'rgb_array' or 'human', not 'ansi'"):
        NavigationEnv("ground", render_mode="ansi")
    with pytest.raises(UnknownName, match="no arena is called 'moon'"):
        NavigationEnv("ground", "moon")
    for noise in (np.nan, -1.0):
        with pytest.raises(ValueError, match=f"lidar_noise = {noise} is not"):
            NavigationEnv("ground", lidar_noise=noise)


@each_robot
def test_the_image_shows_obstacles_the_goal_and_the_robot_from_above(make: Make) -> None:
    env = make(render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    _, info = env.reset(options={"episode_seed": 1})
    before = env.render()
    assert before.dtype == np.uint8 and before.shape == (360, 360, 3)
    arena, d = info["arena"], env.robot.position_dim
    (left, right), (_, top) = arena.bounds[:2]
    height = info["true_state"][2:d]

    def colour(x: float, y: float) -> tuple[int, ...]:
        scale = 360 / (right - left)
        return tuple(before[int((top - y) * scale), int((x - left) * scale)])

    points = np.random.default_rng(0).uniform((left, left), (right, top), (300, 2))
    clearance = arena.shapes.distance(np.column_stack([points, np.tile(height, (len(points), 1))])).min(axis=0)
    inside = [colour(*point) for point in points[clearance == 0.0]]
    assert len(inside) > 3 and inside.count(OBSTACLE) > 0.9 * len(inside)
    assert colour(*arena.goal[:2]) == GOAL
    x, y = info["true_state"][:2]
    assert colour(x, y - 0.7 * env.robot.footprint) == ROBOT or env.robot.heading is not None
    for _ in range(15):
        env.step(env.robot.high())
    assert (env.render() != before).any()
    assert make().render() is None


@each_robot
def test_the_episode_seed_determines_the_episode(make: Make) -> None:
    env = make()
    first = observed(env, "random", 5)
    observed(env, "greedy", 6)
    assert np.array_equal(first, observed(env, "random", 5)) and np.array_equal(first, observed(make(), "random", 5))
    for other in (observed(env, "random", 6), observed(make(seed_key=1), "random", 5)):
        assert not np.array_equal(first[0], other[0])
    assert env.reset(options={"episode_seed": 5})[1]["episode_seed"] == 5


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.name)
def test_a_policy_that_overwrites_what_it_gets_changes_no_motion(robot: RobotWithTask) -> None:
    env, sound = (NavigationEnv(robot, "dense") for _ in range(2))
    info, _ = env.reset(seed=0)[1], sound.reset(seed=0)
    for _ in range(2):
        for entry in info.values():
            if isinstance(entry, np.ndarray):
                entry[...] = 7.0
        *_, info = env.step(0.3 * robot.high())
        *_, wanted = sound.step(0.3 * robot.high())
        assert all(np.array_equal(info[name], wanted[name]) for name in ("true_state", "state", "input_in_force"))


def test_a_task_without_an_arena_called_default_begins_in_its_first_one() -> None:
    task = GROUND.task
    mine = with_task(GROUND, replace(task, arenas={"hall": task.arenas["open"], "yard": task.arenas["dense"]}))
    assert NavigationEnv(mine).reset(seed=0)[1]["arena"].name == "hall"
    assert NavigationEnv(mine, "yard").arena_name == "yard"
    batch = BatchNavigationEnv(mine, 1)
    assert batch.arena_name == "hall"
    batch.close()
    with pytest.raises(UnknownName, match="there are: hall, yard"):
        NavigationEnv(mine, "default")
    assert NavigationEnv(GROUND).arena_name == "default"
    assert len(next(record(mine, 1, 5, Conditions())).states) > 1


def test_a_reset_can_change_the_arena_and_its_seed_determines_the_sequence_of_episodes() -> None:
    env = environment(GROUND, "default", 0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    assert env.reset(options={"arena": "open"})[1]["arena"].name == env.reset()[1]["arena"].name == "open"
    for options, said in (
        ({"arena": "moon"}, "no arena is called 'moon'"),
        ({"episode_seed": 2.7}, "an episode's seed is an integer, 0 or more, not 2.7"),
        ({"episode_seed": -1}, "not -1"),
        ({"episode": 5}, "no option 'episode'; there are: arena, episode_seed"),
    ):
        with pytest.raises((ValueError, UnknownName), match=said):
            env.reset(options=options)
        assert env.reset()[1]["arena"].name == "open", "what is refused changes nothing"
    seeds = [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"], env.reset()[1]["episode_seed"]]
    assert len(set(seeds)) == 3
    assert [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"]] == seeds[:2]


@each_robot
def test_a_policy_that_moves_the_arenas_shapes_away_frees_no_space(make: Make) -> None:
    env, sound = make(), make()
    env.reset(options={"episode_seed": 1})[1]["arena"].shapes.center[:] += 1000.0
    sound.reset(options={"episode_seed": 1})
    inputs = np.zeros(env.robot.action_dim)
    assert env.step(inputs)[4]["obstacles"] == sound.step(inputs)[4]["obstacles"] != []


@each_robot
def test_info_has_its_documented_keys_and_values(make: Make) -> None:
    env = make()
    robot, d = env.robot, env.robot.position_dim
    infos = [result[4] for result in episode(env, "greedy", 1)]
    for i, info in enumerate(infos):
        assert set(info) == INFO_KEYS
        assert info["time"] == pytest.approx(0.2 * i)
        assert info["state"].shape == info["true_state"].shape == (robot.state_dim,)
        assert info["subsamples"].shape == ({"ground": 10, "quadrotor": SAMPLES}[robot.name], d)
        arena = info["arena"]
        distances = Shapes.of(arena.obstacles, d).distance(info["state"][:d])
        assert [o in info["obstacles"] for o in arena.obstacles] == list(distances <= robot.sight)
        true = Shapes.of(arena.obstacles, d).distance(info["true_state"][:d]).min()
        assert info["clearance"] == pytest.approx(true - robot.footprint)
        assert not info["outside"]
    assert (infos[0]["input_in_force"] == 0.0).all()
    assert np.abs(infos[1]["input_in_force"]).max() == {"ground": 0.5, "quadrotor": 0.8}[robot.name]


@each_robot
def test_the_reward_is_progress_and_the_goal(make: Make) -> None:
    env = make()
    d, paid = env.robot.position_dim, {"ground": 20.0, "quadrotor": 2.0}[env.robot.name]
    results = episode(env, "astar", 4, steps=300)
    _, _, terminated, truncated, info = results[-1]
    start, end = (np.linalg.norm(np.array(info["goal"]) - r[4]["true_state"][:d]) for r in (results[0], results[-1]))
    assert info["at_goal"] and terminated and not truncated and end <= info["arena"].goal_radius
    assert sum(result[1] for result in results) == pytest.approx(paid * (start - end) + 100.0)
    assert info["state"] == pytest.approx(info["true_state"], abs=max(env.robot.measurement_bound))


@each_robot
def test_a_collision_is_penalised_and_terminates_the_episode(make: Make) -> None:
    results = episode(make(reward=Reward(progress=0.0)), "adversary", 4, steps=300)
    _, reward, terminated, _, info = results[-1]
    assert info["collision"] and terminated and not info["at_goal"]
    assert reward == -100.0 and not any(result[1] for result in results[:-1])


@each_robot
def test_an_episode_is_truncated_at_the_step_limit(make: Make) -> None:
    env = make()
    env.reset(options={"episode_seed": 4})
    limit = {"ground": 300, "quadrotor": 200}[env.robot.name]
    flags = [env.step(np.zeros(env.robot.action_dim))[2:4] for _ in range(limit)]
    assert flags[-1] == (False, True) and not any(any(flag) for flag in flags[:-1])


def test_a_change_before_the_first_episode_lasts_over_resets() -> None:
    plain, altered = ENVS["ground"](), ENVS["ground"]()
    altered.alter(payload_kg=2.0)
    for _ in range(2):
        for env in (plain, altered):
            env.reset(options={"episode_seed": 1})
        bare, laden = (env.step(np.array([0.25, 0.0]))[4]["speed"] for env in (plain, altered))
        assert laden < bare - 0.005


def test_a_measurement_beyond_its_bound_is_reported() -> None:
    env = NavigationEnv(QUADROTOR, conditions=Conditions(flight_noise=QuadrotorNoise(scale=20.0)))
    assert env.reset(seed=0)[1]["outside"]
    assert env.step(np.ones(3))[4]["outside"]


@pytest.mark.parametrize(
    ("make", "most"), [(partial(environment, GROUND, "default", 0), 4.0), (ENVS["quadrotor"], 5.0)]
)
def test_a_step_is_fast(make: Make, most: float) -> None:
    """Compare with the machine's present speed in plain Python, since steps a second depend on the machine."""
    env = make()
    low, high = env.robot.low(), env.robot.high()
    costs = []
    for seed in range(3):
        env.reset(options={"episode_seed": seed})
        begin = time.process_time()  # of this process alone: others may be busy
        _plain_python()
        middle = time.process_time()
        for i in range(100):
            env.step(0.1 * high if i % 2 else np.maximum(low, -0.1 * high))
        costs.append((time.process_time() - middle) / (middle - begin))
    print(f"100 steps of the environment: {min(costs):.2f} times 1,000,000 rounds of a loop")
    assert min(costs) < most  # about half of it at the time of writing


def _plain_python() -> int:
    total = 0
    for i in range(1_000_000):
        total += i * i
    return total


RNG = np.random.default_rng(0)


def test_the_ground_robots_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (1.0, 0.5), (0.3,)), goal=(-1.0, 2.0))
    true, measured = np.array([0.0, 0.0, 0.5, 0.1, 0.2]), np.array([0.01, -0.01, 0.51, 0.11, 0.19])
    input = np.array([0.2, -0.3])
    model = GroundObservation(GROUND, arena, RNG, 0.0)
    observation = model.observe(true, measured, input)
    named = dict(zip(GROUND.task.observed, observation.tolist(), strict=True))
    offset = np.array(arena.goal) - measured[:2]
    angle = np.arctan2(offset[1], offset[0]) - measured[2]
    assert named["goal distance [5 m]"] == pytest.approx(np.linalg.norm(offset) / 5.0)
    assert named["goal bearing sin"] == pytest.approx(np.sin(angle))
    assert named["goal bearing cos"] == pytest.approx(np.cos(angle))
    assert named["speed [0.25 m/s]"] == pytest.approx(0.11 / 0.25)
    assert named["turn rate [0.5 rad/s]"] == pytest.approx(0.19 / 0.5)
    assert named["last speed input [0.25 m/s]"] == pytest.approx(0.2 / 0.25)
    assert named["last turn input [0.5 rad/s]"] == pytest.approx(-0.3 / 0.5)
    assert named["turn memory: low-passed turn rate [0.5 rad/s]"] == pytest.approx((1 - np.exp(-0.1)) * 0.19 / 0.5)
    mount = -0.032 * np.array([np.cos(0.5), np.sin(0.5)])
    assert observation[:18] == pytest.approx(Lidar(arena, GROUND.task.rays).cast(mount, 0.5) / 3.5)
    assert observation[:18].min() < 0.3
    assert model.speed(true) == 0.1
    for _ in range(9):  # 2 s in all: the turn memory is a low-pass filter
        observation = model.observe(true, measured, input)
    assert observation[-1] == pytest.approx((1.0 - np.exp(-1.0)) * 0.19 / 0.5)


def test_the_quadrotors_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (3.0, 0.0, 4.0), (1.0, 8.0)), goal=(-6.0, 2.0, 7.0), height=8.0)
    true = np.array([0.0, 0.0, 4.0, 1.0, 2.0, -2.0, 0.1, 0.2, 0.3])
    measured = true + 0.02
    input = np.array([1.0, -3.0, 5.0])
    model = QuadrotorObservation(QUADROTOR, arena, RNG, 0.0)
    observation = model.observe(true, measured, input)
    assert len(observation) == QUADROTOR.task.observation_dim == 189
    named = dict(zip(QUADROTOR.task.observed, observation.tolist(), strict=True))
    offset = np.array(arena.goal) - measured[:3]
    for i, axis in enumerate("xyz"):
        assert named[f"goal - p, {axis} [its length + 5 m]"] == pytest.approx(offset[i] / (np.linalg.norm(offset) + 5))
        assert named[f"v{axis} [5 m/s]"] == pytest.approx(measured[3 + i] / 5.0)
        assert named[f"last v{axis} setpoint [5 m/s]"] == pytest.approx(input[i] / 5.0)
    assert observation[:180] == pytest.approx(Lidar(arena, QUADROTOR.task.rays).cast(true[:3]) / 12.0)
    assert named["ray 2 [range/12 m]"] == pytest.approx(2.0 / 12.0)  # level, straight ahead
    assert model.speed(true) == pytest.approx(3.0)


TRACKS = read_task(ROBOTS_FOLDER / "ground+tracks.task.toml")


def test_tracks_have_position_velocity_and_time_to_encounter() -> None:
    model = TrackingObservation(GROUND, staged_arena(), RNG, 0.0)
    facing_up = np.array([1.0, 1.0, 0.5 * np.pi, 0.0, 0.0])
    # 2 m ahead and 0.3 m to the left, coming straight back at 1 m/s; one that stands 1 m to the right; one too far off
    positions = np.array([[0.7, 3.0], [2.0, 1.0], [1.0, -4.0]])
    velocities = np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]])
    tracks = model.tracks(facing_up, positions, velocities)
    names = TRACKS.observation[-len(tracks) :]
    named = dict(zip(names, tracks.tolist(), strict=True))
    assert named["track 1 near·left"] == pytest.approx(-(1.0 - 1.0 / 3.5)) and named["track 1 soon"] == 0.0
    away = np.hypot(2.0, 0.3)
    assert named["track 2 near·ahead"] == pytest.approx((1.0 - away / 3.5) * 2.0 / away)
    assert named["track 2 near·left"] == pytest.approx((1.0 - away / 3.5) * 0.3 / away)
    assert named["track 2 speed ahead [1.2 m/s]"] == pytest.approx(-1.0 / 1.2)
    assert named["track 2 speed to the left [1.2 m/s]"] == pytest.approx(0.0)
    assert named["track 2 soon"] == pytest.approx(np.exp(-2.0 / 2.0))
    # it moves down in the world, 0.3 m to the left of the robot: the robot is on its left
    assert named["track 2 soon·aside"] == pytest.approx(-0.3 * np.exp(-1.0))
    assert not tracks[12:].any()
    # after it has passed, the time to the encounter is over
    assert model.tracks(facing_up, np.array([[0.7, 0.5]]), velocities[:1])[4] == 0.0


def test_a_tracking_observation_is_the_ground_observation_and_tracks() -> None:
    usual = GROUND.task
    assert TRACKS.observed[: usual.observation_dim] == usual.observed and TRACKS.arenas == usual.arenas
    kind = MoverKind((1, 1), 0.2, 1.2, 1.0, 1.0)
    arena = same_room(staged_arena(), crowd=Crowd(kind, np.array([[2.0, 0.0]]), staged_arena().shapes, 0))
    state, input = np.zeros(5), np.zeros(2)
    tracks = TrackingObservation(GROUND, arena, np.random.default_rng(0), 0.0).observe(state, state, input, 0.0)
    seen = GroundObservation(GROUND, arena, np.random.default_rng(0), 0.0).observe(state, state, input, 0.0)
    assert np.array_equal(tracks[: len(seen)], seen) and len(tracks) == TRACKS.observation_dim
    assert tracks[len(seen)] == pytest.approx(1.0 - 2.0 / 3.5, abs=0.02) and not tracks[len(seen) + 6 :].any()


@pytest.fixture
def tracking() -> RobotWithTask:
    return robot_with_task("ground+tracks")


def test_robots_of_a_fleet_are_tracks_to_each_other(tracking) -> None:
    env = FleetEnv(tracking, "crossing", 3, 0)
    env.draw(5)
    for member in env.members:
        member.reset(options={"episode_seed": 5})
    results = [env.step([np.array([0.25, 0.0])] * 3) for _ in range(10)][-1]
    observation, info = results[0][0], results[0][4]
    own, others = info["state"], info["others"]
    nearest = min(others, key=lambda other: np.hypot(*(other[:2] - own[:2])))
    p, heading = nearest[:2] - own[:2], nearest[2] - own[2]
    named = dict(zip(tracking.task.observed, observation.tolist(), strict=True))
    near = (1.0 - np.hypot(*p) / 3.5) * np.cos(np.arctan2(p[1], p[0]) - own[2])
    assert named["track 1 near·ahead"] == pytest.approx(near, abs=1e-5)
    assert named["track 1 speed ahead [1.2 m/s]"] == pytest.approx(nearest[3] * np.cos(heading) / 1.2, abs=1e-5)
    assert nearest[3] > 0.2, "the other robot drives"
    seen = sum(np.hypot(*(other[:2] - own[:2])) < 3.5 for other in others)
    assert [bool(named[f"track {i} near·ahead"]) for i in (1, 2, 3)] == [i <= seen for i in (1, 2, 3)]


@pytest.mark.parametrize("names", [GROUND.task.observation[1:], (*GROUND.task.observation, "extra")])
def test_a_task_that_names_more_or_less_than_is_observed_is_refused(names: tuple[str, ...]) -> None:
    task = replace(GROUND.task, observation=names)
    said = f"observed are 26 numbers, but the task names {18 + len(names)}"
    with pytest.raises(UnknownTask, match=said):
        NavigationEnv(with_task(GROUND, task)).reset(seed=0)
    batch = BatchNavigationEnv(with_task(GROUND, task), 2)
    with pytest.raises(UnknownTask, match=said):
        batch.reset(seed=0)
    batch.close()


def test_another_task_of_a_robot_is_read_by_its_name(tracking) -> None:
    assert tracking.layout() == GROUND.layout() and tracking.task.observation_dim == 50
    assert address("ground+tracks") == "ground+tracks" and robot_named("ground+tracks-late").late
    ours = MLP.untrained(tracking, 0).encode()
    assert GROUND.task.observation_dim == 26, "without a suffix the robot has its usual task"
    with pytest.raises(BadWeights, match="layout"):
        decode(ours, GROUND)
    with pytest.raises(UnknownTask, match=r"additional tasks of ground: ground\+tracks"):
        robot_with_task("ground+trucks")


def test_an_environment_is_copied_before_its_first_episode_only() -> None:
    """The copy of a running simulation went another way: after one step, it was 33 mm from the original."""
    env = NavigationEnv("ground")
    twin = copy.deepcopy(env)
    assert np.array_equal(env.reset(seed=3)[0], twin.reset(seed=3)[0])
    for copied in (copy.copy, copy.deepcopy, lambda env: env.__reduce_ex__(4)):  # the last one is what pickle calls
        with pytest.raises(TypeError, match="episode_seed"):
            copied(env)
