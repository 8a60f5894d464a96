"""Run one process of a launched run: `python -m brakeline.deploy.run.run_process [held] RUN_FOLDER PROCESS`.

The process takes its settings from the run's saved configuration, so that all processes of a run agree. You can also
start each process alone, with `brakeline safety`, `learner`, `actor` or `recorder`.

With the word `held`, the process imports all that it needs, and begins when its standard input ends. So
processes import while the recorder starts, and still publish nothing that it would miss.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from brakeline.deploy.interpreter import end_with_parent
from brakeline.deploy.run.processes import (
    CONFIG,
    HELD,
    HOPELESS,
    LOG,
    UNFINISHED,
    ProcessSpec,
    client_settings,
    launcher_pid,
    metrics_address,
    process_specs,
)
from brakeline.deploy.run.run_config import BATCH, RunConfig, load
from brakeline.errors import (
    BadKeys,
    BadModel,
    BusError,
    CommandLost,
    Diverged,
    Mismatch,
    MissingExtra,
    NoBatch,
    NoFleet,
    UnknownName,
    UnknownRobot,
    UnknownTask,
)
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.task import robot_maybe_with_task, robot_with_task

PRACTICE = 0.01  # of a run that certifies anew: a model set needs stops
# What a process meets again after a restart: mistakes in the run's configuration, robots, tasks and model sets.
LASTING = (
    *(CommandLost, Diverged, UnknownRobot, UnknownTask, UnknownName, Mismatch, NoFleet, NoBatch, BadModel, BadKeys),
    MissingExtra,
)

Work = Callable[[], bool | None]  # returns True when it is done. Otherwise a signal ended it


def _recorder(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.deploy.run.log_contents import attachments, derive_entries, metadata
    from brakeline.logs import recorder
    from brakeline.logs.recorded_robots import RecordedRobots

    robots = RecordedRobots(robot_maybe_with_task(name) for name in config.robots)
    derive = derive_entries(config.pictures, robots)
    files = attachments(config, folder)
    settings = recorder.LogSettings(folder / LOG, metadata(config, folder), files, derive, config.rotation)
    return partial(recorder.main, bus, settings, spec.name)


def _safety(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.deploy.run.run_keys import KEYS
    from brakeline.deploy.run.run_models import model_in_run
    from brakeline.safety.service.server import SafetySettings, main
    from brakeline.safety.service.signature import TrustedSigners

    robots = [robot_maybe_with_task(robot) for robot in config.robots]
    limits = {robot.name: robot.accept_bound for robot in robots}
    trust = None if bus.keys is None else TrustedSigners.load(bus.keys)
    models = tuple(model_in_run(config, folder, robot, trust) for robot in robots)
    accepted = config.accept_bound
    settings = SafetySettings(bus, models, folder, spec.name, limits, accepted, secrets=folder / KEYS)
    return partial(main, settings)


def _certifier(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.deploy.run.adaptation_process import CertifierSettings, main

    return partial(main, CertifierSettings(bus, config.robots, folder, config.accept_bound, spec.name))


def _learner(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.learner.checkpoint import CHECKPOINT, exists, latest

    out = folder / spec.name
    if resume := exists(out / CHECKPOINT):
        latest(out / CHECKPOINT)  # fails for a damaged checkpoint before the import of torch, which takes seconds
    if config.backend == BATCH:
        from brakeline.deploy.run.batch_process import main as train_in_batches

        return partial(train_in_batches, bus, config, folder, spec, resume)
    from brakeline.learner.learner_process import LearnerSettings, main

    return partial(main, LearnerSettings(bus, spec.robot, out, resume, spec.name, config.learning()))


def _actor(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.actors.actor_process import ActorSettings, run
    from brakeline.deploy.commands.common_options import settings_from
    from brakeline.deploy.policy_loading import policy_named
    from brakeline.deploy.vehicle_factory import environment, fleet_world

    settings = settings_from(
        ActorSettings,
        config,
        bus=bus,
        robot=spec.robot,
        name=spec.name,
        number=spec.number,
        robots=config.robots_per_actor,
        fleet=config.fleet > 0,
        deadline=60.0 if config.deterministic else config.deadline,
        lockstep=config.deterministic,
        practice=config.practice or (PRACTICE if config.adapt else 0.0),
    )
    propose = partial(policy_named, config.policy, robot_with_task(spec.robot)) if config.policy else None
    if config.flights:
        from brakeline.actors import flight_process as flight
        from brakeline.deploy.quadrotor_vehicles import flight_arena

        arena = flight_arena(config.arena, config.seed, robot_with_task(spec.robot))
        return partial(flight.run, settings, config.flights[spec.number], arena, propose, config.conditions)
    worlds = partial(fleet_world, conditions=config.conditions)
    return partial(run, settings, partial(environment, conditions=config.conditions), propose, worlds)


def _autopilot(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.deploy.quadrotor_vehicles import changes_of
    from brakeline.deploy.run.autopilot_run import AutopilotSettings, fly

    assert config.autopilot is not None
    flight = config.flights[spec.number]
    settings = AutopilotSettings(
        url=flight.url.replace("udpin:0.0.0.0", "udpout:127.0.0.1").replace("udpin", "udpout"),
        rules=config.autopilot.rules,
        arena=config.arena,
        seed=config.seed,
        airborne=True,
        at_once=True,
        setpoint_timeout=config.autopilot.setpoint_timeout,
        noise=config.conditions.flight_noise,
        wind=config.conditions.wind,
        changes=changes_of(config.conditions),
        truth=f"127.0.0.1:{flight.truth}",
    )
    return lambda: print(fly(settings), file=sys.stderr)


def _feeder(spec: ProcessSpec, folder: Path, config: RunConfig, bus: BusSettings) -> Work:
    from brakeline.deploy.run.log_feed import FeederSettings, main

    return partial(main, FeederSettings(bus, config.from_logs, spec.robot, spec.name, config.actors == 0))


# Each function imports what a process needs, and returns its work.
PROCESSES: dict[str, Callable[[ProcessSpec, Path, RunConfig, BusSettings], Work]] = {
    "recorder": _recorder,
    "safety": _safety,
    "certifier": _certifier,
    "learner": _learner,
    "actor": _actor,
    "autopilot": _autopilot,
    "feeder": _feeder,
}


def main() -> int:
    """Run the process that the command line names, until its work is done or its launcher ends. Returns the status."""
    folder, name, held = Path(sys.argv[-2]), sys.argv[-1], HELD in sys.argv[1:-2]
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if not end_with_parent(launcher_pid(folder)):
        return UNFINISHED
    config = load(folder / CONFIG)
    number, spec = next(row for row in enumerate(process_specs(config)) if row[1].name == name)
    if spec.nice:
        os.nice(spec.nice)
    try:
        bus = replace(client_settings(folder), metrics=metrics_address(folder, number))
        work = PROCESSES[spec.kind](spec, folder, config, bus)
        if held:
            sys.stdin.read()
        done = work()
    except (BusError, *LASTING) as error:
        # In one line: the launcher shows the last one.
        print(f"{name}: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return HOPELESS if isinstance(error, LASTING) else 1
    return 0 if done else UNFINISHED


if __name__ == "__main__":
    sys.exit(main())
