"""Test your own robot by commands alone, from a CSV file of a drive to decisions of the service."""

import json
import subprocess

import numpy as np
import pytest

from brakeline.deploy.data import data_paths
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.moving_obstacles import split_moving
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Request
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from tests.accepting import WORDS
from tests.deploy.data.porter import FILE, Porter, drive, porter, write_csv
from tests.system.runs import BRAKELINE, brakeline
from tests.waiting import until

STEPS = 60  # of an episode
EPISODES = 12  # in `make test`; 200 behind `long`


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """Return the data folder after import and certify, and the output of both."""
    folder = tmp_path_factory.mktemp("porter")
    log = write_csv(folder / "drive.csv", *drive())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BRAKELINE_DATA", str(folder / "data"))
        imported = brakeline("import", log, "--robot", FILE, "--json")
        assert imported.returncode == 0, imported.stderr
        words = ("--use", *WORDS, "--certificates", "residual", "--mode", "direct", "--json")
        certify = brakeline("certify", FILE, *words)
        assert certify.returncode == 0, certify.stderr
        yield folder, json.loads(imported.stdout), json.loads(certify.stdout)


@pytest.fixture(scope="module")
def ready(certified):
    return Filter(ModelSet.load(data_paths.model_path(porter(), ModelConfig())))


def test_four_commands_from_a_csv_to_an_answer(certified, tmp_path):
    _, imported, made = certified
    assert imported["coverage"]["stops"] > 100 and not imported["refused"]
    assert made["residual"]["windows_of"] == "free", "nobody followed the ramp"
    assert "rank" in made["residual"]["not_of"]["plan"]
    endpoint = free_endpoint()
    with (tmp_path / "safety.err").open("w") as err:
        service = subprocess.Popen(
            [*BRAKELINE, "safety", str(FILE), "--listen", endpoint, *map(str, WORDS)], stderr=err, stdout=err
        )
        try:
            words = ("--connect", endpoint, "--obstacle", "cylinder 0.5 0 0.1", "--timeout", 5, "--json")

            def answered():
                assert service.poll() is None, (tmp_path / "safety.err").read_text()
                query = brakeline("query", FILE, "--action", 0.6, 0, *words)
                return json.loads(query.stdout) if query.returncode == 0 else None

            answer = until(answered, "an answer")
        finally:
            service.terminate()
            service.wait()
    assert answer["kind"] == "adjusted" and len(answer["plan"]) == porter().horizon
    assert 0.0 <= answer["plan"][0][0] < 0.6 and answer["margin"] >= 0.0


def episode(ready, seed):
    """Drive at the nearest obstacle as fast as possible.

    Returns:
        The least distance of the bodies [m], the steps, the steps outside their predicted sets, and the way [m].
    """
    rng = np.random.default_rng((7, seed))
    robot, body = porter(), porter().footprint
    discs = []
    while len(discs) < 8:
        at, radius = rng.uniform(-3.5, 3.5, 2), rng.uniform(0.05, 0.4)
        if np.linalg.norm(at) > radius + body + 0.3:
            discs.append((at, radius))
    centers, radii = np.array([at for at, _ in discs]), np.array([radius for _, radius in discs])
    shapes, _ = split_moving([Obstacle("cylinder", tuple(at), (radius,)) for at, radius in discs], 2)
    plant, backup_plan = Porter(rng, (0.0, 0.0, rng.uniform(-3, 3))), BackupPlan(robot)
    least, outside, way = np.inf, 0, 0.0
    for _ in range(STEPS):
        state = plant.measured()
        away = centers - state[:2]
        nearest = away[(np.linalg.norm(away, axis=1) - radii).argmin()]
        turn = np.arctan2(nearest[1], nearest[0]) - state[2]
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        wanted = np.array([0.6 if abs(turn) < 0.8 or rng.random() < 0.3 else 0.0, np.clip(5.0 * turn, -1.5, 1.5)])
        wanted = rng.uniform(robot.low(), robot.high()) if rng.random() < 0.1 else wanted
        before = backup_plan.input_in_force
        verified = {"model": backup_plan.model, "predicted": backup_plan.predicted}
        question = Request(state, wanted, before, backup_plan.plan, shapes, **verified)
        decision = ready.decide(question)
        outside += not decision.contained
        u = backup_plan.accept(decision.plan, decision.model, decision.predicted, decision.verified)
        path = plant.step(u, robot.period)
        least = min(least, (np.linalg.norm(path[:, None] - centers, axis=2) - radii).min() - body)
        way += float(np.linalg.norm(path[-1] - path[0]))
    return least, STEPS, outside, way


def adversary(ready, made, episodes):
    results = [episode(ready, seed) for seed in range(episodes)]
    least, steps, outside, way = (np.array(column) for column in zip(*results, strict=True))
    print(
        f"{(least <= 0.0).sum()} collisions in {episodes} episodes, nearest {least.min():.3f} m; {outside.sum()} of "
        f"{steps.sum()} steps outside, certificate: {made['residual']['bound_step']:.2%}; way {way.mean():.2f} m"
    )
    assert (least > 0.0).all(), "collisions"
    assert outside.sum() <= made["residual"]["bound_step"] * steps.sum(), "more than the certificate states"
    assert way.mean() > 0.3, "it may move"


def test_an_adversary_hits_nothing(certified, ready):
    adversary(ready, certified[2], EPISODES)


@pytest.mark.long
def test_an_adversary_hits_nothing_in_200_episodes(certified, ready):
    adversary(ready, certified[2], 200)
