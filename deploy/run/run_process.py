"""One process of a launched run: `python -m brakeline.deploy.run.run_process RUN_FOLDER PROCESS`.

Everything it needs is in the run's resolved configuration, so that all processes of a run agree. Each process can also
be started alone, with `brakeline safety | learner | actor | recorder`.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from brakeline.deploy.run.processes import (
    CONFIG,
    LOG,
    UNFINISHED,
    ProcessSpec,
    client_of,
    launcher_of,
    metrics_of,
    places,
)
from brakeline.deploy.run.run_config import RunConfig, load
from brakeline.messaging.bus import BusError, BusSettings
from brakeline.messaging.task import robot_maybe_with_task, robot_with_task

PARENT_DIED = 1  # prctl: PR_SET_PDEATHSIG


def _recorder(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.deploy.run.log_contents import attachments, metadata
    from brakeline.deploy.run.mavlink_json import as_json, both
    from brakeline.logs import recorder
    from brakeline.logs.foxglove import FoxgloveConverter
    from brakeline.logs.recorded_robots import RecordedRobots

    robots = RecordedRobots(robot_maybe_with_task(name) for name in config.robots)
    derive = both(FoxgloveConverter(config.pictures, robots).from_sample, as_json) if config.pictures > 0.0 else as_json
    about, files = metadata(config), attachments(config, folder)
    recorder.main(bus, folder / LOG, about, place.name, files, derive, config.rotation)
    return False


def _safety(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.deploy.data.data_paths import method_path
    from brakeline.deploy.run.run_keys import KEYS, newest_model
    from brakeline.safety.service.server import SafetySettings, main
    from brakeline.safety.service.signature import TrustedSigners

    robots = [robot_maybe_with_task(robot) for robot in config.robots]
    limits = {robot.name: robot.accept_bound for robot in robots}
    models = tuple(method_path(robot, config.method, config.model_config) for robot in robots)
    trust = None if bus.keys is None else TrustedSigners.load(bus.keys)
    newest = (newest_model(folder, robot.name, trust) or path for robot, path in zip(robots, models, strict=True))
    accepted = config.accept_bound
    main(SafetySettings(bus, tuple(newest), folder, place.name, limits, accepted, secrets=folder / KEYS))
    return False


def _learner(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.learner.checkpoint import CHECKPOINT, exists, latest

    out = folder / place.name
    if resume := exists(out / CHECKPOINT):
        latest(out / CHECKPOINT)  # what is not there is said before torch is loaded, which takes seconds
    from brakeline.learner.learner_process import LearnerSettings, main

    return main(LearnerSettings(bus, place.robot, out, resume, place.name, config.learning()))


def _actor(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.actors.actor_process import ActorSettings, run
    from brakeline.deploy.policy_loading import policy_named
    from brakeline.deploy.vehicle_factory import environment, fleet_world

    settings = ActorSettings(
        bus=bus,
        robot=place.robot,
        name=place.name,
        number=place.number,
        robots=config.robots_per_actor,
        fleet=config.fleet > 0,
        seed=config.seed,
        arena=config.arena,
        method=config.method,
        penalty=config.penalty,
        deadline=60.0 if config.deterministic else config.deadline,
        lockstep=config.deterministic,
        practice=config.practice,
        change=config.change,
        mavlink=config.mavlink,
        steps=config.steps,
    )
    propose = partial(policy_named, config.policy, robot_with_task(place.robot)) if config.policy else None
    if config.flights:
        from brakeline.actors import flight_process as flight
        from brakeline.deploy.quadrotor_vehicles import flight_arena

        arena = flight_arena(config.arena, config.seed, robot_with_task(place.robot))
        return flight.run(settings, config.flights[place.number], arena, propose, config.conditions)
    worlds = partial(fleet_world, conditions=config.conditions)
    return run(settings, partial(environment, conditions=config.conditions), propose, worlds)


def _autopilot(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.deploy.run.autopilot_run import AutopilotSettings, fly

    assert config.autopilot is not None
    flight = config.flights[place.number]
    tally = fly(
        AutopilotSettings(
            url=flight.url.replace("udpin:0.0.0.0", "udpout:127.0.0.1").replace("udpin", "udpout"),
            rules=config.autopilot.rules,
            arena=config.arena,
            seed=config.seed,
            airborne=True,
            at_once=True,
            setpoint_timeout=config.autopilot.setpoint_timeout,
            wind=config.conditions.wind,
            truth=f"127.0.0.1:{flight.truth}",
        )
    )
    print(tally, file=sys.stderr)  # into its log
    return False


def _feeder(place: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from brakeline.deploy.run.log_feed import FeederSettings, main

    return main(FeederSettings(bus, config.from_logs, place.robot, place.name, config.actors == 0))


# Each runs until its work is done (True) or it is asked to end; a recorder's and a safety service's never is.
KINDS: dict[str, Callable[[ProcessSpec, Path, RunConfig, BusSettings], bool]] = {
    "recorder": _recorder,
    "safety": _safety,
    "learner": _learner,
    "actor": _actor,
    "autopilot": _autopilot,
    "feeder": _feeder,
}


def main() -> int:
    """Run the process named on the command line; it ends with its launcher. 0: its work is done."""
    folder, name = Path(sys.argv[1]), sys.argv[2]
    ctypes.CDLL(None).prctl(PARENT_DIED, signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if os.getppid() != launcher_of(folder):  # it died before we could ask to be told
        return UNFINISHED
    config = load(folder / CONFIG)
    number, place = next(row for row in enumerate(places(config)) if row[1].name == name)
    if place.nice:
        os.nice(place.nice)
    try:
        bus = replace(client_of(folder), metrics=metrics_of(folder, number))
        done = KINDS[place.kind](place, folder, config, bus)
    except BusError as error:
        print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0 if done else UNFINISHED


if __name__ == "__main__":
    sys.exit(main())
