"""The environment: Gymnasium's rules, determinism, what it pays and tells, and its speed."""

import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sim
from messaging.robots import GROUND
from messaging.shapes import Shapes
from sim.envs import NavigationEnv, Reward, TurnMemory
from sim.estimator import NoiseLevels
from sim.policies import scripted

INFO_KEYS = {
    "robot",
    "state",
    "true_state",
    "outside",
    "input_in_force",
    "obstacles",
    "arena",
    "goal",
    "time",
    "collision",
    "at_goal",
    "clearance",
    "speed",
    "subsamples",
    "turned",
    "episode_seed",
}


def episode(env: NavigationEnv, policy: str, options: dict[str, Any], steps: int = 60) -> tuple[list[Any], list[Any]]:
    """Observations and infos of the first steps of one episode."""
    act = scripted(policy, GROUND, np.random.default_rng(0))
    observation, info = env.reset(options=options)
    observations, infos = [observation], [info]
    for _ in range(steps):
        observation, _, terminated, truncated, info = env.step(act(observation, info))
        observations.append(observation)
        infos.append(info)
        if terminated or truncated:
            break
    return observations, infos


def test_ours_is_imported() -> None:
    assert Path(sim.__file__).parent == Path(__file__).parents[2] / "sim"


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*")  # actions are physical: speed is not negative
@pytest.mark.parametrize("arena", ["default", "open", "dense"])
def test_gymnasium_accepts_it(arena: str) -> None:
    check_env(NavigationEnv(arena=arena), skip_render_check=True)


def test_a_seed_makes_the_episode() -> None:
    env = NavigationEnv()
    first, infos = episode(env, "random", {"episode_seed": 5})
    episode(env, "greedy", {"episode_seed": 6})
    again, _ = episode(env, "random", {"episode_seed": 5})
    fresh, _ = episode(NavigationEnv(), "random", {"episode_seed": 5})
    other, _ = episode(env, "random", {"episode_seed": 6})
    keyed, _ = episode(NavigationEnv(seed_key=1), "random", {"episode_seed": 5})
    assert np.array_equal(first, again) and np.array_equal(first, fresh)
    assert not np.array_equal(first[0], other[0]) and not np.array_equal(first[0], keyed[0])
    assert infos[0]["episode_seed"] == 5


def test_reset_seeds_the_sequence_of_episodes() -> None:
    env = NavigationEnv()
    seeds = [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"], env.reset()[1]["episode_seed"]]
    assert len(set(seeds)) == 3
    assert [env.reset(seed=3)[1]["episode_seed"], env.reset()[1]["episode_seed"]] == seeds[:2]


def test_info_has_its_keys_and_they_agree() -> None:
    _, infos = episode(NavigationEnv(), "greedy", {"episode_seed": 1})
    for i, info in enumerate(infos):
        assert set(info) == INFO_KEYS
        assert info["time"] == pytest.approx(0.2 * i)
        assert info["state"].shape == info["true_state"].shape == (5,)
        assert info["subsamples"].shape == (10, 2)
        arena = info["arena"]
        distances = Shapes.of(arena.obstacles, 2).distance(info["state"][:2])
        assert [o in info["obstacles"] for o in arena.obstacles] == list(distances <= 1.0)
        true = Shapes.of(arena.obstacles, 2).distance(info["true_state"][:2]).min()
        assert info["clearance"] == pytest.approx(true - GROUND.footprint)
    assert (infos[0]["input_in_force"] == 0.0).all()
    assert infos[1]["input_in_force"][0] == 0.25


def test_the_observation_is_in_the_documented_order() -> None:
    env = NavigationEnv(noise=NoiseLevels(scale=0.0))
    observations, infos = episode(env, "astar", {"episode_seed": 2}, steps=20)
    observation, info = observations[-1], infos[-1]
    state, goal = info["state"], np.array(info["goal"])
    named = dict(zip(GROUND.observation, observation.tolist(), strict=True))
    offset = goal - state[:2]
    angle = np.arctan2(offset[1], offset[0]) - state[2]
    assert named["goal distance [5 m]"] == pytest.approx(np.linalg.norm(offset) / 5.0, abs=1e-5)
    assert named["goal bearing sin"] == pytest.approx(np.sin(angle), abs=1e-5)
    assert named["goal bearing cos"] == pytest.approx(np.cos(angle), abs=1e-5)
    assert named["speed [0.25 m/s]"] == pytest.approx(state[3] / 0.25, abs=1e-5)
    assert named["turn rate [0.5 rad/s]"] == pytest.approx(state[4] / 0.5, abs=1e-5)
    last = info["input_in_force"]
    assert named["last speed input [0.25 m/s]"] == pytest.approx(last[0] / 0.25, abs=1e-5)
    assert named["last turn input [0.5 rad/s]"] == pytest.approx(last[1] / 0.5, abs=1e-5)
    rays = observation[:18]
    assert ((rays >= 0.0) & (rays <= 1.0)).all() and rays.min() < 1.0


def test_turn_memory_forgets_within_seconds() -> None:
    memory = TurnMemory()
    for _ in range(10):  # 2 s
        memory.update(0.5, 0.2)
    assert memory.value == pytest.approx(0.5 * (1.0 - np.exp(-1.0)))


def test_progress_is_paid_and_the_goal() -> None:
    env = NavigationEnv()
    act = scripted("astar", GROUND, np.random.default_rng(0))
    observation, info = env.reset(options={"episode_seed": 4})
    start = np.linalg.norm(np.array(info["goal"]) - info["true_state"][:2])
    total, done = 0.0, False
    while not done:
        observation, reward, terminated, truncated, info = env.step(act(observation, info))
        total += reward
        done = terminated or truncated
    end = np.linalg.norm(np.array(info["goal"]) - info["true_state"][:2])
    assert info["at_goal"] and terminated and not truncated and end <= 0.25
    assert total == pytest.approx(20.0 * (start - end) + 100.0)


def test_a_collision_costs_and_ends_the_episode() -> None:
    env = NavigationEnv(reward=Reward(progress=0.0))
    act = scripted("adversary", GROUND, np.random.default_rng(0))
    observation, info = env.reset(options={"episode_seed": 4})
    rewards, done = [], False
    while not done:
        observation, reward, terminated, truncated, info = env.step(act(observation, info))
        rewards.append(reward)
        done = terminated or truncated
    assert info["collision"] and terminated and not info["at_goal"]
    assert rewards[-1] == -100.0 and not any(rewards[:-1])


def test_time_runs_out_after_300_steps() -> None:
    env = NavigationEnv()
    env.reset(options={"episode_seed": 4})
    flags = [env.step(np.zeros(2))[2:4] for _ in range(300)]
    assert flags[-1] == (False, True) and not any(any(flag) for flag in flags[:-1])


def test_payload_and_friction_last_over_resets() -> None:
    env = NavigationEnv()
    env.alter(2.0, 1.0)
    env.reset(options={"episode_seed": 1})
    laden = env.step(np.array([0.25, 0.0]))[4]["speed"]
    env.alter(0.0, 1.0)
    env.reset(options={"episode_seed": 1})
    bare = env.step(np.array([0.25, 0.0]))[4]["speed"]
    env.alter(0.0, 0.1)
    slippery = env.step(np.zeros(2))[4]["speed"]
    assert laden < bare - 0.005
    assert slippery > 0.02


def test_the_arena_can_be_changed_at_reset() -> None:
    env = NavigationEnv()
    assert env.reset(options={"arena": "open"})[1]["arena"].name == "open"
    assert env.reset()[1]["arena"].name == "open"


def test_a_step_before_reset_is_refused() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        NavigationEnv().step(np.zeros(2))


def test_it_is_fast() -> None:
    env = NavigationEnv()
    rates = []
    for seed in range(3):
        env.reset(options={"episode_seed": seed})
        begin = time.perf_counter()
        for _ in range(200):
            env.step(np.array([0.0, 0.5]))
        rates.append(200 / (time.perf_counter() - begin))
    print(f"environment: {max(rates):.0f} steps/s")
    assert max(rates) > 500  # 1300 on an idle core; a busy machine is no defect
