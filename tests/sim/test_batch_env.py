"""Many robots at once see what single environments with the same seeds give, in every autoreset mode."""

import copy
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList

from brakeline.errors import BadInput, NoBatch, UnknownName
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.batch.normal_streams import NormalStreams
from brakeline.sim.ground_estimator import cut_normal
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.sim_conditions import Conditions, NoiseLevels, Perception, ProcessNoise, QuadrotorNoise, Wind
from tests.robots import GROUND, QUADROTOR

COMPARED = (
    *("state", "true_state", "outside", "input_in_force", "goal", "time", "collision", "contact_moving", "clearance"),
    *("closest", "subsamples", "turned", "at_goal", "speed", "episode_seed"),
)
SAME = 1e-9  # rounding


def compare(batch: dict[str, Any], row: int, single: dict[str, Any]) -> None:
    for name in COMPARED:
        assert np.abs(np.asarray(batch[name][row], float) - single[name]).max() <= SAME, name
    assert batch["arena"][row] == single["arena"] and batch["robot"][row] == single["robot"]


@pytest.mark.parametrize(
    ("robot", "arena", "policy", "steps", "conditions"),
    [
        (GROUND, "default", "greedy", 25, Conditions()),
        (GROUND, "dense", "adversary", 60, Conditions(NoiseLevels(scale=0.5), payload_kg=0.4, floor_friction=0.7)),
        (GROUND, "open", "random", 25, Conditions(NoiseLevels(scale=0.0))),
        (GROUND, "default", "random", 25, Conditions(weak_motor=0.7, process_noise=ProcessNoise(scale=2.0))),
        (QUADROTOR, "default", "astar", 25, Conditions(flight_noise=QuadrotorNoise(scale=0.5))),
        (QUADROTOR, "dense", "adversary", 40, Conditions()),
    ],
)
def test_robots_of_a_batch_move_as_single_ones(
    robot: RobotWithTask, arena: str, policy: str, steps: int, conditions: Conditions
) -> None:
    """Everything is equal within 1e-9. In the period of a collision, the impact amplifies the rounding of the state."""
    size = 3 if robot is GROUND else 2
    batch = BatchNavigationEnv(robot, size, arena, conditions=conditions, seed_key=3, threads=2)
    singles = [NavigationEnv(robot, arena, conditions=conditions, seed_key=3) for _ in range(size)]
    policies = [scripted(policy, robot, np.random.default_rng(i)) for i in range(size)]
    observations, infos = batch.reset(seed=7)
    now = [env.reset(seed=7 + i) for i, env in enumerate(singles)]
    collisions = ends = 0
    for _ in range(steps):
        for i, (observation, info) in enumerate(now):
            assert np.abs(observations[i] - observation).max() <= 1e-6  # float32
            compare(infos, i, info)
        inputs = np.array([policy(*one) for policy, one in zip(policies, now, strict=True)])
        observations, rewards, terminated, truncated, infos = batch.step(inputs)
        for i, env in enumerate(singles):
            *seen, info = env.step(inputs[i])
            observation, reward, *end = seen
            assert end == [terminated[i], truncated[i]]
            assert rewards[i] == pytest.approx(reward, abs=0.5 if info["collision"] else SAME)
            now[i] = observation, info
            if any(end):
                assert infos["final_info"]["collision"][i] == info["collision"]
                assert np.abs(infos["final_obs"][i] - observation).max() <= 1e-6 or info["collision"]
                now[i], ends, collisions = env.reset(), ends + 1, collisions + info["collision"]
    batch.close()
    assert ends >= collisions >= (5 if policy == "adversary" else 0)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_autoreset_modes_are_those_of_gymnasium(mode: AutoresetMode) -> None:
    """`SyncVectorEnv` with the same modes gives the same observations, rewards and ends."""
    size = 3
    batch = BatchNavigationEnv(GROUND, size, "dense", autoreset_mode=mode)
    peer = SyncVectorEnv([lambda: NavigationEnv(GROUND, "dense")] * size, autoreset_mode=mode)
    seen, _ = batch.reset(seed=1)
    assert np.allclose(seen, peer.reset(seed=1)[0], atol=1e-6)
    ended = 0
    inputs = np.tile(np.float32([0.25, 0.0]), (size, 1))
    for _ in range(40):
        (seen, *mine, infos), (theirs, *other, others) = batch.step(inputs), peer.step(inputs)
        ends = mine[1] | mine[2]
        if mode == AutoresetMode.SAME_STEP and ends.any():
            for name in ("_final_obs", "_final_info"):
                assert np.array_equal(infos[name], others[name])
        for a, b in zip(mine, other, strict=True):
            assert np.allclose(a, b, atol=0.5 * infos["collision"].any() + SAME)
        touched = infos["collision"] if mode == AutoresetMode.NEXT_STEP else np.zeros(size, dtype=bool)
        if mode == AutoresetMode.DISABLED and ends.any():
            options = {"reset_mask": ends}
            (seen, _), (theirs, _) = batch.reset(options=dict(options)), peer.reset(options=dict(options))
        assert np.allclose(seen[~touched], theirs[~touched], atol=1e-6)
        ended += int(ends.sum())
    batch.close()
    peer.close()
    assert ended > 3


def test_a_reset_takes_the_seeds_that_gymnasium_takes() -> None:
    batch = BatchNavigationEnv(GROUND, 3, autoreset_mode=AutoresetMode.DISABLED)
    peer = SyncVectorEnv([lambda: NavigationEnv(GROUND)] * 3, autoreset_mode=AutoresetMode.DISABLED)
    for env in (batch, peer):
        for seeds in ([], [1], [1, 2, 3, 4]):
            with pytest.raises(ValueError, match=f"num_envs=3|3 robots.*not {len(seeds)}"):
                env.reset(seed=seeds)
        env.reset(seed=0)
        env.reset(seed=[50, 60, 70], options={"reset_mask": np.array([True, False, False])})
    assert np.array_equal(batch.reset()[1]["episode_seed"], peer.reset()[1]["episode_seed"])
    before = batch.reset(seed=np.int64(4))[1]["episode_seed"]
    for options, said in (
        ({"arena": "dense"}, "no option 'arena'"),
        ({"episode_seed": 5}, "no option 'episode_seed'; there are: episode_seeds, reset_mask"),
        ({"episode_seeds": [1, 2]}, "3 robots .* not 2"),
        ({"episode_seeds": [1, 2, 3.5]}, "not 3.5"),
        ({"reset_mask": [True]}, "3 flags"),
        ({"reset_mask": [0, 2, 1]}, "3 flags"),
    ):
        with pytest.raises(ValueError, match=said):
            batch.reset(seed=9, options=options)
    assert np.array_equal(batch.reset(seed=4)[1]["episode_seed"], before)
    for env in (batch, peer):
        env.close()
    with pytest.raises(ValueError, match="at least one robot, not 0"):
        BatchNavigationEnv(GROUND, 0)


def test_gymnasium_turns_the_infos_into_a_list() -> None:
    batch = BatchNavigationEnv(GROUND, 3, "dense")
    env, ended = DictInfoToList(batch), 0
    _, infos = env.reset(seed=1)
    assert [info["robot"] for info in infos] == ["ground"] * 3
    while ended < 2:
        *_, terminated, truncated, infos = env.step(np.tile([0.25, 0.0], (3, 1)))
        for end, info in zip(terminated | truncated, infos, strict=True):
            assert ("final_info" in info) == ("final_obs" in info) == end
            ended += bool(end)
    batch.close()


def test_a_final_info_has_the_obstacles_of_its_own_arena() -> None:
    batch, ended = BatchNavigationEnv(GROUND, 3, "dense"), 0
    batch.reset(seed=1)
    while ended < 4:
        _, _, terminated, truncated, infos = batch.step(np.tile([0.25, 0.0], (3, 1)))
        for row in np.flatnonzero(terminated | truncated):
            arena = infos["final_info"]["arena"][row]
            center, count = (infos["final_info"]["obstacles"][name][row] for name in ("center", "count"))
            assert count == len(arena.obstacles) and np.array_equal(center[:count], arena.shapes.center)
            ended += 1
    batch.close()


def test_a_masked_reset_returns_what_the_other_robots_saw_whatever_a_policy_made_of_it() -> None:
    batch = BatchNavigationEnv(GROUND, 2, "dense", autoreset_mode=AutoresetMode.DISABLED)
    batch.reset(seed=1)
    observations, *_, infos = batch.step(np.tile([0.2, 0.0], (2, 1)))
    seen, state = observations[1].copy(), infos["state"][1].copy()
    observations -= 1.0  # as a policy that normalises in place
    infos["state"] -= 1.0
    observations, infos = batch.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(observations[1], seen) and np.array_equal(infos["state"][1], state)
    batch.close()


def test_a_policy_that_overwrites_the_obstacles_frees_no_space() -> None:
    batch, sound = (BatchNavigationEnv(GROUND, 2, "dense") for _ in range(2))
    (_, infos), _ = batch.reset(seed=1), sound.reset(seed=1)
    for _ in range(3):
        for array in infos["obstacles"].values():
            array[:] = 0
        observations, *_, infos = batch.step(np.tile([0.2, 0.1], (2, 1)))
        seen, *_, expected = sound.step(np.tile([0.2, 0.1], (2, 1)))
        assert np.array_equal(observations, seen), "also the rays"
        for name in ("center", "rho", "count"):
            assert np.array_equal(infos["obstacles"][name], expected["obstacles"][name])
    batch.close()
    sound.close()


def test_noise_is_that_of_each_generator() -> None:
    streams = NormalStreams(3)
    for row in range(3):
        streams.begin(row, np.random.default_rng(row))
    peers = [np.random.default_rng(row) for row in range(3)]
    for size in (1, 18, 20, 3) * 60:
        rows = np.array([0, 2]) if size == 3 else np.arange(3)
        drawn = streams.cut_normal(rows, 0.3, size)
        assert np.array_equal(drawn, [cut_normal(peers[row], 0.3, (size,)) for row in rows])


def test_what_only_single_environments_simulate_is_refused() -> None:
    for robot, arena, conditions in (
        ("ground", "walkers", Conditions()),
        ("ground", "crossing", Conditions()),
        ("ground+tracks", "default", Conditions()),
        ("ground", "default", Conditions(perception=Perception("scan"))),
        ("quadrotor", "traffic", Conditions()),
        ("quadrotor", "default", Conditions(wind=Wind(speed=1.0))),
        ("quadrotor", "default", Conditions(payload_kg=0.1)),
    ):
        with pytest.raises(NoBatch, match="NavigationEnv"):
            BatchNavigationEnv(robot_with_task(robot), 2, arena, conditions=conditions)
    with pytest.raises(UnknownName, match="no arena"):
        BatchNavigationEnv(GROUND, 2, "moon")
    env = BatchNavigationEnv(GROUND, 2)
    env.reset(seed=0)
    with pytest.raises(BadInput, match="finite"):
        env.step(np.full((2, 2), np.nan))
    env.close()


@pytest.mark.parametrize("many", [False, True], ids=["one", "batch"])
def test_wrong_settings_are_refused_before_the_first_episode(many: bool) -> None:
    wrong: tuple[tuple[dict[str, Any], type[Exception], str], ...] = (
        ({"reward": {"goal": 1.0}}, TypeError, r"reward is a dict: give a Reward of brakeline\.messaging\.task"),
        ({"conditions": {"wind": 3.0}}, TypeError, r"conditions is a dict: give a Conditions of brakeline\.sim\."),
        ({"seed_key": -1}, ValueError, "seed_key is an integer, 0 or more, not -1"),
        ({"seed_key": 0.5}, ValueError, "not 0.5"),
    )
    for how, error, message in wrong:
        with pytest.raises(error, match=message):
            BatchNavigationEnv(GROUND, 2, **how) if many else NavigationEnv(GROUND, **how)


def test_a_closed_batch_and_a_copy_of_one_are_refused() -> None:
    env = BatchNavigationEnv(GROUND, 2)
    with pytest.raises(TypeError, match="episode_seeds"):
        copy.deepcopy(env)
    env.reset(seed=0)
    env.close()
    for call in (lambda: env.step(np.zeros((2, 2))), env.reset):
        with pytest.raises(ClosedEnvironmentError, match="make another one"):
            call()
