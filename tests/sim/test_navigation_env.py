"""The environment keeps Gymnasium's rules, and episodes, rewards and info are as documented, with both robots."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import matplotlib
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import UnknownRobot
from brakeline.messaging.obstacle import Shapes
from brakeline.sim.navigation_env import NavigationEnv, Reward
from brakeline.sim.registration import ENVIRONMENTS, register
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.top_view import GOAL, OBSTACLE, ROBOT
from tests.robots import GROUND, QUADROTOR
from tests.sim.kinematic import PointMass

INFO_KEYS = {
    *("robot", "state", "true_state", "outside", "input_in_force", "obstacles", "arena", "goal", "time"),
    *("collision", "contact_moving", "contact_robot", "contact_standing", "at_goal"),
    *("clearance", "speed", "subsamples", "turned", "episode_seed"),
}
ENVS = {
    "ground": partial(NavigationEnv, GROUND),
    "quadrotor": partial(NavigationEnv, QUADROTOR, make_vehicle=PointMass),
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
    ("robot", "arena"), [("ground", "dense"), ("ground", "walkers"), ("ground", "crossing"), ("quadrotor", "traffic")]
)
def test_gymnasiums_checker_accepts_the_environment(robot: str, arena: str) -> None:
    check_env(ENVS[robot](arena=arena), skip_render_check=True)


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


def test_an_environment_takes_a_robot_by_its_name() -> None:
    assert NavigationEnv("ground").robot == GROUND
    with pytest.raises(UnknownRobot, match="grond"):
        NavigationEnv("grond")
    with pytest.raises(ValueError, match="render_mode is None, 'rgb_array' or 'human', not 'ansi'"):
        NavigationEnv("ground", render_mode="ansi")


@each_robot
def test_the_image_shows_obstacles_the_goal_and_the_robot_from_above(make: Make) -> None:
    env = make(render_mode="rgb_array")
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


def test_a_reset_can_change_the_arena_and_its_seed_determines_the_sequence_of_episodes() -> None:
    env = environment(GROUND, "default", 0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    assert env.reset(options={"arena": "open"})[1]["arena"].name == env.reset()[1]["arena"].name == "open"
    seeds = [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"], env.reset()[1]["episode_seed"]]
    assert len(set(seeds)) == 3
    assert [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"]] == seeds[:2]


@each_robot
def test_info_has_its_documented_keys_and_values(make: Make) -> None:
    env = make()
    robot, d = env.robot, env.robot.position_dim
    infos = [result[4] for result in episode(env, "greedy", 1)]
    for i, info in enumerate(infos):
        assert set(info) == INFO_KEYS
        assert info["time"] == pytest.approx(0.2 * i)
        assert info["state"].shape == info["true_state"].shape == (robot.state_dim,)
        assert info["subsamples"].shape == (10, d)
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
    plain, altered = ENVS["quadrotor"](), ENVS["quadrotor"]()
    altered.alter(scale=0.5)
    for _ in range(2):
        for env in (plain, altered):
            env.reset(options={"episode_seed": 1})
        usual, slower = (env.step(np.array([1.0, 0.0, 0.0]))[4]["speed"] for env in (plain, altered))
        assert slower == pytest.approx(0.5 * usual)


def test_a_measurement_beyond_its_bound_is_reported() -> None:
    class Off(PointMass):
        def _measure(self) -> np.ndarray:
            return self.true + np.array([0.0, 0.0, 0.0301, *np.zeros(6)])

    env = NavigationEnv(QUADROTOR, "default", Off)
    assert env.reset()[1]["outside"]
    assert env.step(np.ones(3))[4]["outside"]


@pytest.mark.parametrize(
    ("make", "most"), [(partial(environment, GROUND, "default", 0), 4.0), (partial(NavigationEnv, QUADROTOR), 5.0)]
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
