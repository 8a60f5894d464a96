"""One process of a launched run: `python -m deploy.run.child RUN_FOLDER PROCESS`.

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

from deploy.run.configurations import RunConfig, load
from deploy.run.places import CONFIG, LOG, UNFINISHED, Place, client_of, launcher_of, metrics_of, places
from messaging.bus import BusError, BusSettings
from messaging.tasks import robot_maybe_with_task, robot_with_task

PARENT_DIED = 1  # prctl: PR_SET_PDEATHSIG


def _recorder(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.run.contents import attachments, metadata
    from deploy.run.frames import as_json, both
    from logs import recorder
    from logs.foxglove import Pictures
    from logs.robots import Robots

    robots = Robots(robot_maybe_with_task(name) for name in config.robots)
    derive = both(Pictures(config.pictures, robots).of_sample, as_json) if config.pictures > 0.0 else as_json
    about, files = metadata(config), attachments(config, folder)
    recorder.main(bus, folder / LOG, about, place.name, files, derive, config.rotation)
    return False


def _safety(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.data.paths import method_path
    from deploy.run.keys import KEYS, newest_model
    from safety.service import SafetySettings, main
    from safety.sign import Trust

    robots = [robot_maybe_with_task(robot) for robot in config.robots]
    limits = {robot.name: robot.accept_bound for robot in robots}
    models = tuple(method_path(robot, config.method, config.recipe) for robot in robots)
    trust = None if bus.keys is None else Trust.load(bus.keys)
    newest = (newest_model(folder, robot.name, trust) or path for robot, path in zip(robots, models, strict=True))
    accepted = config.accept_bound
    main(SafetySettings(bus, tuple(newest), folder, place.name, limits, accepted, secrets=folder / KEYS))
    return False


def _learner(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from learner.checkpoint import CHECKPOINT, exists, latest

    out = folder / place.name
    if resume := exists(out / CHECKPOINT):
        latest(out / CHECKPOINT)  # what is not there is said before torch is loaded, which takes seconds
    from learner.service import LearnerSettings, main

    return main(LearnerSettings(bus, place.robot, out, resume, place.name, config.learning()))


def _actor(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from actors.loop import ActorSettings, run
    from deploy.policies import policy_named
    from deploy.vehicles import environment, fleet_world

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
        from actors import flight
        from deploy.quadrotors import flight_arena

        arena = flight_arena(config.arena, config.seed, robot_with_task(place.robot))
        return flight.run(settings, config.flights[place.number], arena, propose, config.conditions)
    worlds = partial(fleet_world, conditions=config.conditions)
    return run(settings, partial(environment, conditions=config.conditions), propose, worlds)


def _autopilot(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.run.autopilot import AutopilotSettings, fly

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


def _feeder(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.run.feed import FeederSettings, main

    return main(FeederSettings(bus, config.from_logs, place.robot, place.name, config.actors == 0))


# Each runs until its work is done (True) or it is asked to end; a recorder's and a safety service's never is.
KINDS: dict[str, Callable[[Place, Path, RunConfig, BusSettings], bool]] = {
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
