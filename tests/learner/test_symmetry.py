"""Images of transitions: what a turned or mirrored world would have shown, judged by the simulator's own lidar."""

import numpy as np
import pytest

from brakeline.learner.replay import Batch
from brakeline.learner.symmetry import SymmetryAugmentation, symmetry_maps, symmetry_matrices
from tests.robots import GROUND, QUADROTOR

N = len(QUADROTOR.task.rays.directions)


def image(observation, turn):
    source, sign, _, _ = symmetry_maps(QUADROTOR, turn)
    return observation[source] * sign


def test_the_eight_turns_are_a_group_that_keeps_the_vertical():
    turns = symmetry_matrices(QUADROTOR)
    assert len({turn.tobytes() for turn in [*turns, np.eye(3)]}) == len(turns) == 8
    assert np.array_equal(turns[0], np.eye(3))
    for one in turns:
        assert np.array_equal(one @ one.T, np.eye(3)) and one[2, 2] == 1.0
        assert all(any(np.array_equal(one @ other, third) for third in turns) for other in turns)
    assert len(symmetry_matrices(GROUND)) == 1


@pytest.mark.parametrize("number", range(8))
def test_the_lidar_of_a_turned_world_sees_the_image(number):
    """A few balls about the robot, moved with the world; distances along each ray by geometry, not by the table."""
    turn, rng = symmetry_matrices(QUADROTOR)[number], np.random.default_rng(3)
    balls = rng.uniform(-6.0, 6.0, (12, 3))

    def seen(centres):
        along = QUADROTOR.task.rays.directions @ centres.T
        off = (centres**2).sum(axis=1) - along**2
        hits = np.where((along > 0) & (off < 1.0), along - np.sqrt(np.maximum(1.0 - off, 0.0)), 12.0)
        return hits.min(axis=1) / 12.0

    vectors = rng.normal(size=(3, 3))
    before = np.concatenate([seen(balls), vectors.ravel()])
    after = np.concatenate([seen(balls @ turn.T), (vectors @ turn.T).ravel()])
    assert (seen(balls) < 1.0).sum() > 10
    assert np.allclose(image(before, turn), after, atol=1e-9)
    _, _, source, sign = symmetry_maps(QUADROTOR, turn)
    assert np.array_equal(vectors[0][source] * sign, turn @ vectors[0])


def test_a_batch_holds_every_image_alike_and_rewards_as_they_were():
    batch, rng = Batch(16, QUADROTOR.task.observation_dim, 3), np.random.default_rng(0)
    for array in batch.arrays:
        array[:] = rng.normal(size=array.shape)
    before = [array.copy() for array in batch.arrays]
    SymmetryAugmentation(QUADROTOR, 16).apply(batch)
    observation, action, _, _, after, *_ = batch.arrays
    assert all(np.array_equal(batch.arrays[i], before[i]) for i in (2, 3, 5, 6, 7)), "only vectors are turned"
    for row in range(16):
        turn = symmetry_matrices(QUADROTOR)[row % 8]
        assert np.array_equal(observation[row], image(before[0][row], turn).astype(np.float32))
        assert np.array_equal(after[row], image(before[4][row], turn).astype(np.float32))
        assert np.allclose(action[row], turn @ before[1][row])
    assert np.array_equal(batch.observation[0].numpy(), observation), "torch sees the same"


def test_a_robot_without_images_keeps_its_batches():
    batch = Batch(8, GROUND.task.observation_dim, 2)
    batch.arrays[0][:] = np.arange(GROUND.task.observation_dim)
    SymmetryAugmentation(GROUND, 8).apply(batch)
    assert np.array_equal(batch.arrays[0][3], np.arange(GROUND.task.observation_dim))


def test_other_turns_are_no_images():
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    with pytest.raises(ValueError, match="rays"):
        symmetry_maps(QUADROTOR, tilted)


def test_rows_of_observations_actions_and_pairs_of_them():
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(8, QUADROTOR.task.observation_dim)).astype(np.float32)
    done = rng.normal(size=(8, 3)).astype(np.float32)
    images = SymmetryAugmentation(QUADROTOR, 8)
    both = images.rows(np.hstack([seen, done]))
    assert np.array_equal(both, np.hstack([images.rows(seen), images.rows(done)]))
    assert np.array_equal(both[0], np.hstack([seen[0], done[0]])) and not np.array_equal(
        both[1:], np.hstack([seen, done])[1:]
    )
    assert SymmetryAugmentation(GROUND, 8).rows(seen) is seen
