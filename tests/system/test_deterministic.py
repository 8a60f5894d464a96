"""`--deterministic`: the seed alone decides about the weights, however fast the machine is and often it is stopped."""

import signal

import pytest

from learner.checkpoint import exists
from tests.system.runs import Run
from tests.waiting import until

# An untrained robot hardly ever reaches a goal: its episodes have 300 steps, so the run ends at 600.
SHORT = ("--deterministic", "--steps", 400, "--learner.td3.warmup", 100, "--learner.checkpoint-every", 200)


def weights(run: Run) -> bytes:
    figures = run.end()
    assert run.popen.returncode == 0, run.errors.read_text()
    assert figures["finished"] and figures["collisions"] == 0 and list(figures["actors"]) == ["actor-0"]
    return (run.folder / "learner" / "policy.safetensors").read_bytes()


@pytest.fixture(scope="module")
def uninterrupted(data_folder, tmp_path_factory) -> bytes:
    with Run(tmp_path_factory.mktemp("runs") / "one", *SHORT, "--seed", 3) as run:
        return weights(run)


def test_another_seed_gives_other_weights(uninterrupted, tmp_path):
    with Run(tmp_path / "other", *SHORT, "--seed", 4) as other:
        assert weights(other) != uninterrupted


def test_a_second_run_with_the_seed_gives_the_same_weights_though_interrupted_and_resumed(uninterrupted, tmp_path):
    with Run(tmp_path / "run", *SHORT, "--seed", 3) as run:
        run.watch()
        until(lambda: exists(run.folder / "learner" / "checkpoint"), "a checkpoint")
        run.until_steps(30)  # within the second episode
        figures = run.end(signal.SIGINT)
        assert not figures["finished"] and figures["steps"] < 600
    with Run(run.folder, fresh=False) as resumed:
        assert weights(resumed) == uninterrupted
