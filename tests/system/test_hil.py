"""The real PX4 flies our quadrotor: skipped where neither `$BRAKELINE_PX4` nor `../shared/px4` holds one."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.frame_log import CapturedFrame
from brakeline.actors.mavlink.px4_lockstep import FIELD, QUIET, Px4Flight, Px4Vehicle
from brakeline.deploy.run.autopilot_run import PAD, open_field
from brakeline.messaging.obstacle import CYLINDER, Obstacle
from brakeline.messaging.task import robot_with_task
from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.hil_link import HilLink
from brakeline.sim.autopilot.hil_sensors import HilSensors
from brakeline.sim.autopilot.px4_process import Px4Process
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.sim_conditions import SensorNoise
from tests.system.runs import BRAKELINE
from tests.waiting import until

PX4 = Path(os.environ.get("BRAKELINE_PX4", Path(__file__).parents[3] / "shared" / "px4"))
EVERY = 10  # physics steps between two setpoints: 20 Hz
HEARTBEAT = 200
ROBOT = Path(__file__).parents[2] / "examples" / "px4" / "quadrotor_px4.toml"
POST = Obstacle(CYLINDER, (0.0, -12.0, 5.0), (0.8, 20.0))

pytestmark = pytest.mark.skipif(not (PX4 / "etc").is_dir(), reason="no PX4: neither $BRAKELINE_PX4 nor ../shared/px4")


class Flight:
    """A client that flies PX4 over UDP; time passes only in `run`."""

    def __init__(self, hil: HilLink, link: socket.socket, port: int) -> None:
        self.hil, self.link = hil, link
        self.client = AutopilotClient(lambda data: link.sendto(data, ("127.0.0.1", port)), tap=self.hear)
        self.begins: np.ndarray | None = None  # its local frame, as it says itself, m, ENU
        self.setpoint = np.zeros(3)
        self.count = 0

    def run(self, seconds: float, *setpoint: float) -> None:
        if setpoint:
            self.setpoint = np.array(setpoint)
        for _ in range(round(seconds / self.hil.vehicle.timestep)):
            if self.count % EVERY == 0:
                self.client.setpoint(self.setpoint)
            if self.count % HEARTBEAT == 0:
                self.client.heartbeat()
            self.count += 1
            self.hil.tick()
            self.listen()

    def listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.client.feed(self.link.recv(65536))

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        end = self.hil.time + seconds
        while not condition() and self.hil.time < end:
            self.run(0.05)
        return condition()

    def hear(self, frame: CapturedFrame) -> None:
        message = frame.message
        if message.get_type() == "GPS_GLOBAL_ORIGIN":
            north, east = 1e-7 * message.latitude - ned_frames.LATITUDE, 1e-7 * message.longitude - ned_frames.LONGITUDE
            east *= math.cos(math.radians(ned_frames.LATITUDE))
            up = 1e-3 * message.altitude - ned_frames.ALTITUDE
            self.begins = np.array([east / ned_frames.DEGREES, north / ned_frames.DEGREES, up])

    def find_frame(self) -> None:
        """On a busy machine it hears the first fixes late: its frame may begin decimetres above or below the ground."""
        self.client.request(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, self.wait)
        assert self.wait(lambda: self.begins is not None, 5.0)

    def lost(self) -> np.ndarray:
        """m from where it is to where PX4 believes to be, ENU."""
        assert self.client.position is not None and self.begins is not None
        return np.asarray(self.client.position + self.begins - self.hil.vehicle.state()[:3])

    def goes_at(self, *velocity: float) -> bool:
        """What the simulator knows of it."""
        return bool(np.abs(self.hil.vehicle.state()[3:6] - velocity).max() < 0.25)


def px4s(process: psutil.Process) -> list[psutil.Process]:
    return [child for child in process.children() if "px4" in child.name()]


@pytest.fixture
def flight() -> Iterator[Flight]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        px4 = Px4Process(PX4, link.getsockname()[1])
        try:
            field = open_field()
            arena = replace(field, obstacles=(POST, *field.obstacles))
            rng = np.random.default_rng(0)
            vehicle = Quadrotor(arena, rng, QUIET, floor=PAD)
            hil = HilLink(px4.connection, vehicle, HilSensors(SensorNoise(), rng, vehicle.timestep))
            yield Flight(hil, link, px4.local)
        finally:
            px4.close()


def test_px4_flies_our_vehicle_by_its_own_estimate(flight: Flight) -> None:
    client, hil, vehicle = flight.client, flight.hil, flight.hil.vehicle
    while not hil.answering:
        hil.tick()
    assert flight.wait(lambda: client.position is not None, 60.0), client.texts
    client.follow_setpoints(flight.wait)
    client.arm(flight.wait)

    flight.run(0.1, 0.0, 0.0, 1.5)
    assert flight.wait(lambda: vehicle.state()[2] > 3.0, 20.0), client.texts
    flight.run(0.1, 0.0, 0.0, 0.0)
    assert flight.wait(lambda: flight.goes_at(0.0, 0.0, 0.0), 10.0)
    flight.run(2.0)
    assert hil.armed and not vehicle.on_floor
    assert np.linalg.norm(vehicle.state()[3:6]) < 0.15  # it hovers
    flight.find_frame()
    assert flight.begins is not None and np.abs(flight.begins).max() < 1.5
    assert flight.wait(lambda: np.abs(flight.lost()).max() < 0.3, 20.0) or np.abs(flight.lost()).max() < 1.0
    lost = flight.lost()  # what it does not find on a busy machine is constant

    for velocity in ((3.0, 0.0, 0.0), (0.0, 2.0, 0.5), (-3.0, 0.0, 0.0)):
        flight.run(0.1, *velocity)
        assert flight.wait(lambda v=velocity: flight.goes_at(*v), 10.0), (velocity, vehicle.state())
    assert not vehicle.collided

    flight.run(0.1, 0.0, 0.0, 0.0)
    assert flight.wait(lambda: flight.goes_at(0.0, 0.0, 0.0), 10.0)
    assert np.abs(flight.lost() - lost).max() < 0.4  # nine metres on
    across = -vehicle.state()[0] / 4.0  # m/s, back over the start within four seconds
    flight.run(4.0, across, 0.0, 0.0)
    flight.run(0.1, 0.0, -3.0, 0.0)
    assert flight.wait(lambda: vehicle.collided, 15.0)  # the post is in MuJoCo alone: nobody else could know
    assert np.linalg.norm(vehicle.state()[:2] - np.array(POST.position[:2])) < 1.5
    assert hil.unanswered == 0


def test_episodes_follow_each_other_in_the_air_and_after_a_crash_px4_starts_again() -> None:
    robot = robot_with_task(str(ROBOT))
    flight = Px4Flight(PX4, SensorNoise())
    try:
        for episode, wanted in enumerate(((2.0, -1.0, 0.5), (-4.0, 3.0, 0.0), (0.0, 0.0, -3.0))):
            if episode == 2:
                for process in px4s(psutil.Process()):
                    process.kill()
                    process.wait()
            start = (50.0 * episode, -20.0, 400.0)
            vehicle = Px4Vehicle(
                flight, Quadrotor(replace(FIELD, start=start), np.random.default_rng(episode), QUIET), robot
            )
            assert np.abs(vehicle.true[:6] - [*start, 0.0, 0.0, 0.0]).max() < 0.2
            before = vehicle.measured
            for _ in range(15):
                period = vehicle.step(np.array(wanted))
                error = np.abs(period.measured - period.true)
                assert (error < np.repeat((0.5, 0.5, 3.0), 3)).all(), error  # m, m/s, m/s²; on a busy machine
                assert np.abs(period.subsamples[-1] - (period.measured - before)[:3]).max() < 1e-6
                before = period.measured
            assert np.abs(vehicle.true[3:6] - wanted).max() < 0.3
        assert flight.starts == 2
    finally:
        flight.close()


def test_the_command_says_how_fast_it_was_and_leaves_nothing_behind() -> None:
    words = [*BRAKELINE, "autopilot", "--px4", PX4, "--speed", 0, "--truth", "", "--arena", "default"]
    begun = subprocess.Popen([*map(str, words)], stderr=subprocess.PIPE, text=True)
    assert begun.stderr is not None
    try:
        assert "its local frame begins at" in begun.stderr.readline()
        children = px4s(psutil.Process(begun.pid))
        begun.send_signal(signal.SIGINT)
        assert begun.wait(30.0) == 0
        figures = begun.stderr.read()
        assert "speed " in figures and "unanswered 0" in figures
    finally:
        begun.kill()
        begun.stderr.close()
    assert children
    until(lambda: not any(child.is_running() for child in children), "no PX4 left")

    done = subprocess.run([*map(str, words), "--seconds", "6", "--json"], capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout)
    # The time before PX4's first answer does not count.
    assert figures["simulated"] > 2.5 and figures["speed"] > 0.0 and figures["unanswered"] == 0
