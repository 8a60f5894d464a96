"""How soon `--adapt` finds a new model set for a quadrotor that has changed, and how wide it is (docs/certificates.md).

    python -m benchmarks adaptation

A quadrotor flies from goal to goal by A*, behind a set of its unchanged self, with practised stops. It has changed from
the start. The certifier gets the flight's steps and requests afterwards, as fast as it can. The windows of the flight
after a new set are compared with three sets: the new one, the one in use with its widening at that time, and the one in
use as it states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np

from benchmarks.timing import Words
from brakeline.actors.actor_process import StopPractice
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data import collect
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.run_dataset import trajectories_of
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.deploy.run.adaptation import Adaptation, mean_half_width
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import ONE_STEP
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import goal_sequence
from brakeline.sim.delayed_vehicle import simulated_vehicle
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.sim_conditions import Conditions, Wind
from brakeline.sim.vehicle import Vehicle

RECORDINGS = (12, 6), (60, 30)  # trajectories, and how many of them have restless inputs
OUTSIDE, RECORDING_SEED = 0.012, 5
ACCEPTED = 0.03  # `--accept-bound`
MINUTES, PRACTICE, GOALS, ARENA_KEY = 14.0, 0.01, 12, 4242
EVERY = 25  # periods between two attempts of the certifier
CHANGES = {
    "a motor at 80 %": Conditions(weak_motor=0.8),
    "0.2 kg": Conditions(payload_kg=0.2),
    "wind of 5 m/s, gusts of 1 m/s": Conditions(wind=Wind(5.0, direction=0.7, gust=1.0)),
}


@dataclass(frozen=True)
class FlightPeriod:
    """One period of a flight."""

    exchange: pb.Exchange
    step: pb.Step


def run() -> Words:
    """Return a row for each change, behind the set of each recording."""
    words: Words = {}
    robot = robot_with_task("quadrotor")
    for trajectories, restless in RECORDINGS:
        driven = list(collect.record(robot, trajectories, RECORDING_SEED, Conditions(), restless=restless))
        data = collect.dataset(robot, driven, RECORDING_SEED, Conditions(), restless)
        in_use, report = certify(data, ModelConfig(mode=ONE_STEP, outside=OUTSIDE))
        behind = f"{data.periods * robot.period / 60.0:.1f} minutes"
        words[f"{behind}: the set in use"] = {"outcome": f"states {report.bound_plan:.2%}"}
        for name, change in CHANGES.items():
            words[f"{behind}: {name}"] = adapted(robot, in_use, flight(robot, in_use, change))
    return words


def flight(robot: RobotWithTask, model: ModelSet, change: Conditions) -> list[FlightPeriod]:
    """Fly one changed vehicle from goal to goal behind a model set."""
    stages = goal_sequence(flight_arena("default", 0), GOALS, np.random.default_rng(0), robot)
    make, vehicles, order = simulated_vehicle(robot, change, None), list[Vehicle](), cycle(stages)

    def vehicle(arena: Arena, rng: np.random.Generator) -> Vehicle:
        if not vehicles:  # it flies on from where it is
            vehicles.append(make(arena, rng))
        return vehicles[0]

    env = NavigationEnv(robot, "default", vehicle, conditions=change, seed_key=ARENA_KEY, draw=lambda *_: next(order))
    ask, runner = in_process(model, 1.0), EpisodeRunner(robot, env, ActorIdentity("actor-0", 0, 0), continuous=True)
    policy, practice = policy_named("astar", robot, 0), StopPractice(PRACTICE)
    for stage in stages:
        policy.prepare(stage)  # type: ignore[attr-defined]
    periods, episode = list[FlightPeriod](), 0
    while len(periods) < round(60.0 * MINUTES / robot.period):
        if not runner.running:
            runner.begin(episode)
            episode += 1
        proposal = runner.slow_down.proposal(np.asarray(policy(runner.observation, runner.info), float))
        proposal = practice.proposal(runner, proposal)
        decided = runner.decide(proposal, ask)
        assert decided is not None, "there is a filter"
        outcome = practice.outcome(runner, decided)
        exchange = outcome.exchange(float(runner.info["time"]))
        periods.append(FlightPeriod(exchange, runner.execute(proposal, outcome)))
    return periods


def adapted(robot: RobotWithTask, in_use: ModelSet, periods: Sequence[FlightPeriod]) -> dict[str, float | str]:
    """Give a flight to the certifier until it finds a new set, and compare the sets on the rest of the flight."""
    certifier = Adaptation(robot, lambda version: in_use, ACCEPTED)
    row: dict[str, float | str] = {"collisions": str(sum(p.step.collision for p in periods)), "outcome": "none in time"}
    for k, period in enumerate(periods, start=1):
        certifier.exchange(period.exchange, k * robot.period)
        certifier.step(period.step)
        if k % EVERY or (attempt := certifier.attempt()) is None:
            continue
        row["minutes"], row["outcome"] = f"{k * robot.period / 60.0:.1f}", attempt.text
        if attempt.model is None:
            continue
        before, rest = (flown(robot, part) for part in (periods[:k], periods[k:]))
        widening, new = certifier.widening, attempt.model
        row |= {"widening": f"{widening:.2f}", "half-width [m]": f"{mean_half_width(new, before):.3f}"}
        row |= {"as widened [m]": f"{widening * mean_half_width(in_use, before):.3f}"}
        row |= {"outside": f"{left(new, rest):.2%}", "outside as widened": f"{left(in_use, rest, widening):.2%}"}
        return row | {"outside as stated": f"{left(in_use, rest):.2%}"}
    return row


def flown(robot: RobotWithTask, periods: Sequence[FlightPeriod]) -> Dataset:
    """Return the data set of a part of a flight."""
    return Dataset(robot, tuple(trajectories_of([period.step for period in periods], robot)), {})


def left(model: ModelSet, data: Dataset, widening: float = 1.0) -> float:
    """Return the share of all windows of a plan's length that leave the sets of a model set of mode one-step."""
    robot, predictor = model.robot, model.one_step
    assert predictor is not None
    seen = samples_of(data.joined())
    widths = np.stack([step.half_widths(seen.z) for step in model.steps], axis=1)
    errors: Array = np.abs(seen.after - predictor.rollouts(robot, seen.z))
    used = errors / predictor.stretches(robot, seen.z)[..., None] / widths
    worst = np.maximum(used[..., : robot.position_dim].max(axis=(1, 2)), used[:, 0].max(axis=1))
    worst = np.maximum(worst, (seen.chords / model.chord_deviations.half_widths(seen.z)).max(axis=1))
    return float((worst > widening).mean())
