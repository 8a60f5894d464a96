"""Test `brakeline learner` alone: its exit status says what the end of the process left behind."""

import pytest

from brakeline.deploy.cli import main
from brakeline.learner.learner import Learner
from brakeline.learner.learner_process import LearnerLoop
from tests.full_disk import full_disk


@pytest.mark.parametrize(("done", "most", "status"), [(True, 100, 1), (False, 100, 130), (True, 100_000_000, 0)])
def test_a_policy_that_does_not_fit_on_the_disk_is_no_success(tmp_path, monkeypatch, capsys, done, most, status):
    """Before, the status was 0: an engine that moves the process would count the training as complete."""

    def at_once(loop):
        with full_disk(most):
            loop.output.save()

    monkeypatch.setattr(LearnerLoop, "run", at_once)
    monkeypatch.setattr(Learner, "done", property(lambda _: done))
    out = tmp_path / "learner"
    assert main(["learner", "ground", "--listen", "tcp/127.0.0.1:0", "--out", str(out)]) == status
    said = capsys.readouterr().err
    assert ("THE POLICY WAS NOT SAVED: " in said and "repeat the command with --resume-if-any" in said) == (most == 100)
    assert (out / "policy.safetensors").exists() == (most > 100)
