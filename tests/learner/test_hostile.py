"""Steps that nobody would have published who was taken in."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadStep
from brakeline.learner.learner import AHEAD, MOST_ACTORS, Learner
from brakeline.learner.transition_reader import MOST_OBSERVED, StepReader
from tests.learner.test_core import joining, step
from tests.learner.toy import CONFIG, TOY


@pytest.fixture
def learner() -> Learner:
    learner = Learner(TOY, replace(CONFIG, lockstep=False))
    learner.join(joining())
    return learner


def test_steps_of_an_actor_that_never_joined_are_refused_and_counted(learner: Learner) -> None:
    for number in range(1, 1501):
        with pytest.raises(BadStep, match="never joined"):
            learner.insert(step(number, actor="stranger", reward=1.0))
    assert (learner.steps, learner.rejected, len(learner._replay)) == (0, 1500, 0)
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
    ],
)
def test_a_step_that_is_wrong_names_its_field_and_changes_nothing(learner: Learner, fields: dict, field: str) -> None:
    learner.flow()
    with pytest.raises(BadStep) as refused:
        learner.insert(step(1, **fields))
    assert refused.value.field == field
    assert learner.rejected == 1 and learner.steps == 0
    assert learner.insert(step(1)) and learner.metrics().missing == 0


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
    monkeypatch.setattr("brakeline.learner.learner.MOST_ACTORS", 10)
    assert MOST_ACTORS > 1000
    errors = [learner.join(joining(f"a{n}")).error.field for n in range(12)]
    assert errors == [""] * 9 + ["actor"] * 3
    assert not learner.join(joining("a0")).HasField("error"), "who is in may come again"
