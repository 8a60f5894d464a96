"""The ground robot's sensors and their fusion."""

import math

import numpy as np
import pytest

from brakeline.sim.ground_estimator import CUT, Estimator, NoiseLevels, cut_normal, steady_gain, wrap
from tests.robots import GROUND

SAMPLE, RADIUS, SAMPLES = 0.02, 0.033, 10


def estimator(noise: NoiseLevels, seed: int = 0) -> Estimator:
    return Estimator(noise, np.random.default_rng(seed), np.zeros(3), np.zeros(2), RADIUS, SAMPLE)


def test_noise_is_cut_off_and_otherwise_normal() -> None:
    draws = cut_normal(np.random.default_rng(0), 0.5, (50_000,))
    assert np.abs(draws).max() <= CUT * 0.5
    assert draws.mean() == pytest.approx(0.0, abs=0.005)
    assert draws.std() == pytest.approx(0.5 * 0.8796, rel=0.01)  # of a normal distribution cut at 2 sigma
    assert (cut_normal(np.random.default_rng(0), 0.0, (5,)) == 0.0).all()


@pytest.mark.parametrize(("drift", "fix"), [(0.001, 0.005), (0.01, 0.005)])
def test_the_steady_gain_is_the_limit_of_the_kalman_gain(drift: float, fix: float) -> None:
    variance = 1.0
    for _ in range(1000):
        prior = variance + drift**2
        gain = prior / (prior + fix**2)
        variance = (1.0 - gain) * prior
    assert steady_gain(drift, fix) == pytest.approx(gain, rel=1e-9)


def test_dead_reckoning_of_an_arc_without_noise() -> None:
    sensors = estimator(NoiseLevels(scale=0.0))
    speed, turn = 0.2, 0.5
    times = SAMPLE * np.arange(1, SAMPLES + 1)
    wheels = np.outer(times, [speed - 0.08 * turn, speed + 0.08 * turn]) / RADIUS
    angle = turn * times
    path = np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=1) * speed / turn
    reading = sensors.update(wheels, np.full(SAMPLES, turn), np.array([*path[-1], angle[-1]]))
    tick = 2.0 * math.pi / 4096 * RADIUS
    assert reading.path == pytest.approx(path, abs=2.0 * tick)
    assert reading.turned == pytest.approx(angle[-1])
    assert reading.measured == pytest.approx([*path[-1], angle[-1], speed, turn], abs=2.0 * tick / SAMPLE)


def test_speed_and_turn_rate_come_from_the_last_samples() -> None:
    sensors = estimator(NoiseLevels(scale=0.0))
    steps = np.where(np.arange(SAMPLES) < 5, 0.0, 0.2 * SAMPLE / RADIUS)
    wheels = np.cumsum(np.stack((steps, steps), axis=1), axis=0)
    rates = np.where(np.arange(SAMPLES) < 5, 0.5, 0.0)
    measured = sensors.update(wheels, rates, np.zeros(3)).measured
    assert measured[3] == pytest.approx(0.2, abs=0.003)
    assert measured[4] == 0.0


def test_fusion_is_better_than_a_fix_and_within_its_bound() -> None:
    noise, errors = NoiseLevels(), []
    for seed in range(8):
        sensors = estimator(noise, seed)
        for _ in range(200):
            reading = sensors.update(np.zeros((SAMPLES, 2)), np.zeros(SAMPLES), np.zeros(3))
            errors.append(reading.measured)
    error = np.array(errors)
    assert (np.abs(error) <= GROUND.measurement_bound).all()
    assert (error[:, :3].std(axis=0) < 0.5 * np.array([0.005, 0.005, 0.01])).all()
    assert (error[:, :3].std(axis=0) > 0.1 * np.array([0.005, 0.005, 0.01])).all()


def test_the_heading_wraps() -> None:
    assert wrap(3.0 * math.pi) == pytest.approx(-math.pi)
    sensors = Estimator(
        NoiseLevels(scale=0.0), np.random.default_rng(0), np.array([0, 0, 3.1]), np.zeros(2), RADIUS, SAMPLE
    )
    reading = sensors.update(np.zeros((SAMPLES, 2)), np.full(SAMPLES, 0.5), np.array([0.0, 0.0, wrap(3.2)]))
    assert reading.measured[2] == pytest.approx(wrap(3.2))
