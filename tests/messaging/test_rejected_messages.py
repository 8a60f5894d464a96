"""One message is one message: counted, named once a second, passed over."""

import logging
import math

import pytest

from brakeline.errors import Malformed
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.message_checks import MAX_NUMBERS, MAX_OBSTACLES
from brakeline.messaging.rejected_messages import MAX_LINE_LENGTH, RejectedMessages, headline
from brakeline.messaging.topics import EPISODE, EXCHANGE, HEALTH, LOG, STEP, Topic


def test_what_fails_is_counted_and_named_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    rejected = RejectedMessages(clock=lambda: now[0])
    for moment in (0.0, 0.5, 0.9, 1.1, 1.2):
        now[0] = moment
        with rejected.skip_on_error(f"step/at {moment}"):
            raise ValueError("seven")
    assert rejected.count == 5
    assert [record.getMessage() for record in caplog.records] == [
        "passed over (1 so far): step/at 0.0: ValueError: seven",
        "passed over (4 so far): step/at 1.1: ValueError: seven",
    ]


def test_what_was_not_expected_is_named_with_its_place_and_an_interrupt_goes_through(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rejected = RejectedMessages()
    with rejected.skip_on_error("a"):
        raise ZeroDivisionError
    assert caplog.records[0].exc_info is not None and caplog.records[0].levelno == logging.ERROR
    with pytest.raises(KeyboardInterrupt), rejected.skip_on_error("b"):
        raise KeyboardInterrupt
    assert rejected.count == 1


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", ""),
        ("\n", ""),
        ("one\ntwo", "one"),
        ("\x1b[2Jgone\x07", "\N{REPLACEMENT CHARACTER}[2Jgone\N{REPLACEMENT CHARACTER}"),
        ("a" * 10**6, "a" * MAX_LINE_LENGTH),
    ],
)
def test_a_headline_is_one_line_that_a_terminal_can_show(text: str, line: str) -> None:
    assert headline(text) == line


def stamped(time: float = 0.0, wall_time: int = 0, source: str = "a") -> pb.Header:
    return pb.Header(time=time, wall_time=wall_time, source=source)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        *((STEP, pb.Step(header=stamped(time=time))) for time in (math.inf, -math.inf, math.nan, 1e10)),
        *((LOG, pb.LogLine(header=stamped(wall_time=wall_time))) for wall_time in (-1, 2**62, -(2**63))),
        (HEALTH, pb.Health(header=stamped(source="../up"))),
        (HEALTH, pb.Health(process="a" * 101)),
        (STEP, pb.Step(actor="actor/0")),
        (EXCHANGE, pb.Exchange(request=pb.Request(actor="a\nb"))),
        (EXCHANGE, pb.Exchange(request=pb.Request(obstacles=[pb.Obstacle()] * (MAX_OBSTACLES + 1)))),
        (EPISODE, pb.Episode(obstacles=[pb.Obstacle()] * (MAX_OBSTACLES + 1))),
        (STEP, pb.Step(state=[0.0] * (MAX_NUMBERS + 1))),
    ],
)
def test_what_no_honest_sender_says_is_malformed(topic: Topic, message: object) -> None:
    with pytest.raises(Malformed):
        Sample(topic, topic.at(robot="ground", source="a"), message.SerializeToString(), 1).message()


def test_what_honest_senders_say_is_not_but_other_bytes_are() -> None:
    with pytest.raises(Malformed, match="not a Step"):
        Sample(STEP, "step/ground/x", b"\xff\xff\xff", 0).message()
    name = "actor-host.example_1"
    step = pb.Step(header=stamped(4.2, 1_800_000_000 * 10**9, name), robot="ground", actor=name)
    step.clearance = math.inf
    assert Sample(STEP, f"step/ground/{name}", step.SerializeToString(), 1).message() == step
