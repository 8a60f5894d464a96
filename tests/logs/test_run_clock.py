"""Durations come from clocks that nobody sets: a clock that jumps by an hour changes no figure."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from brakeline.logs import segment
from brakeline.logs.figure_tables import analyse
from brakeline.logs.metrics import Metrics
from brakeline.logs.run_clock import RunClock
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, Sample
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import STEP
from tests.logs.sample_log import written
from tests.waiting import until

SECOND, HOUR = 10**9, 3600 * 10**9
BEGIN = 1_700_000_000 * SECOND


def minute(received_jumps: bool) -> Iterator[tuple[str, pb.Step | pb.Health, int]]:
    """Yield 45 s of signs of life and steps of an actor whose clock jumps an hour in the middle."""
    for second in range(46):
        jump = HOUR if second >= 20 else 0
        header = pb.Header(sequence=second + 1, run=1, wall_time=BEGIN + second * SECOND + jump)
        received = BEGIN + second * SECOND + (jump if received_jumps else 0)
        yield "health/actor-0", pb.Health(header=header, process="actor-0"), received
        yield "step/ground/actor-0", pb.Step(header=header, actor="actor-0", robot="ground", step=second), received


def test_a_live_display_of_45_s_shows_45_s() -> None:
    metrics = Metrics()
    for key, message, received in minute(received_jumps=False):
        metrics.add(key, message, received)
    figures = metrics.figures()
    assert (figures["seconds"], figures["driven_s"], figures["steps_per_s"]) == (45.0, 45.0, 46 / 45)
    process = figures["processes"]["actor-0"]
    assert (process["seconds"], process["silences"]) == (45.0, 0)


@pytest.mark.parametrize("steady", [True, False])
def test_a_log_of_45_s_is_45_s_long(tmp_path: Path, steady: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Earlier versions' recorders followed the clock of the computer: their jump is left out, and told."""
    if not steady:
        monkeypatch.delitem(segment.TIMES, segment.CLOCK)
    written(tmp_path / "run.mcap", minute(received_jumps=not steady))
    figures = analyse(tmp_path)
    assert figures["seconds"] == (45.0 if steady else 44.0), "the second of the jump is not known"
    assert figures["processes"]["actor-0"]["silences"] == 0
    assert figures["cuts"] == ([] if steady else ["the recorder's clock jumped by +3601 s: the figures leave that out"])


def test_recorders_hours_apart_and_pauses_between_files_add_nothing(tmp_path: Path) -> None:
    for start in (BEGIN, BEGIN - 7 * HOUR, BEGIN + 9 * HOUR):
        first = 1 + (start != BEGIN) * 11 + (start > BEGIN) * 11
        headers = [pb.Header(run=1, sequence=first + number) for number in range(11)]
        steps = [pb.Step(header=header, actor="a", robot="ground", episode=header.sequence) for header in headers]
        written(tmp_path / "run.mcap", (("step/ground/a", step, start + k * SECOND) for k, step in enumerate(steps)))
    figures = analyse(tmp_path)
    assert (figures["steps"], figures["seconds"], figures["cuts"]) == (33, pytest.approx(30.0), [])


def test_a_clock_within_a_file_may_reorder_messages_a_little() -> None:
    clock = RunClock()
    clock.begin_file()
    assert [clock.at(BEGIN + t) for t in (0, 5, 3, SECOND)] == [BEGIN + t for t in (0, 5, 3, SECOND)]
    assert clock.jumps == []
    clock.at(BEGIN - HOUR)
    (jump,) = clock.jumps
    assert jump == pytest.approx(-3601.0)


def test_time_stamps_go_on_evenly_when_the_clock_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    samples: list[Sample] = []
    with Bus(BusSettings(listen=(free_endpoint(),)), "launcher") as bus:
        bus.subscribe(STEP, samples.append)
        publisher = bus.publisher(STEP, robot="ground")
        publisher.put(pb.Step())
        until(lambda: samples, "a step")
        real = time.time_ns
        monkeypatch.setattr(time, "time_ns", lambda: real() + HOUR)
        publisher.put(pb.Step())
        until(lambda: len(samples) == 2, "another step")
    for first, second in zip(*((s.message().header.wall_time, s.received) for s in samples), strict=True):
        assert 0 <= second - first < HOUR / 2
