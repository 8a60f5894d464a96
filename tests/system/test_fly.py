"""Test `brakeline fly`: a quadrotor in real time over UDP, also while its processes are killed.

The share of answers in time depends on other load on the machine. docs/flying.md has the share without other load.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from pymavlink import mavutil

from benchmarks.timing import stalls
from brakeline.actors.mavlink.frame_log import decode_frame
from brakeline.deploy import cli
from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import load
from brakeline.logs.reader import Record, read
from brakeline.messaging import brakeline_pb2 as pb
from tests.accepting import WORDS
from tests.robots import QUADROTOR
from tests.system.runs import Run
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("flight_folder")

# Share of the answers, less the share of the time for which the machine stalls. With a range image a decision takes ten
# times as long.
IN_TIME = {"map": 0.9, "scan": 0.5}
TIMEOUT = 1.0  # s without a setpoint until the autopilot brakes and holds, for good: a stall is shorter
OFTEN = 0.06  # s between two setpoints, as a rule
PX4_POSITION, PX4_OFFBOARD = 3 << 16, 6 << 16  # custom modes


class Flight(Run):
    """`brakeline fly` in progress."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        super().__init__(folder, "--setpoint-timeout", TIMEOUT, *WORDS, *arguments, command=("fly", "quadrotor"))


def follows_the_plan(records: list[Record]) -> int:
    """Check that every step executed its decision, or without one the next input of the plan before.

    The first row of a plan is the input in force during the request. Returns the number of steps without a decision.
    """
    m = QUADROTOR.action_dim
    exchanges = [record.message for record in records if record.topic == "exchange" and not record.message.failure]
    decided = {(e.header.run, e.request.episode, e.request.step): e.reply.decision.plan for e in exchanges}
    rest, run, fallbacks = np.zeros((0, m)), 0, 0  # the inputs from the next period on
    episode, number = -1, 0  # of the step to come
    for step in (record.message for record in records if record.topic == "step"):
        if step.header.run != run:
            rest, run = np.zeros((0, m)), step.header.run  # another actor: it begins at rest
        if step.episode != episode:
            episode, number = step.episode, 0
        rest = rest[step.step - number :]  # periods that this machine let pass unseen are a gap in the numbers
        number = step.step + 1
        plan = decided.get((run, step.episode, step.step))
        assert step.fallback == (plan is None)
        rest = rest if plan is None else np.reshape(plan, (-1, m))[1:]
        assert np.allclose(step.action, rest[0] if len(rest) else np.zeros(m), atol=1e-6)
        rest, fallbacks = rest[1:], fallbacks + step.fallback
    return fallbacks


def sent(records: list[Record]) -> Iterator[tuple[float, Any]]:
    """Yield the time [s] and the content of each message to the autopilot."""
    for record in records:
        if record.topic == "frames":
            for frame in record.message.frames:
                decoded = decode_frame(frame.raw, frame.outgoing)
                if frame.outgoing and decoded is not None:
                    yield frame.wall_time * 1e-9, decoded.message


@pytest.mark.parametrize(
    ("policy", "perception", "periods"),
    [pytest.param("adversary", "scan", 25, marks=pytest.mark.long), ("astar", "map", 70)],
)
def test_it_flies_in_time_and_hits_nothing(
    policy: str, perception: str, periods: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    how = ("--minutes", periods * QUADROTOR.period / 60.0, "--policy", policy, "--perception", perception)
    with stalls(0.01) as lost, Flight(tmp_path / "run", *how) as run:
        figures = run.end()
        assert figures["finished"], run.errors.read_text()
    flight, records = figures["flight"], list(read(run.folder))
    assert figures["collisions"] == 0 and figures["steps"] == periods
    assert flight["answers in time share"] >= IN_TIME[perception] - lost.share, (flight, lost)
    assert flight["worst setpoint gap ms"] <= 1e3 * (TIMEOUT + lost.worst), (flight, lost)
    assert flight["periods slipped"] <= lost.beyond / QUADROTOR.period, (flight, lost)
    assert follows_the_plan(records) == figures["fallbacks"]
    if policy == "astar":
        widened = any(r.message.request.widening > 1.0 for r in records if r.topic == "exchange")
        assert figures["goals"] >= 1 or widened, "a period that this machine delays widens the sets for minutes"
    seen = {record.message.request.HasField("image") for record in records if record.topic == "exchange"}
    assert seen == {perception == "scan"}, "what the filter was told"

    times = [at for at, message in sent(records) if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    assert np.median(np.diff(times)) <= OFTEN and len(times) > 3 * periods

    tlog = tmp_path / "flight.tlog"
    assert cli.main(["export", str(run.folder), "--tlog", str(tlog)]) == 0
    capsys.readouterr()
    frames = [frame for record in records if record.topic == "frames" for frame in record.message.frames]
    _read_by_mavutil(tlog, frames)


@pytest.mark.long  # `make test` has two at once in tests/system/test_real_autopilots.py
def test_two_at_once_ask_one_service(tmp_path: Path) -> None:
    periods = 30
    how = ("--vehicles", 2, "--minutes", periods * QUADROTOR.period / 60.0, "--policy", "adversary")
    with stalls(0.01) as lost, Flight(tmp_path / "run", *how) as run:
        run.until_steps(5)
        assert set(run.children()) == {"recorder", "safety-0", "autopilot-0", "autopilot-1", "actor-0", "actor-1"}
        figures = run.end()
        assert figures["finished"], run.errors.read_text()
    assert figures["collisions"] == 0 and figures["steps"] == 2 * periods
    assert set(figures["flights"]) == {"actor-0", "actor-1"}
    for flight in figures["flights"].values():
        assert flight["answers in time share"] >= IN_TIME["map"] - lost.share, (flight, lost)
    records = list(read(run.folder))
    for name in ("step", "frames"):
        assert {record.message.actor for record in records if record.topic == name} == {"actor-0", "actor-1"}, name
    assert len(list((run.folder / "logs").glob("autopilot-*.log"))) == 2


def _read_by_mavutil(tlog: Path, frames: list[pb.MavlinkFrame]) -> None:
    """Check that pymavlink reads the logged frames, each with its time."""
    connection = mavutil.mavlink_connection(str(tlog))
    for frame in frames:
        message = connection.recv_match()
        assert bytes(message.get_msgbuf()) == frame.raw
        assert message._timestamp == pytest.approx(frame.wall_time * 1e-9, abs=1e-5)
    assert connection.recv_match() is None
    connection.close()


def test_what_is_killed_in_flight_hurts_nobody(tmp_path: Path) -> None:
    with Flight(tmp_path / "run", "--minutes", 0.5, "--policy", "adversary") as run:
        run.until_steps(30)
        run.kill("safety-0")
        run.until_steps(25)
        run.kill("actor-0")
        run.until_steps(25)
        actor = run.children()["actor-0"]
        vehicle_server(run).kill()
        until(lambda: not actor.is_running(), "its actor ends")
        run.until_steps(25)
        figures = run.end()
        assert figures["finished"], run.errors.read_text()
    assert figures["collisions"] == 0
    assert figures["restarts"] == {"safety-0": 1, "actor-0": 2}
    records = list(read(run.folder))
    steps = [record.message for record in records if record.topic == "step"]
    first_lives = [step for step in steps if step.header.run == steps[0].header.run]
    assert follows_the_plan(records) >= 1, "it braked along the plan"
    speeds = [float(np.linalg.norm(step.state[3:6])) for step in first_lives if step.fallback]
    assert min(speeds) < 0.3, "it came to a stop without the service"
    second, third = _takeovers(records)
    assert second["HEARTBEAT"].custom_mode == PX4_OFFBOARD, "its vehicle server flew it until it hovered"
    assert _speed(second["LOCAL_POSITION_NED"]) < 0.3
    assert third["HEARTBEAT"].custom_mode == PX4_POSITION, "without one the autopilot braked by itself, and held"
    assert "collisions=0)" in (run.folder / "logs" / "autopilot.log").read_text()
    lines = (run.folder / "logs" / "actor-0.log").read_text()
    assert "braking along the committed plan" in lines and "it hovers at" in lines


def vehicle_server(run: Run) -> psutil.Process:
    """Return the vehicle server of a run."""
    url = load(run.folder / CONFIG).flights[0].url
    words = {process: process.info["cmdline"] or [] for process in psutil.process_iter(["cmdline"])}  # none: a zombie's
    (found,) = (
        process for process, own in words.items() if "brakeline.actors.mavlink.vehicle_server" in own and url in own
    )
    return found


def _takeovers(records: list[Record]) -> list[dict[str, Any]]:
    """Return the autopilot's first message of each type to each actor but the first."""
    batches = [record.message for record in records if record.topic == "frames"]
    lives = dict.fromkeys(batch.header.run for batch in batches)
    found: dict[int, dict[str, Any]] = {life: {} for life in lives}
    for batch in batches:
        for frame in batch.frames:
            if not frame.outgoing and (known := decode_frame(frame.raw, frame.outgoing)) is not None:
                found[batch.header.run].setdefault(known.message.get_type(), known.message)
    return list(found.values())[1:]


def _speed(message: Any) -> float:
    return float(np.linalg.norm([message.vx, message.vy, message.vz]))
