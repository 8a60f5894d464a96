"""Logs of real autopilots (`flown/`, some seconds of each): frames and units against what their simulators knew.

An ArduCopter 4.0.7 and a PX4 of late 2024 wrote them on first flights of ours (`brakeline collect quadrotor --url`),
with velocity setpoints up to 3.8 m/s an axis. What is not needed was cut out; PX4's messages were thinned.
"""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink import DFReader
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pyulog import ULog

from brakeline.deploy.data.coverage import coverage
from brakeline.deploy.data.importer import import_sources, tables_of
from brakeline.deploy.data.log_options import LogOptions
from brakeline.deploy.data.sources.quantity_names import resolve
from brakeline.deploy.data.sources.tlog_file import _frames
from brakeline.errors import NoSource
from tests.robots import QUADROTOR

pytestmark = pytest.mark.usefixtures("reading_here")
FLOWN = Path(__file__).parent / "flown"
COPTER_EARTH = 6378100.0  # m, its simulator's
AXES = "xyz"


def degrees_east_north(latitude, longitude):
    """m, as the copter's simulator lays its map."""
    metre = COPTER_EARTH * math.pi / 180.0
    return metre * math.cos(math.radians(latitude[0])) * (longitude - longitude[0]), metre * (latitude - latitude[0])


def simulated_bin():
    """(time [s] on the log's clock, x, y, z) of the simulator, by the reader's own library alone."""
    log, rows = DFReader.DFReader_binary(str(FLOWN / "copter.bin")), []
    while (m := log.recv_match(type=["SIM"])) is not None:
        rows.append((1e-6 * m.TimeUS, m.Lat, m.Lng, m.Alt))
    log.close()
    time, latitude, longitude, up = np.array(rows).T
    return time, *degrees_east_north(latitude, longitude), up


def simulated_tlog():
    parser, rows = dialect.MAVLink(None), []
    for micros, frame in _frames((FLOWN / "copter.tlog").read_bytes()):
        m = parser.parse_buffer(frame)[0]
        if m.get_type() == "SIMSTATE":
            rows.append((1e-6 * micros, 1e-7 * m.lat, 1e-7 * m.lng))
    time, latitude, longitude = np.array(rows).T
    return time, *degrees_east_north(latitude, longitude)


def simulated_ulg():
    (one,) = ULog(str(FLOWN / "px4.ulg"), ["vehicle_local_position_groundtruth"]).data_list
    return 1e-6 * one.data["timestamp"], one.data["y"], one.data["x"], -one.data["z"]


LOGS = {"copter.bin": simulated_bin, "copter.tlog": simulated_tlog, "px4.ulg": simulated_ulg}


@pytest.fixture(scope="module", params=LOGS)
def flown(request):
    """What is read of each of the quadrotor's columns, (time, values); and the simulator's own time and position."""
    places = resolve(tables_of(FLOWN / request.param), QUADROTOR, LogOptions())
    time, *places_then = LOGS[request.param]()
    read = {name: table.series(column, 0) for name, (table, column) in places.items()}
    since = read["x"][0][0]  # both logs begin together, within a tenth of a second
    return read, time - time[0] + since, places_then


def test_it_is_where_it_is_by_its_own_truth(flown):
    """East, north and up in metres, to what an estimate is off by in a minute; the ways are ten times as long."""
    read, time, truth = flown
    for axis, true in zip(AXES, truth, strict=False):
        position = np.interp(time, *read[axis])
        assert np.ptp(true) > 5.0 or axis == "z"
        assert np.std(position - true) < 0.6, axis


def test_velocity_and_acceleration_are_those_of_the_truth(flown):
    """Over 0.8 s, for positions of the truth are rounded; slopes tell units, signs and axes."""
    read, time, truth = flown
    step = round(0.8 / float(np.median(np.diff(time))))
    for axis, true in zip(AXES, truth, strict=False):
        velocity = (true[step:] - true[:-step]) / (time[step:] - time[:-step])
        middle = 0.5 * (time[step:] + time[:-step])
        averaged = mean_over(read[f"v{axis}"], middle, 0.8)
        assert np.polyfit(velocity, averaged, 1)[0] == pytest.approx(1.0, abs=0.15), axis
        changed = (velocity[step:] - velocity[:-step]) / (middle[step:] - middle[:-step])
        felt = mean_over(read[f"a{axis}"], 0.5 * (middle[step:] + middle[:-step]), 1.2)
        assert np.corrcoef(changed, felt)[0, 1] > 0.8, axis
        assert np.polyfit(changed, felt, 1)[0] == pytest.approx(1.0, abs=0.3), axis
        assert abs(felt.mean() - changed.mean()) < 0.25, axis


def mean_over(series, middle, seconds):
    time, values = series
    grid = middle[:, None] + seconds * (np.arange(20) / 20 - 0.475)
    return np.interp(grid, time, values).mean(1)


def test_it_does_what_it_was_told(flown):
    """Some tenths of a second later, in m/s: a gain of about one (PX4 is slow), and no other axis does it."""
    read, _, _ = flown
    for axis in AXES:
        setpoint_times, setpoints = read[f"v{axis} setpoint"]
        best = {}
        for other in AXES:
            time, velocity = read[f"v{other}"]
            fits = []
            for late in np.arange(0.0, 1.2, 0.1):
                during = (time - late > setpoint_times[0]) & (time - late < setpoint_times[-1])
                in_force = setpoints[np.searchsorted(setpoint_times, time[during] - late, "right") - 1]
                correlation = float(np.corrcoef(in_force, velocity[during])[0, 1])
                fits.append((correlation, np.polyfit(in_force, velocity[during], 1)[0]))
            best[other] = max(fits)
        correlation, gain = best[axis]
        assert correlation > 0.85 and 0.5 < gain < 1.4, (axis, best)
        assert all(best[other][0] < correlation for other in AXES if other != axis), (axis, best)


@pytest.mark.parametrize("name", LOGS)
def test_a_log_as_it_is_becomes_data(name):
    imported = import_sources([FLOWN / name], QUADROTOR)
    assert imported.report.periods > 60 and imported.report.samples >= 2
    assert all(0.0 <= late < 0.7 for late in imported.report.delays.values())
    report = coverage(imported.data)
    assert f"only {report.windows} windows of a plan's length, but about 286 are needed: record more" in report.missing


def test_a_late_link_does_not_shake_what_a_vehicle_told(tmp_path):
    """It moves at 5 m/s; messages come up to 0.2 s late, and now and then in a burst after a second without any."""
    rng, vehicle, out = np.random.default_rng(0), dialect.MAVLink(None, srcSystem=1, srcComponent=1), bytearray()
    for k in range(1500):
        sent = 0.02 * k
        received = max(sent + rng.exponential(0.03) % 0.2, 8.0 if 7.0 < sent < 8.0 else 0.0)
        message = dialect.MAVLink_local_position_ned_message(round(1e3 * sent), 0.0, 5.0 * sent, *[0.0] * 4)
        out += struct.pack(">Q", round(1e6 * (1000.0 + received))) + message.pack(vehicle)
    path = tmp_path / "late.tlog"
    path.write_bytes(out)
    (table,) = tables_of(path)
    off = table.columns["position.x"] - 5.0 * table.time
    assert np.abs(off - np.median(off)).max() < 5.0 * 0.03, "30 ms"


def test_a_recording_of_two_vehicles_is_refused_with_their_names(tmp_path):
    data = (FLOWN / "copter.tlog").read_bytes()[:20_000]
    other = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    frame = dialect.MAVLink_local_position_ned_message(0, *[0.0] * 6).pack(other)
    path = tmp_path / "two.tlog"
    path.write_bytes(data[: data.index(b"\xfd")] + frame + data)
    with pytest.raises(NoSource, match="several vehicles: systems 1, 7"):
        tables_of(path)
