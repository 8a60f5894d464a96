"""A vehicle server in its own process: actors fly, die and take over, and the socket carries invalid messages."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink import vehicle_client
from brakeline.actors.mavlink.frame_log import decode_frame
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.actors.mavlink.vehicle_client import VehicleClient
from brakeline.actors.mavlink.vehicle_messages import (
    FlightRequest,
    period_message,
)
from brakeline.actors.mavlink.vehicle_server import FRAMES_PER_UPDATE, MOST_QUEUED, ActorOutbox, next_actor
from brakeline.actors.mavlink.vehicle_socket import LARGEST, MessageSocket, address, connect, listening, same_user
from brakeline.errors import BadInput, BadMessage, CommandLost, MavlinkError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import Mode
from tests.actors.conftest import STALL, served
from tests.actors.test_flight_process import STANDING
from tests.actors.test_lockstep_quadrotor import quadrotor
from tests.robots import QUADROTOR
from tests.waiting import until

# The server does not know this robot's name: the request contains the whole description.
ROBOT = replace(QUADROTOR, name="mine").in_real_time()


@pytest.fixture
def flown() -> Iterator[tuple[str, Autopilot]]:
    """Run an autopilot in the air in a thread. Yield its URL and the autopilot."""
    autopilot = Autopilot(quadrotor(), "px4")
    with served(autopilot) as url:
        yield url, autopilot


@contextmanager
def actor(
    url: str, frames: list[pb.MavlinkFrame] | None = None, height: float = 2.0, rejected: RejectedMessages | None = None
) -> Iterator[VehicleClient]:
    request = FlightRequest(FlightSettings(url, height=height), ROBOT, ())
    tap: Callable[[pb.MavlinkFrame], None] = (frames if frames is not None else []).append
    with contextlib.closing(VehicleClient(request, tap, rejected or RejectedMessages(), lambda: False)) as vehicle:
        yield vehicle


def setpoints(frames: list[pb.MavlinkFrame]) -> list[Any]:
    """Return the setpoints among the frames, in their order."""
    sent = [decode_frame(frame.raw, True) for frame in frames if frame.outgoing]
    return [f.message for f in sent if f is not None and f.message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


def test_a_dead_actors_plan_is_flown_to_its_end_and_the_next_actor_takes_over(
    flown: tuple[str, Autopilot], stalled: Callable[[], float]
) -> None:
    url, autopilot = flown
    first: list[pb.MavlinkFrame] = []
    second: list[pb.MavlinkFrame] = []
    with contextlib.ExitStack() as stack:
        vehicle = stack.enter_context(actor(url, first))
        number = vehicle.current_period.number + 2
        plan = np.array([[0.8, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 0.0, 0.0], [0.8, 0.0, 0.0]])
        assert vehicle.commit(plan, number) and not vehicle.commit(plan, number - 2), "that period has begun"
        period = vehicle.wait(number + 1)
        assert period.number == number + 1 or stalled() > STALL, "a machine that stalls may miss it"
        then = np.vstack([plan, np.zeros((ROBOT.horizon, 3))])
        assert period.input == pytest.approx(then[min(period.number - number, ROBOT.horizon)])
        vehicle.leave()
        with pytest.raises(MavlinkError, match="ended"):
            vehicle.wait(number + 5)

        next_vehicle = stack.enter_context(actor(url, second))
        period = next_vehicle.current_period
        assert period.number >= number + ROBOT.horizon, "the periods went on"
        assert np.linalg.norm(period.report.measured[3:6]) < 0.3 and not period.lost, "it hovers"
        braked = 1.5 * stalled()  # m less than the plan: after a stall, the vehicle brakes
        assert period.report.measured[0] > 0.5 - braked, "where the plan ended"
        assert autopilot.flight.mode is Mode.OFFBOARD
        next_vehicle.wait(next_vehicle.current_period.number + 6)
        assert next_vehicle.figures["periods"] >= number
    numbers = np.array(
        [frame.raw[4] for frame in first + second if frame.outgoing], int
    )  # MAVLink counts from 0 to 255
    assert set(np.diff(numbers) % 256) == {1}, "the next actor gets the frames from the time without an actor"
    sent = setpoints(first + second)
    assert set(np.round([m.vy for m in sent], 3)) == {0.0, 0.8, 1.5}, "no other setpoints were sent"


def test_a_pilot_keeps_the_vehicle_also_if_the_actor_is_replaced(flown: tuple[str, Autopilot]) -> None:
    url, autopilot = flown
    with actor(url) as vehicle:
        number = vehicle.current_period.number
        vehicle.leave()
        autopilot.flight.mode = Mode.HOLD
        time.sleep(2.0)
        with actor(url) as next_vehicle:
            next_vehicle.wait(next_vehicle.current_period.number + 5)
            periods = [next_vehicle.wait(next_vehicle.current_period.number + 1) for _ in range(10)]
            assert periods[0].number > number and autopilot.flight.mode is Mode.HOLD
            # On a machine that stalls, a period may also lack telemetry, and says that instead.
            assert all(period.lost for period in periods) and any("HOLD" in period.lost for period in periods)
            autopilot.flight.mode = Mode.OFFBOARD  # the pilot gives it back
            until(lambda: not next_vehicle.current_period.lost, "the next actor flies on", 10.0)


def test_a_vehicle_that_is_wanted_elsewhere_is_taken_over_anew(flown: tuple[str, Autopilot]) -> None:
    url, _ = flown
    with actor(url) as vehicle:
        vehicle.wait(vehicle.current_period.number + 5)
        vehicle.leave()
        with actor(url, height=3.0) as other:
            assert other.current_period.number < vehicle.current_period.number


def test_a_vehicle_that_disarmed_is_given_up_and_the_actor_hears_why(flown: tuple[str, Autopilot]) -> None:
    url, autopilot = flown
    frames: list[pb.MavlinkFrame] = []
    with actor(url, frames) as vehicle:
        autopilot.flight.disarm(True)
        with pytest.raises(CommandLost, match="it has disarmed"):
            for _ in range(25):
                vehicle.wait(vehicle.current_period.number + 1)
        until(lambda: connect(url, 1) is None, "its server ends", 10.0)
    sent = [decode_frame(frame.raw, False) for frame in frames if not frame.outgoing]
    last = [f.message for f in sent if f is not None and f.message.get_type() == "HEARTBEAT"][-1]
    assert not last.base_mode & 128, "the frames up to the end are recorded"


def test_a_vehicle_that_disarmed_without_an_actor_is_not_taken_over_by_the_next_one(
    flown: tuple[str, Autopilot],
) -> None:
    """The next actor would arm it and take off, while a person may have it in hand."""
    url, autopilot = flown
    with actor(url) as vehicle:
        vehicle.leave()
        autopilot.flight.disarm(True)
        time.sleep(4.0)
        with pytest.raises(CommandLost, match="it has disarmed"), actor(url):
            pass
        assert not autopilot.flight.armed


def test_a_process_of_another_user_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        listening("udpin:test", os.getpid()) as listener,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client_socket,
    ):
        client_socket.connect(address("udpin:test", os.getpid()))
        assert same_user(client_socket)
        user = os.getuid()
        monkeypatch.setattr("os.getuid", lambda: user + 1)
        stop = threading.Event()
        threading.Timer(0.5, stop.set).start()
        began = time.monotonic()
        assert next_actor(listener, stop, None) is None and time.monotonic() - began > 0.3
        assert client_socket.recv(1) == b"", "the server hung up"


def test_an_invalid_link_is_an_error(flown: tuple[str, Autopilot]) -> None:
    with pytest.raises(ValueError, match="a link is"), actor("nonsense:1"):
        pass


def test_invalid_commands_are_skipped_the_flight_goes_on_and_its_end_brakes_the_vehicle(
    flown: tuple[str, Autopilot], caplog: pytest.LogCaptureFixture, stalled: Callable[[], float]
) -> None:
    rejected, (url, autopilot) = RejectedMessages(), flown
    frames: list[pb.MavlinkFrame] = []
    with caplog.at_level("INFO", "brakeline"), actor(url, frames, rejected=rejected) as vehicle:
        raw = vehicle._socket._socket
        for payload in (b"\xff", b"\x80\x04\x95\x00.", b"x" * LARGEST, b"x" * (LARGEST + 1)):
            raw.send(payload)
        for command in (pb.VehicleCommand(number=7), pb.VehicleCommand(number=8, fly=pb.FlightRequest(url=url))):
            vehicle._socket.send(command)
        number = vehicle.current_period.number + 2
        with pytest.raises(BadInput):
            vehicle.commit(np.full((2, 3), np.nan), number)
        with pytest.raises(BadInput, match="a plan is"):
            vehicle.commit(np.zeros((3, 4)), number)
        with pytest.raises(BadMessage, match="too far ahead"):
            vehicle.commit(np.zeros((1, 3)), 2**63)
        for plan in (np.zeros((0, 3)), np.zeros((ROBOT.horizon + 1, 3))):
            with pytest.raises(BadMessage, match="a plan has"):
                vehicle.commit(plan, number)
        misshapen = pb.VehicleCommand(commit=pb.PlanCommit(period=number, plan=[0.0] * 4))
        reply = vehicle._ask(misshapen)
        assert reply is not None and reply.error.type == "BadMessage" and not reply.in_time
        after = vehicle.wait(vehicle.current_period.number + 3)
        assert not after.input.any(), "no invalid plan was flown"
        # On a busy machine, the server's process may wait: no command makes a gap in the telemetry.
        assert not after.lost or after.lost.startswith("no telemetry"), "no invalid command ended the flight"
        until(lambda: not vehicle.wait(vehicle.current_period.number + 1).lost, "the flight goes on")
        until(lambda: rejected.count >= 11, "the server's count")
        plan, speeds = np.array([[0.8, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 0.0, 0.0], [0.7, 0.0, 0.0]]), []
        while len(speeds) < 5 and max(speeds, default=0.0) <= 0.5:  # a machine that stalls brakes the vehicle
            number = vehicle.current_period.number + 2
            flies = vehicle.commit(plan, number)
            vehicle.wait(number + 2)
            speeds.append(np.linalg.norm(vehicle.current_period.report.measured[3:6]) if flies else 0.0)
            assert speeds[-1] > 0.5 or stalled() > STALL, "a valid plan still counts"
        assert speeds[-1] > 0.5, "the machine stalled in each of five flights"
    assert np.linalg.norm(autopilot.vehicle.state()[3:6]) < 0.3
    assert setpoints(frames)[-1].vy == 0.0, "the plan was sent to its end"
    lines = [record.message for record in caplog.records if "passed over" in record.message]
    assert lines and "vehicle command" in lines[0], "the actor's log says so"


def test_an_invalid_flight_request_gets_an_error_and_one_actor_at_a_time_is_served(
    monkeypatch: pytest.MonkeyPatch, flown: tuple[str, Autopilot]
) -> None:
    url, _ = flown
    server = subprocess.Popen([sys.executable, "-P", "-m", "brakeline.actors.mavlink.vehicle_server", url, "1"])
    try:
        until(lambda: (probe := connect(url, 1)) is not None and (probe.close() or True), "the server listens")
        for command, why in (
            (pb.VehicleCommand(close=True), "first message"),
            (pb.VehicleCommand(fly=pb.FlightRequest(url=url, system=1, robot="{")), "flight request"),
            (pb.VehicleCommand(fly=pb.FlightRequest(url=url, system=1, robot="[" * 50_000)), "flight request"),
        ):
            client = connect(url, 1)
            assert client is not None
            client.send(command)
            assert client.poll(10.0)
            failure = client.receive(pb.VehicleMessage).failure
            assert failure.type == "BadMessage" and why in failure.message
            client.poll(10.0)
            with pytest.raises(EOFError):
                client.receive(pb.VehicleMessage)
            client.close()
        with actor(url) as vehicle:
            monkeypatch.setattr(vehicle_client, "HANDOVER_TIMEOUT", 0.5)
            with pytest.raises(MavlinkError, match="another process here flies it"), actor(url):
                pass
            vehicle.wait(vehicle.current_period.number + 2)
        assert server.wait(30.0) == 0, "it ends with the flight"
        assert connect(url, 1) is None
    finally:
        server.kill()
        server.wait()


def test_an_invalid_update_is_skipped_and_the_next_one_counts() -> None:
    """A server sends invalid messages and then falls silent: the actor gets an error and does not hang."""
    url, rejected = f"udpout:127.0.0.1:{os.getpid()}", RejectedMessages()
    good = period_message(ControlPeriod(3, np.zeros(3), STANDING))
    bad = [pb.ControlPeriod(), pb.ControlPeriod.FromString(good.SerializeToString())]
    bad[1].measured[4] = np.nan

    def serve(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        there = MessageSocket(connection)
        there.poll(10.0)
        there.receive(pb.VehicleCommand)
        connection.send(b"\xff")
        connection.send(b"x" * (LARGEST + 1))
        for period in bad:
            there.send(pb.VehicleMessage(update=pb.VehicleUpdate(period=period)))
        there.send(pb.VehicleMessage(update=pb.VehicleUpdate(period=good)))
        silent.wait()
        there.close()

    silent = threading.Event()
    with listening(url, 1) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        request = FlightRequest(FlightSettings(url), ROBOT, ())
        vehicle = VehicleClient(request, lambda _: None, rejected, lambda: False)
        assert vehicle.current_period.number == 3 and rejected.count == 4
        assert not vehicle.commit(np.zeros((1, 3)), 5), "without a reply the plan counts as late"
        with pytest.raises(MavlinkError, match="period 4 does not begin"):
            vehicle.wait(4)
        silent.set()
        with pytest.raises(MavlinkError, match="the vehicle server has ended"):
            vehicle.wait(4)
        vehicle.leave()
        thread.join()


def test_an_actor_that_does_not_read_delays_nobody() -> None:
    """Its messages wait in the outbox; once the actor is gone, the next one gets the frames."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    outbox, frames = ActorOutbox(), [pb.MavlinkFrame(wall_time=n, raw=bytes(280)) for n in range(FRAMES_PER_UPDATE)]
    message = pb.VehicleMessage(update=pb.VehicleUpdate(frames=frames))
    assert message.ByteSize() < LARGEST
    outbox.actor = MessageSocket(near)
    began = time.monotonic()
    for _ in range(MOST_QUEUED + 5):
        outbox.put(message)
    assert outbox.full and time.monotonic() - began < 0.5
    far.close()
    until(lambda: not outbox.full, "it gives up on that actor", 5.0)
    until(lambda: len(outbox.unsent) >= MOST_QUEUED * FRAMES_PER_UPDATE, "the frames are stored", 5.0)
    outbox.dismiss(outbox.actor)
    outbox.close()
    assert near.fileno() == -1
