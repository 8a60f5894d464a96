"""A run over five hosts, robots far from the rest, whose clocks are hours apart: robots that are cut off brake,
everybody finds another router and another replica, the learner moves, and every step counts once."""

from collections import Counter
from contextlib import suppress
from subprocess import CalledProcessError

import pytest

from brakeline.deploy.data.data_paths import model_path
from brakeline.learner.checkpoint import exists
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.reader import read
from brakeline.messaging.robot import robot_named
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from tests.faults.campaign import ROBOTS, campaign
from tests.faults.five_hosts import MOVED, Fleet
from tests.faults.network_hosts import Hosts, NoHosts
from tests.waiting import until

DELAY = 0.005  # s each way, and up to as much again, between the robot and the routers
TELL = 1.5  # s, within which a process has said how it is
LATER = ("--learner.td3.hidden", 32, 32, "--learner.td3.batch", 32, "--learner.td3.warmup", 500)  # no wait for updates
STEPS, WINDOW = 900, LearnerConfig().window
CLOCKS = {2: -7.0, 3: 5.0}
ACTOR = "actor-ground-0"


@pytest.fixture
def hosts():
    try:
        with Hosts(5, CLOCKS) as joined:
            joined.join(1, 2)
            yield joined
    except NoHosts as error:
        pytest.skip(f"no network namespaces here: {error}")


def test_hosts_are_cut_off_killed_and_left_and_the_run_ends_with_every_step_counted_once(hosts, data_folder, tmp_path):
    with Fleet(tmp_path, hosts, steps=STEPS, delay=DELAY, learning=LATER) as fleet:
        fleet.start()

        def go_on(steps, what):
            target = fleet.taken("ground") + steps
            until(lambda: fleet.taken("ground") >= target or fleet.spots["learner-ground"].done, what)

        go_on(30, "the first steps")
        cuts, stood = 0, None
        while not stood and cuts < 10:  # it may just have waited for the learner, with nothing to ask
            before = fleet.taken("ground")
            hosts.cut(3)
            until(lambda: ACTOR not in fleet.living(), "the actor is cut off")
            assert fleet.taken("ground") - before <= 2 * WINDOW
            hosts.heal(3)
            go_on(20, "it comes back")
            with suppress(AssertionError):
                stood = until(lambda: fleet.said(ACTOR)["waits"], "it stood, and waited", TELL)
            cuts += 1
        assert stood and fleet.said(ACTOR)["fallbacks"] <= 10 * cuts, "it braked, stood, and waited"

        fleet.kill("router-0")
        go_on(30, "through the other router")
        fleet.kill("safety-1")
        go_on(30, "with the other replica")
        until(lambda: exists(tmp_path / "learner-ground" / "checkpoint"), "a checkpoint")
        fleet.kill("learner-ground")
        fleet.launch("learner-ground", host=MOVED)
        until(lambda: fleet.spots["learner-ground"].done, "the learner's end, on another host")
        learned = fleet.metrics.learners["ground"]
        fleet.end()

    logs = [list(read(fleet.log(recorder))) for recorder in (0, 1)]
    for log in logs:
        steps = Counter((r.message.header.run, r.message.header.sequence) for r in log if r.topic == "step")
        assert len(steps) > STEPS / 2 and max(steps.values()) == 1
        assert not any(r.message.collision for r in log if r.topic == "step")
    index = max(r.message.index for log in logs for r in log if r.topic == "step")
    assert (learned.steps, learned.duplicates, learned.done) == (STEPS, 0, True)
    assert learned.missing > 0, "what was learned after the checkpoint is lost, once"
    assert 0 <= index - (learned.steps + learned.missing) <= WINDOW, "and nothing twice"
    assert (tmp_path / "learner-ground" / "policy.safetensors").exists()
    if hosts.clock is not None:
        apart = [r.log_time - r.message.header.wall_time for r in logs[1] if r.key == f"step/ground/{ACTOR}"]
        assert max(apart) * 1e-9 < -11 * 3600.0


@pytest.mark.long
def test_a_slice_of_the_campaign_of_random_faults(tmp_path, monkeypatch):
    """The whole is `python -m benchmarks fault-campaign`."""
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    for name in ROBOTS:
        ModelSet.load(name).save(model_path(robot_named(name), ModelConfig()))
    try:
        figures = campaign(20, 1, tmp_path)
    except (NoHosts, CalledProcessError) as error:
        pytest.skip(f"no namespaces or volumes here: {error}")
    assert figures["faults"]["value"] == 20
    for name in ("collisions", "damage that nothing named", "figures that were wrong", "legs that did not go on"):
        assert figures[name]["value"] == 0, (tmp_path / "campaign-1.jsonl").read_text()
