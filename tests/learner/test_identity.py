"""Who joins the learner, and for whom: nobody takes an actor's place, nor all places."""

from dataclasses import replace

import pytest

from brakeline.errors import BadStep
from brakeline.learner.learner import AHEAD, MOST_ACTORS, MOST_ACTORS_OF_ONE, Learner
from brakeline.learner.transition_reader import LATEST
from tests.learner.test_core import joining, step
from tests.learner.toy import CONFIG, TOY


@pytest.fixture
def learner() -> Learner:
    learner = Learner(TOY, replace(CONFIG, lockstep=False))
    assert not learner.join(joining("actor-0"), "actor-0").HasField("error")
    return learner


def test_an_actor_does_not_join_under_the_name_of_another(learner: Learner) -> None:
    for number in range(1, 41):
        assert learner.insert(step(number))
    limit = learner.flow().limit["actor-0"]
    for index in (0, 41, LATEST - 1):
        refused = learner.join(joining("actor-0", index=index, episode=7), "actor-1")
        assert (refused.error.field, refused.HasField("weights")) == ("actor", False)
    assert learner.flow().limit["actor-0"] >= limit >= 40
    assert learner.metrics().missing == 0 and learner.insert(step(41))


@pytest.mark.parametrize("name", ["actor-00", "actor-0x", "actor", "actor-1.0"])
def test_a_name_that_only_begins_alike_is_another(learner: Learner, name: str) -> None:
    assert learner.join(joining(name), "actor-0").error.field == "actor"


def test_an_actor_joins_for_its_robots(learner: Learner) -> None:
    assert not learner.join(joining("actor-0.63"), "actor-0").HasField("error")


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
