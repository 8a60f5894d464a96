"""A vehicle in real time over UDP: it carries out plans period by period, and late plans do not count."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.frame_log import CapturedFrame
from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.actors.mavlink.takeoff import LONGEST_PAUSE
from brakeline.actors.mavlink.telemetry import ATTITUDE
from brakeline.errors import BadInput, CommandLost, TelemetryMissing
from brakeline.messaging.free_ports import free_udp_port
from brakeline.sim.autopilot import autopilot_server
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT as TIMEOUT
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import Mode
from tests.actors.conftest import STALL, served
from tests.actors.test_lockstep_quadrotor import RULES, quadrotor
from tests.robots import QUADROTOR
from tests.waiting import until

GAP = 0.25  # s between two setpoints, at most

Flying = tuple[MavlinkVehicle, Autopilot, list[CapturedFrame]]


@contextlib.contextmanager
def flight_of(rules: str, floor: float | None = None) -> Iterator[Flying]:
    """Fly a vehicle that hovers at first, or stands on a floor. Yield it, its autopilot in a thread, and the frames."""
    frames, truth_port = list[CapturedFrame](), free_udp_port()
    autopilot = Autopilot(quadrotor(floor=floor), rules, parameters={TIMEOUT[rules]: 1.0})
    with (
        contextlib.closing(autopilot_server.TruthSender("127.0.0.1", truth_port)) as channel,
        served(autopilot, channel) as url,
    ):
        flight = FlightSettings(url, truth=truth_port, height=2.0, raise_limits=True)
        with contextlib.closing(MavlinkVehicle(QUADROTOR, flight, tap=frames.append)) as vehicle:
            yield vehicle, autopilot, frames


@pytest.fixture(scope="module", params=RULES)
def shared_flight(request: pytest.FixtureRequest) -> Iterator[Flying]:
    with flight_of(request.param) as flight:
        yield flight


@pytest.fixture
def flying(shared_flight: Flying) -> Flying:
    """Return a vehicle that hovers: the tests share one flight of each autopilot."""
    vehicle, _, frames = shared_flight
    until_it_hovers(vehicle)
    frames.clear()
    return shared_flight


def speed(vehicle: MavlinkVehicle) -> float:
    return float(np.linalg.norm(vehicle.current_period.report.measured[3:6]))


def until_it_hovers(vehicle: MavlinkVehicle) -> None:
    until(lambda: vehicle.idle and speed(vehicle) < 0.3 and not vehicle.current_period.lost, "hovering", 20.0)


of_one_autopilot = pytest.mark.parametrize("shared_flight", RULES[:1], indirect=True)


def setpoints(frames: list[CapturedFrame]) -> list[tuple[float, float, float]]:
    """Return the setpoints [m/s, ENU] without repetitions."""
    sent = [f.message for f in frames if f.name.endswith("SET_POSITION_TARGET_LOCAL_NED")]
    inputs = [(round(m.vy, 3), round(m.vx, 3), round(-m.vz, 3)) for m in sent]
    return [u for u, before in zip(inputs, [None, *inputs[:-1]], strict=True) if u != before]


@pytest.mark.parametrize("rules", RULES)
def test_a_vehicle_takes_off_flies_brakes_and_lands(stalled: Callable[[], float], rules: str) -> None:
    with flight_of(rules, floor=0.02) as (vehicle, autopilot, _):
        assert autopilot.flight.armed and autopilot.flight.mode is Mode.OFFBOARD
        for _ in range(12):
            period = vehicle.step(np.array([2.0, 1.0, 0.0]))
        late = 3.0 * stalled()  # m flown meanwhile: the ground truth is older, by a stall at most
        assert period.measured[3:6] == pytest.approx([2.0, 1.0, 0.0], abs=0.3 + late)  # after a stall, it brakes
        assert period.measured[:3] == pytest.approx(period.true[:3], abs=0.3 + late)
        assert period.subsamples[-1] == pytest.approx([0.4, 0.2, 0.0], abs=0.15)
        assert vehicle.timing.worst_gap < GAP + stalled() and not vehicle.current_period.lost and not period.collision
        assert vehicle.current_period.number >= 12

        hovering = vehicle.wait(vehicle.current_period.number + 10)  # without a plan it brakes within its slew
        assert not hovering.input.any() and speed(vehicle) < 0.3

        vehicle.land()
        until(lambda: not autopilot.flight.armed, "it disarms on the ground", 15.0)


@pytest.mark.parametrize("silence", [1.0, 4.5])
def test_a_climb_stops_without_fresh_positions_and_lands_if_they_stay_away(silence: float) -> None:
    autopilot, heights, silent_since = Autopilot(quadrotor(floor=0.0), "px4"), [0.0], [np.inf]
    real, ground = autopilot.take, float(autopilot.vehicle.state()[2])

    def take() -> bytes:
        data = real()
        heights.append(float(autopilot.vehicle.state()[2]) - ground)
        if heights[-1] > 0.7 and silent_since[0] == np.inf:
            silent_since[0] = time.monotonic()
        return b"" if 0.0 <= time.monotonic() - silent_since[0] < silence else data

    autopilot.take = take  # type: ignore[method-assign]
    flight = FlightSettings("", height=2.5, raise_limits=True)
    with served(autopilot) as url:
        if silence < LONGEST_PAUSE:
            MavlinkVehicle(QUADROTOR, replace(flight, url=url)).close()
            assert heights[-1] == pytest.approx(2.5, abs=0.5)
            return
        with pytest.raises(TelemetryMissing, match=r"no telemetry of .*stops its takeoff"):
            MavlinkVehicle(QUADROTOR, replace(flight, url=url))
        until(lambda: not autopilot.flight.armed, "it lands", 20.0)
    assert max(heights) < 1.7, "it does not climb on blindly"


def test_the_autopilot_brakes_when_the_link_dies() -> None:
    with flight_of("px4") as (vehicle, autopilot, _):
        for _ in range(8):
            vehicle.step(np.array([2.0, 0.0, 0.0]))
        vehicle.close()
        assert np.linalg.norm(autopilot.vehicle.state()[3:6]) > 0.5
        until(lambda: np.linalg.norm(autopilot.vehicle.state()[3:6]) < 0.1, "it brakes", 4.0)


def flown(flying: Flying, plan: np.ndarray, count: int, stalled: Callable[[], float]) -> np.ndarray:
    """Fly a plan, and return the inputs (count, 3) of as many periods. Fly again if the machine stalled."""
    vehicle, _, frames = flying
    for _ in range(5):
        until_it_hovers(vehicle)
        frames.clear()
        number = vehicle.current_period.number + 2
        if not vehicle.commit(plan, number):
            assert stalled() > STALL, "the commit was late, although the machine did not stall"
            continue
        periods = [vehicle.wait(number + k) for k in range(count)]
        if [current.number - number for current in periods] == list(range(count)):
            return np.array([current.input for current in periods])
        assert stalled() > STALL, "a period was missed, although the machine did not stall"
    raise AssertionError("the machine stalled in each of five flights")


def test_a_plan_is_flown_input_by_input_and_then_the_vehicle_hovers(
    flying: Flying, stalled: Callable[[], float]
) -> None:
    plan, (_, _, frames) = np.array([[0.5, 0.0, 0.0], [1.0, 0.2, 0.0], [0.6, 0.1, 0.0], [0.0, 0.0, 0.0]]), flying
    assert flown(flying, plan, 6, stalled) == pytest.approx(np.vstack([plan, np.zeros((2, 3))]))
    assert setpoints(frames) == [(0.0, 0.0, 0.0), *(tuple(row) for row in plan)]


@of_one_autopilot
def test_inputs_keep_to_the_robots_slew(
    flying: Flying, monkeypatch: pytest.MonkeyPatch, stalled: Callable[[], float]
) -> None:
    vehicle, _, _ = flying
    monkeypatch.setattr(vehicle, "_robot", replace(QUADROTOR, action_slew=(0.2, 0.2, 0.2)))
    inputs = flown(flying, np.tile([1.0, 0.0, 0.0], (3, 1)), 5, stalled)
    assert inputs[:, 0] == pytest.approx([0.2, 0.4, 0.6, 0.4, 0.2])


@of_one_autopilot
def test_a_late_plan_does_not_count_and_a_newer_one_does(flying: Flying, stalled: Callable[[], float]) -> None:
    vehicle, _, _ = flying
    first, second = np.full((3, 3), 0.3), np.full((3, 3), 0.6)
    for _ in range(5):  # a machine that stalls may miss the next period
        until_it_hovers(vehicle)
        number = vehicle.current_period.number + 2
        if vehicle.commit(first, number) and vehicle.wait(number).number == number:
            assert not vehicle.commit(second, number), "the period has begun"
            assert vehicle.current_period.input == pytest.approx(first[0])
            if vehicle.commit(second, number + 1) and (after := vehicle.wait(number + 1)).number == number + 1:
                assert after.input == pytest.approx(second[0])
                break
        assert stalled() > STALL, "a period was missed, although the machine did not stall"
    else:
        raise AssertionError("the machine stalled in each of five flights")
    with pytest.raises(BadInput):
        vehicle.commit(np.full((2, 3), np.nan), number + 4)


def recovers(vehicle: MavlinkVehicle) -> bool:
    """Return whether telemetry counts again within some periods, on a machine that may stall."""
    return any(not vehicle.wait(vehicle.current_period.number + 1).lost for _ in range(25))


@of_one_autopilot
def test_without_telemetry_the_period_is_lost_and_the_plan_goes_on(flying: Flying) -> None:
    vehicle, autopilot, _ = flying
    assert vehicle.commit(np.full((9, 3), 0.4), vehicle.current_period.number + 2)
    real, autopilot.take = autopilot.take, lambda: real() and b""  # type: ignore[method-assign, func-returns-value]
    current = vehicle.wait(vehicle.current_period.number + 4)
    assert "no telemetry" in current.lost
    assert current.input == pytest.approx([0.4, 0.4, 0.4])
    autopilot.take = real  # type: ignore[method-assign]
    assert recovers(vehicle)


def test_one_missing_quantity_is_lost_telemetry(flying: Flying) -> None:
    vehicle, _, _ = flying
    chosen = vehicle._client.chosen[ATTITUDE]
    vehicle._client.chosen[ATTITUDE] = "AHRS2"  # which does not arrive, while the position still does
    assert "no telemetry of attitude" in vehicle.wait(vehicle.current_period.number + 3).lost
    vehicle._client.chosen[ATTITUDE] = chosen
    assert recovers(vehicle)
    assert vehicle.timing.figures()["periods without telemetry"] >= 1


@of_one_autopilot
def test_a_period_outside_of_the_geofence_is_lost(flying: Flying) -> None:
    vehicle, _, _ = flying
    vehicle._client.breached_side = "boundary"
    assert "outside of its geofence (boundary)" in vehicle.wait(vehicle.current_period.number + 2).lost
    vehicle._client.breached_side = ""
    assert recovers(vehicle)


@of_one_autopilot
def test_a_period_whose_position_the_estimator_does_not_know_is_lost(flying: Flying) -> None:
    """Also if telemetry goes on: the autopilot extrapolates what it no longer measures."""
    vehicle, _, _ = flying
    healthy, lost = vehicle._client.estimator, ""
    for _ in range(25):  # a message of the healthy estimator comes twice a second
        vehicle._client.estimator = 0
        if "its estimator does not know" in (lost := vehicle.wait(vehicle.current_period.number + 1).lost):
            break
    assert "its estimator does not know" in lost and "velocity" in lost
    vehicle._client.estimator = healthy
    assert recovers(vehicle)


@of_one_autopilot
def test_after_a_standstill_of_the_process_the_plan_does_not_go_on_where_it_was(flying: Flying) -> None:
    """Without setpoints the vehicle has braked: the inputs of the missed periods would set it in motion again."""
    vehicle, _, _ = flying
    begins = vehicle.current_period.number + 2
    rows = np.outer(0.05 * np.arange(9, 0, -1), np.ones(3))
    assert vehicle.commit(rows, begins)
    assert vehicle.wait(begins).input == pytest.approx(rows[0])
    with vehicle._changed:
        time.sleep(3.5 * vehicle._robot.period)
    after = vehicle.wait(vehicle.current_period.number + 1)
    assert after.number >= begins + 3
    assert after.input == pytest.approx(rows[after.number - begins]), "the numbers count the missed periods"
    assert vehicle.timing.slips >= 1


def test_a_pilot_may_take_over_and_keeps_control(flying: Flying) -> None:
    vehicle, autopilot, _ = flying
    autopilot.flight.change(Mode.HOLD)
    for _ in range(25):  # until a heartbeat arrives, on a machine that may stall
        if "does not follow" in (lost := vehicle.wait(vehicle.current_period.number + 1).lost):
            break
    assert "does not follow" in lost and {"px4": "HOLD", "ardupilot": "LOITER"}[vehicle._client.kind or ""] in lost
    assert autopilot.flight.mode is Mode.HOLD, "the pilot keeps control"
    autopilot.flight.change(Mode.OFFBOARD)
    assert recovers(vehicle), "the pilot gives the vehicle back"


@pytest.mark.parametrize("disarms", [True, False])
def test_after_an_interruption_the_vehicle_brakes_and_nobody_flies_it_any_more(disarms: bool) -> None:
    """A disarmed vehicle may be in somebody's hands: the rest of the plan must not follow when it is armed again."""
    with flight_of("px4") as (vehicle, autopilot, frames):
        rows = np.outer((0.6, 0.6, 0.3, 0.0), (1.0, 0.0, 0.0))
        begins = vehicle.current_period.number + 2
        assert vehicle.commit(rows, begins)
        vehicle.wait(begins)
        if disarms:
            autopilot.flight.disarm(True)
        else:
            vehicle._client.interruption = "its position jumped by 3.00 m within 0.02 s"
        with pytest.raises(CommandLost, match="disarmed" if disarms else "jumped by 3"):
            for _ in range(25):
                period = vehicle.wait(vehicle.current_period.number + 1)
                assert not vehicle.commit(rows, period.number + 1) or not period.lost
        if not disarms:
            assert setpoints(frames)[-3:] == [(0.6, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)]
        sent = len(setpoints(frames))
        autopilot.flight.armed = True
        time.sleep(0.5)
        assert len(setpoints(frames)) == sent


@of_one_autopilot
def test_a_state_holds_the_horizontal_acceleration_of_some_time_ago(flying: Flying, monkeypatch) -> None:
    """From a rise of 10 m/s³ along x until now, and of 20 m/s³ along y, 0.2 s ago is 2 and 4 m/s² less."""
    vehicle, now = flying[0], time.monotonic()
    times = np.linspace(now - 1.0, now, 101)
    rising = deque((t, np.array([10.0, 20.0, 30.0]) * (t - now)) for t in times)
    monkeypatch.setattr(vehicle, "_remember_acceleration", lambda now: None)
    monkeypatch.setattr(vehicle, "_accelerations", rising)
    present = vehicle._state(now)
    monkeypatch.setattr(vehicle, "acceleration_age", 0.2)
    state = vehicle._state(now)
    np.testing.assert_allclose(state[6:8], [-2.0, -4.0], atol=1e-6)
    np.testing.assert_allclose(state[:6], present[:6], atol=0.05)
    assert abs(state[8]) < 2.0, "the vertical one is the present one"
