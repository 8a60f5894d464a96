"""One process of a launched run: `python -m deploy.child RUN_FOLDER PROCESS`.

Everything it needs is in the run's resolved configuration, so that all processes of a run agree. Each process can also
be started alone, with `brakeline safety | learner | actor | recorder`.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from deploy import experiments
from deploy.experiments import RunConfig
from messaging.bus import BusError, BusSettings
from messaging.robots import robot_named

CONFIG, ENDPOINT, LOG = "config.json", "endpoint", "run.mcap"
PARENT_DIED = 1  # prctl: PR_SET_PDEATHSIG
UNFINISHED = 75  # exit status: asked to end before its work was done


@dataclass(frozen=True)
class Place:
    """A process's name, and how it is called on in a run."""

    name: str
    kind: str  # a key of KINDS
    robot: str = ""
    number: int = 0
    nice: int = 0  # the robot's safety comes before learning


def places(config: RunConfig) -> list[Place]:
    """THE table of a run's processes, in the order in which they start."""
    table = [Place("recorder", "recorder", nice=5 if config.flight is not None else 0)] if config.record else []
    if config.filtered:
        table += [Place(f"safety-{i}", "safety") for i in range(config.replicas)]
    if config.autopilot is not None:
        table.append(Place("autopilot", "autopilot"))
    one = len(config.robots) == 1
    for robot in config.robots:
        if not config.policy:
            table.append(Place("learner" if one else f"learner-{robot}", "learner", robot, nice=10))
        if config.from_logs:
            table.append(Place("feeder" if one else f"feeder-{robot}", "feeder", robot, nice=2))
        for i in range(config.actors):
            name = f"actor-{i}" if one else f"actor-{robot}-{i}"
            nice = 0 if config.flight is not None else 2
            table.append(Place(name, "actor", robot, i * config.robots_per_actor, nice))
    return table


def metadata(config: RunConfig) -> dict[str, dict[str, str]]:
    """What the log says of its run, besides the messages."""
    from deploy.store import method_path
    from safety.methods import DDPC, load

    filtered = config.filtered
    run = {
        "method": config.method,
        "policy": config.policy or "learning",
        "arena": config.arena,
        "seed": str(config.seed),
        "robots": ",".join(config.robots),
    }
    if config.method == DDPC:
        run |= {"certificate": config.recipe.certificate, "mode": config.recipe.mode}
    packages = ("brakeline", "mujoco", "proxsuite", "numpy", "torch", "eclipse-zenoh", "mcap")
    about = {
        "run": run,
        "configuration": {"json": experiments.encode(config)},
        "versions": {name: version(name) for name in packages},
        "conditions": config.conditions.describe(),
    }
    for robot in config.robots if filtered else ():
        model = load(method_path(robot_named(robot), config.method, config.recipe))
        about[f"model {robot}"] = {"version": model.version, **model.about}
    return about


def attachments(config: RunConfig, folder: Path) -> dict[str, bytes]:
    """The models in use when the log begins, or before (of a run that goes on), so that it alone can be replayed."""
    from deploy.store import method_path
    from safety.methods import load

    if not config.filtered:
        return {}
    models = (load(method_path(robot_named(robot), config.method, config.recipe)) for robot in config.robots)
    files = {attachment(model.robot.name, model.version): model.encode() for model in models}
    for robot in config.robots:
        archived = (folder / robot / "models").glob("*.safetensors")
        files |= {attachment(robot, path.stem): path.read_bytes() for path in archived}
    return files


def attachment(robot: str, version: str) -> str:
    """The name in a log of a model set."""
    return f"model/{robot}/{version}.safetensors"


def _recorder(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.frames import as_json, both
    from logs import recorder
    from logs.foxglove import Pictures

    derive = both(Pictures(config.pictures).of_sample, as_json) if config.pictures > 0.0 else as_json
    about, files = metadata(config), attachments(config, folder)
    recorder.main(bus, folder / LOG, about, place.name, files, derive, config.rotation)
    return False


def _safety(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.store import method_path
    from safety.service import SafetySettings, main

    models = tuple(method_path(robot_named(robot), config.method, config.recipe) for robot in config.robots)
    newest = (newest_model(folder, robot) or path for robot, path in zip(config.robots, models, strict=True))
    main(SafetySettings(bus, tuple(newest), folder, place.name))
    return False


def newest_model(folder: Path, robot: str) -> Path | None:
    """The version that a service of this run used last: a restarted one goes on with it."""
    versions = list((folder / robot / "models").glob("*.safetensors"))
    return max(versions, key=lambda path: path.stat().st_mtime_ns, default=None)


def _learner(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from learner.checkpoint import exists
    from learner.service import CHECKPOINT, LearnerSettings, main

    out = folder / place.name
    return main(LearnerSettings(bus, place.robot, out, exists(out / CHECKPOINT), place.name, config.learning()))


def _actor(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from actors import flight
    from actors.loop import ActorSettings, run
    from deploy.evaluate import policy_named
    from deploy.vehicles import environment, flight_arena

    settings = ActorSettings(
        bus=bus,
        robot=place.robot,
        name=place.name,
        number=place.number,
        robots=config.robots_per_actor,
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
    propose = partial(policy_named, config.policy, robot_named(place.robot)) if config.policy else None
    if config.flight is not None:
        return flight.run(settings, config.flight, flight_arena(config.arena, config.seed), propose)
    return run(settings, partial(environment, conditions=config.conditions), propose)


def _autopilot(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.commands.autopilot import Autopilot

    assert config.autopilot is not None and config.flight is not None
    other_end = config.flight.url.replace("udpin:0.0.0.0", "udpout:127.0.0.1").replace("udpin", "udpout")
    Autopilot(
        url=other_end,
        rules="ardupilot" if config.autopilot.rules == "ardupilot" else "px4",
        arena=config.arena,
        seed=config.seed,
        airborne=True,
        setpoint_timeout=config.autopilot.setpoint_timeout,
        wind=config.conditions.wind.speed,
        gust=config.conditions.wind.gust,
        truth=f"127.0.0.1:{config.flight.truth}",
    ).run()
    return False


def _feeder(place: Place, folder: Path, config: RunConfig, bus: BusSettings) -> bool:
    from deploy.feed import FeederSettings, main

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
    launcher = json.loads((folder / ENDPOINT).read_text())
    if os.getppid() != launcher["pid"]:  # it died before we could ask to be told
        return UNFINISHED
    config = experiments.load(folder / CONFIG)
    place = next(place for place in places(config) if place.name == name)
    if place.nice:
        os.nice(place.nice)
    try:
        done = KINDS[place.kind](place, folder, config, BusSettings(connect=(launcher["endpoint"],)))
    except BusError as error:
        print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0 if done else UNFINISHED


if __name__ == "__main__":
    sys.exit(main())
