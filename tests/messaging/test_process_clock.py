import time

from brakeline.messaging.process_clock import Clock, SimulatedClock, WallClock


def test_simulated_time_passes_by_sleeping_and_at_once() -> None:
    clock: Clock = SimulatedClock()
    start = time.monotonic()
    clock.sleep_until(100.0)
    assert clock.now() == 100.0
    clock.sleep_until(50.0)
    assert clock.now() == 100.0
    assert time.monotonic() - start < 1.0


def test_wall_time_passes_by_itself() -> None:
    clock: Clock = WallClock()
    assert clock.now() < 0.5
    clock.sleep_until(0.05)
    assert clock.now() >= 0.05
    clock.sleep_until(0.0)
