"""Who joins the learner, for whom, and with which steps: nobody takes an actor's place, all places, or its steps."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadStep
from brakeline.learner.actor_permissions import AHEAD, MOST_ACTORS, MOST_ACTORS_OF_ONE
from brakeline.learner.learner import Learner
from brakeline.learner.transition_reader import LATEST, MOST_OBSERVED, StepReader
from tests.learner.test_core import joining, started, step
from tests.learner.toy import CONFIG, TOY


@pytest.fixture
def learner() -> Learner:
    learner = Learner(TOY, replace(CONFIG, lockstep=False))
    assert not learner.join(joining(), "actor-0").HasField("error")
    return learner


def test_steps_of_an_actor_that_never_joined_are_refused_and_counted(learner: Learner) -> None:
    for number in range(1, 51):
        with pytest.raises(BadStep, match="never joined"):
            learner.insert(step(number, actor="stranger", reward=1.0))
    assert (learner.steps, learner.rejected, len(learner._replay)) == (0, 50, 0)
    assert "stranger" not in learner.flow().limit
    assert learner.insert(step(1))


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        *(({"reward": value}, "reward") for value in (1e6, -1e6, StepReader(TOY).most_reward * 1.01, np.inf, np.nan)),
        *(({"penalty": value}, "reward") for value in (1e6, -0.1, np.inf, np.nan)),
        *(({"observation": [value, 0.0]}, "observation") for value in (MOST_OBSERVED * 1.01, -1e30, np.nan)),
        *(({"next_observation": [0.0, value]}, "next_observation") for value in (1e30, -np.inf)),
        *(({"action": [value], "proposed": [1.0]}, "action") for value in (2.1, -0.1, 1e30, np.nan)),
        *(({"proposed": [value], "action": [1.0]}, "proposed") for value in (1e30, -np.inf)),
        *(({name: 2**32 - 1}, "episode") for name in ("episode", "step")),
        *(({"index": index}, "index") for index in (0, 10**9, 2**64 - 1, AHEAD + 1 + CONFIG.window)),
        *(({name: [0.0]}, name) for name in ("observation", "next_observation")),
        ({"action": [1.0, 1.0]}, "action"),
        ({"robot": "ground"}, "robot"),
        ({"actor": ""}, "actor"),
        ({"lost": True}, "lost"),
    ],
)
def test_a_step_that_is_wrong_names_its_field_and_changes_nothing(learner: Learner, fields: dict, field: str) -> None:
    learner.flow()
    with pytest.raises(BadStep) as refused:
        learner.insert(step(1, **fields))
    assert refused.value.field == field
    assert learner.rejected == 1 and learner.steps == 0
    assert learner.insert(step(1)) and learner.metrics().missing == 0


@pytest.mark.parametrize("lockstep", [True, False])
def test_an_actor_whose_steps_are_wrong_need_not_join_again_and_no_step_counts_as_lost(lockstep: bool) -> None:
    """Such as those of a sensor that fails for some seconds: more steps than the actor may be ahead of the learner."""
    learner, _ = started(replace(CONFIG, lockstep=lockstep))
    for index in range(1, 3 * CONFIG.window):
        assert learner.flow().limit["actor-0"] >= index, "it waits, and joins again"
        with pytest.raises(BadStep, match="not finite"):
            learner.insert(step(index, observation=[float("nan")] * 2))
    assert learner.insert(step(3 * CONFIG.window))
    metrics = learner.metrics()
    assert (metrics.steps, metrics.refused, metrics.missing) == (1, 3 * CONFIG.window - 1, 0)


def test_proposals_out_of_bounds_are_clipped_as_ever(learner: Learner) -> None:
    assert learner.insert(step(1, proposed=[3.0], action=[2.0]))


@pytest.mark.parametrize(
    ("fields", "wrong"),
    [
        ({"index": 2**64 - 1}, "index"),
        ({"episode": 2**32 - 1}, "index"),
        ({"robot": "ground"}, "robot"),
        ({"layout": "0123"}, "layout"),
        ({"actor": ""}, "actor"),
    ],
)
def test_an_actor_that_does_not_fit_is_refused(learner: Learner, fields: dict, wrong: str) -> None:
    reply = learner.join(joining(**({"actor": "far"} | fields)))
    assert (reply.error.type, reply.error.field) == ("Refused", wrong)
    assert not reply.HasField("weights") and not reply.HasField("flow") and "far" not in learner.flow().limit


def test_there_is_an_end_of_actors(learner: Learner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.learner.actor_permissions.MOST_ACTORS", 10)
    assert MOST_ACTORS > 1000
    errors = [learner.join(joining(f"a{n}")).error.field for n in range(12)]
    assert errors == [""] * 9 + ["actor"] * 3
    assert not learner.join(joining("a0")).HasField("error"), "who is in may come again"


def test_an_actor_does_not_join_under_the_name_of_another(learner: Learner) -> None:
    for number in range(1, 41):
        assert learner.insert(step(number))
    limit = learner.flow().limit["actor-0"]
    for index in (0, 41, LATEST - 1):
        refused = learner.join(joining("actor-0", index=index, episode=7), "actor-1")
        assert (refused.error.field, refused.HasField("weights")) == ("actor", False)
    assert learner.flow().limit["actor-0"] >= limit >= 40
    assert learner.metrics().missing == 0 and learner.insert(step(41))


def test_an_actor_joins_for_its_robots_and_for_no_name_that_only_begins_alike(learner: Learner) -> None:
    names = ("actor-0.63", "actor-00", "actor-0x", "actor", "actor-1.0")
    assert [learner.join(joining(name), "actor-0").error.field for name in names] == ["", *["actor"] * 4]


def test_an_actor_cannot_invent_steps_that_it_published(learner: Learner) -> None:
    for number in range(1, 11):
        learner.insert(step(number))
    limit = learner.flow().limit["actor-0"]
    refused = learner.join(joining("actor-0", index=limit + AHEAD + 1), "actor-0")
    assert refused.error.field == "index" and learner.metrics().missing == 0
    assert not learner.join(joining("actor-0", index=limit), "actor-0").HasField("error")
    assert learner.metrics().missing == limit - 10, "those that it may have published are missing"


def test_an_actor_cannot_invent_steps_before_a_restart_of_the_learner(learner: Learner, tmp_path) -> None:
    learner.insert(step(1))
    learner.save(tmp_path)
    later = Learner(TOY, learner.config)
    later.restore(tmp_path)
    assert later.join(joining("actor-0", index=2 * 10**9), "actor-0").error.field == "index"
    assert later.metrics().missing == 0
    assert not later.join(joining("actor-0", index=learner.config.steps), "actor-0").HasField("error")


def test_one_identity_does_not_take_all_places(learner: Learner) -> None:
    errors = [learner.join(joining(f"actor-1.{n}"), "actor-1").error.field for n in range(MOST_ACTORS + 1)]
    assert errors.count("") == MOST_ACTORS_OF_ONE and errors[-1] == "actor"
    assert not learner.join(joining("actor-2"), "actor-2").HasField("error"), "there is room for the others"


def test_a_feeder_speaks_for_the_actors_of_logs_until_they_are_there_themselves(learner: Learner) -> None:
    assert not learner.join(joining("actor-5"), "feeder-toy").HasField("error")
    assert learner.insert(step(1, actor="actor-5"), logged=True)
    assert not learner.join(joining("actor-5", index=0, episode=0), "actor-5").HasField("error")
    assert learner.join(joining("actor-5"), "feeder-toy").error.field == "actor"
    with pytest.raises(BadStep, match="joined by itself"):
        learner.insert(step(2, actor="actor-5"), logged=True)
    with pytest.raises(BadStep, match="joined by itself"):
        learner.insert(step(1), logged=True)
