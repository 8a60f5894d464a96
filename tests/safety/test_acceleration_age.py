"""A model set decides only about states whose horizontal acceleration has the age of its recorded data."""

from dataclasses import replace

import pytest

from brakeline.errors import BadData, BadModel, BadRequest
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import ENTRY, about_age, acceleration_age_in
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ALLOWED
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.client import request_message
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import request_of
from tests.robots import GROUND
from tests.safety.asked import request

STILL = [0.0] * 5


@pytest.fixture(scope="module")
def aged(model: ModelSet) -> Filter:
    return Filter(replace(model, about=model.about | about_age([0.2, 0.2])))


def test_another_age_is_refused_by_every_way_to_ask(aged: Filter, ready: Filter) -> None:
    refused = pytest.raises(BadRequest, match=r"recorded with the horizontal acceleration of 0\.2 s ago.* of 0 s ago")
    present = request(action=(0.1, 0.0), known_free=True)
    with refused:
        aged.decide(present)
    with refused:
        aged.decide_all([present] * 2000)
    with refused:
        aged.decide_batch(RequestArrays.of([present] * 2))
    with refused:
        InProcess(aged, accept_bound=1.0).decide(STILL, (0.1, 0.0), known_free=True)
    with pytest.raises(BadRequest, match=r"of 0 s ago; this state has that of 0\.2 s ago"):
        ready.decide_all([replace(present, acceleration_age=0.2)] * 2000)


def test_the_right_age_is_answered_also_after_the_wire(aged: Filter) -> None:
    session = InProcess(aged, accept_bound=1.0, acceleration_age=0.2)
    assert session.decide(STILL, (0.1, 0.0), known_free=True).kind == ALLOWED
    message = request_message(BackupPlan(GROUND, acceleration_age=0.2), STILL, (0.1, 0.0), known_free=True)
    received = request_of(pb.Request.FromString(message.SerializeToString()), GROUND)
    assert aged.decide(received).kind == ALLOWED
    assert {answer.kind for answer in aged.decide_all([received] * 2000)} == {ALLOWED}


@pytest.mark.parametrize("age", ["nan", "-0.2", "1.5", "soon"])
def test_a_model_set_with_an_impossible_age_is_refused(model: ModelSet, age: str) -> None:
    with pytest.raises(BadModel, match="age of the acceleration"):
        Filter(replace(model, about=model.about | {ENTRY: age}))


def test_data_of_different_ages_are_not_mixed() -> None:
    assert about_age([0.0, 0.0]) == {} and acceleration_age_in(about_age([0.2])) == 0.2
    with pytest.raises(BadData, match=r"different ages \(0 s, 0\.2 s\)"):
        about_age([0.2, 0.0])
