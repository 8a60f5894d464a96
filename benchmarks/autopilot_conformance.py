"""Compare real autopilots with the embedded ones: answers to the same messages, and how they brake.

Needs `$BRAKELINE_ARDUPILOT` and `$BRAKELINE_PX4`: folders whose `sitl FOLDER INSTANCE` runs one. The benchmark leaves
out what is missing. In real time: two minutes for each.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks import sitl
from benchmarks.ground_station import VELOCITY_ONLY, Station
from benchmarks.timing import Words
from brakeline.actors.mavlink.mavlink_decoder import OFFBOARD
from brakeline.messaging.byte_links import open_link
from brakeline.sim.autopilot.common_dialect import mavlink as m
from tests.system.flights import autopilot

Manners = dict[str, float | str]

LAND = {"ardupilot": (9, 0), "px4": (4, 6)}  # main and sub mode
ASKED = ("ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "LOCAL_POSITION_NED", "LOCAL_POSITION_NED_COV", "ODOMETRY")
HEIGHT, SPEED = 5.0, 3.0  # m, m/s
READY, CLIMB, CRUISE, BRAKE, SILENCE, LANDING = 90.0, 20.0, 6.0, 6.0, 8.0, 30.0  # s at most
VELOCITY = 0x038  # bits of a type mask
NORTH = (SPEED, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)


def run() -> Words:
    """Return a row for each request, with the answer of each autopilot."""
    columns: dict[str, Manners] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in sitl.KINDS:
            try:
                with sitl.flying(kind, sitl.program(kind), Path(folder)) as (url, system):
                    columns[f"{kind}, real"] = manners(url, system, kind)
            except sitl.NoAutopilot as none:
                print(none, file=sys.stderr)
            with embedded(kind) as url:
                columns[f"{kind}, embedded"] = manners(url, 1, kind)
    rows: Words = {}
    for name, answers in columns.items():
        for what, answer in answers.items():
            rows.setdefault(what, {})[name] = answer
    return rows


@contextmanager
def embedded(kind: str) -> Iterator[str]:
    """Run `brakeline autopilot` on the ground, in real time, until the end of the block. Yields its URL."""
    with autopilot("--rules", kind) as port:
        yield f"udpin:127.0.0.1:{port}"


def manners(url: str, system: int, kind: str) -> Manners:
    """Return the answers of one autopilot from its start to its landing."""
    link = open_link(url)
    try:
        station = Station(link, system)
        answers = on_the_ground(station, kind)
        answers |= up(station, kind)
        answers |= in_the_air(station, kind)
        return answers | down(station, kind)
    finally:
        link.close()


def on_the_ground(station: Station, kind: str) -> Manners:
    """Send requests to the autopilot on the ground."""
    station.listen(READY, lambda: "HEARTBEAT" in station.last)
    answers: Manners = {"boots in mode": station.mode}
    started = time.monotonic()
    answers["arm, at once"] = switch(station, True)
    while switch(station, True) != "accepted" and time.monotonic() - started < READY:
        station.listen(1.0)
    answers["arms after [s]"] = round(time.monotonic() - started, 1)
    station.listen(2.0, lambda: station.armed)
    answers["arm, armed already"] = switch(station, True)
    answers["disarm"] = switch(station, False)
    station.listen(2.0, lambda: not station.armed)
    for name in ASKED:
        answers[f"{name} at 20 Hz"] = interval(station, name)
    answers["interval of message 9999"] = station.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 50_000)
    answers["command USER_1"] = station.command(m.MAV_CMD_USER_1)
    answers["mode 99"] = station.command(m.MAV_CMD_DO_SET_MODE, 1, 99, 0)
    station.listen(1.2)
    answers["mode after mode 99"] = station.mode
    answers["guided (offboard) without setpoints"] = to_offboard(station, kind)
    station.listen(1.2)
    answers["mode after that"] = station.mode
    answers["take off, disarmed"] = take_off(station, kind)
    return answers


def up(station: Station, kind: str) -> Manners:
    """Arm and take off, in the order that each kind wants."""
    started = time.monotonic()
    interval(station, "LOCAL_POSITION_NED", 0.0)
    station.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 100_000)
    station.listen(READY, lambda: "LOCAL_POSITION_NED" in station.last)
    station.velocity = STILL
    station.listen(1.5)
    while to_offboard(station, kind) != "accepted" and time.monotonic() - started < READY:
        station.listen(1.0)
    answers: Manners = {"guided (offboard) with setpoints": to_offboard(station, kind)}
    answers["its mode"] = station.mode
    answers["arm"] = switch(station, True)
    while not station.armed and time.monotonic() - started < READY:
        switch(station, True)
        station.listen(1.0)
    answers["flies after [s]"] = round(time.monotonic() - started, 1)
    ground = place(station)[2]
    station.velocity = None if kind == "ardupilot" else STILL  # a setpoint would end ArduCopter's climb
    answers["take off"] = take_off(station, kind)
    if kind == "px4":  # takeoff is a mode of its own there
        station.listen(CLIMB, lambda: ground - place(station)[2] > 1.5)
        to_offboard(station, kind)
        station.velocity = (0.0, 0.0, -1.0)
    answers["at 4.5 m after [s]"] = round(station.listen(CLIMB, lambda: ground - place(station)[2] > 0.9 * HEIGHT), 1)
    station.velocity = STILL
    station.listen(2.0)
    return answers


def in_the_air(station: Station, kind: str) -> Manners:
    """Send requests to the flying autopilot, and setpoints that it follows or refuses."""
    answers: Manners = {
        "arm, in the air": switch(station, True),
        "disarm, in the air": switch(station, False),
        "still armed": str(station.armed),
        "mode 99, in the air": station.command(m.MAV_CMD_DO_SET_MODE, 1, 99, 0),
    }
    station.listen(1.2)
    answers["mode after mode 99, in the air"] = station.mode
    to_offboard(station, kind)
    answers |= driven(station)
    station.velocity = STILL
    answers |= braked(station, "setpoint zero", BRAKE)
    cruise(station)
    station.velocity = None
    answers |= braked(station, "silence", SILENCE)
    answers["mode after silence"] = station.mode
    station.velocity = STILL
    station.listen(3.0)
    answers["mode when setpoints come again"] = station.mode
    answers["guided (offboard) again"] = to_offboard(station, kind)
    # Not NaN: it ends ArduCopter's simulator by a floating point exception.
    for what, frame, mask in (
        ("of a global frame", int(m.MAV_FRAME_GLOBAL), VELOCITY_ONLY),
        ("that hold nothing", station.frame, VELOCITY_ONLY | VELOCITY),
    ):
        answers[f"speed after 2 s of setpoints {what} [m/s]"] = after(station, frame, mask)
        answers[f"mode after setpoints {what}"] = station.mode
        station.listen(3.0)
        to_offboard(station, kind)
    return answers


def down(station: Station, kind: str) -> Manners:
    """Land."""
    main, sub = LAND[kind]
    answers: Manners = {"mode land": station.command(m.MAV_CMD_DO_SET_MODE, 1, main, sub)}
    station.velocity = None

    def landed() -> bool:
        state = station.last.get("EXTENDED_SYS_STATE")
        return state is not None and state.landed_state == m.MAV_LANDED_STATE_ON_GROUND

    station.listen(LANDING, landed)
    answers["disarms after landing [s]"] = round(station.listen(LANDING, lambda: not station.armed), 1)
    answers["mode after landing"] = station.mode
    answers["arm, in mode land"] = switch(station, True)
    switch(station, False)
    return answers


def driven(station: Station) -> Manners:
    """Return how the speed rises with a setpoint of `SPEED`."""
    station.velocity = NORTH
    answers: Manners = {}
    for second in (1, 2, 4):
        station.listen(1.0 if second < 4 else 2.0)
        answers[f"speed after {second} s at {SPEED:g} m/s [m/s]"] = round(speed(station), 2)
    return answers


def cruise(station: Station) -> None:
    """Fly north until the speed is `SPEED`."""
    station.velocity = NORTH
    station.listen(CRUISE)


def braked(station: Station, name: str, seconds: float) -> Manners:
    """Return when the vehicle has slowed down, when it stands, and the way that it took."""
    began, fast = place(station), speed(station)
    slows = station.listen(seconds, lambda: speed(station) < 0.6 * fast)
    stands = slows + station.listen(seconds, lambda: speed(station) < 0.3)
    way = math.dist(began[:2], place(station)[:2])
    return {
        f"{name}: at 60 % of its speed after [s]": round(slows, 1),
        f"{name}: stands after [s]": round(stands, 1),
        f"{name}: way [m]": round(way, 1),
    }


def after(station: Station, frame: int, mask: int) -> float:
    """Return the speed after 2 s of setpoints in another frame or with another mask, from `SPEED` on."""
    cruise(station)
    ordinary = station.frame
    station.frame, station.mask = frame, mask
    station.listen(2.0)
    reached = round(speed(station), 1)
    station.velocity, station.frame, station.mask = STILL, ordinary, VELOCITY_ONLY
    return reached


def switch(station: Station, on: bool) -> str:
    """Arm or disarm. Returns the answer."""
    return station.command(m.MAV_CMD_COMPONENT_ARM_DISARM, float(on))


def to_offboard(station: Station, kind: str) -> str:
    """Request the mode that follows setpoints. Returns the answer."""
    return station.command(m.MAV_CMD_DO_SET_MODE, 1, OFFBOARD[kind][0])


def take_off(station: Station, kind: str) -> str:
    """Take off to `HEIGHT`: ArduCopter counts it from home, PX4 from the sea. Returns the answer."""
    if kind == "ardupilot":
        return station.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT)
    station.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 200_000)
    station.listen(2.0, lambda: "GLOBAL_POSITION_INT" in station.last)
    height = 1e-3 * station.last["GLOBAL_POSITION_INT"].alt + HEIGHT
    return station.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, math.nan, math.nan, height)


def interval(station: Station, name: str, seconds: float = 1.5) -> str:
    """Request a message at 20 Hz. Returns the answer, and whether the message then comes."""
    answer = station.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, getattr(m, f"MAVLINK_MSG_ID_{name}"), 50_000)
    if seconds:
        station.received[name] = 0
        station.listen(seconds)
        answer += ", comes" if station.received[name] > 0.5 * seconds / 0.05 else ", does not come"
    return answer


def place(station: Station) -> tuple[float, float, float]:
    """Return the position (NED) [m]."""
    station.listen(1.0, lambda: "LOCAL_POSITION_NED" in station.last)
    at = station.last["LOCAL_POSITION_NED"]
    return at.x, at.y, at.z


def speed(station: Station) -> float:
    """Return the horizontal speed [m/s]."""
    at = station.last["LOCAL_POSITION_NED"]
    return math.hypot(at.vx, at.vy)
