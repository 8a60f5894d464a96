"""Laws of the table of topics."""

import string

import pytest

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.topics import RECORDED, TOPICS, Delivery, Topic

pytestmark = pytest.mark.fast

each = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)


def test_names_and_keys_are_unique() -> None:
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)
    assert len({topic.key for topic in TOPICS}) == len(TOPICS)
    # A key's first part tells its topic, unless it is a query's.
    roots = [topic.key.split("/")[0] for topic in TOPICS if topic.delivery is not Delivery.QUERY]
    assert len(set(roots)) == len(roots)


@each
def test_a_key_has_the_names_of_its_publisher_and_else_a_wildcard(topic: Topic) -> None:
    fields = {name for _, name, _, _ in string.Formatter().parse(topic.key) if name}
    assert fields <= {"robot", "source"}
    assert "*" not in topic.at(robot="ground", source="a")
    assert topic.at().count("*") == len(fields)


@each
def test_what_is_published_is_numbered(topic: Topic) -> None:
    if topic.delivery is not Delivery.QUERY:
        header = topic.message.DESCRIPTOR.fields_by_name["header"]
        assert (header.message_type, header.number) == (pb.Header.DESCRIPTOR, 1)


def test_no_question_is_recorded_and_the_recorders_hear_all_that_is() -> None:
    assert RECORDED
    for topic in RECORDED:
        assert topic.delivery is Delivery.BLOCK and {"recorder", "viewer", "launcher"} <= set(topic.listeners)
