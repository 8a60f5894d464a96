"""THE table of a run's processes, and the files of its folder that they share."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from brakeline.deploy.run.run_config import RunConfig
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.robot import robot_named

CONFIG, ENDPOINT, LOG = "config.json", "endpoint", "run.mcap"
UNFINISHED = 75  # exit status: asked to end before its work was done


@dataclass(frozen=True)
class ProcessSpec:
    """A process's name, and how it is called on in a run."""

    name: str
    kind: str  # a key of KINDS
    robot: str = ""  # its name or path, as the configuration has it
    number: int = 0
    nice: int = 0  # the robot's safety comes before learning


def places(config: RunConfig) -> list[ProcessSpec]:
    """THE table of a run's processes, in the order in which they start."""
    table = [ProcessSpec("recorder", "recorder", nice=5 if config.flights else 0)] if config.record else []
    if config.filtered:
        table += [ProcessSpec(f"safety-{i}", "safety") for i in range(config.replicas)]
    if config.autopilot is not None:
        several = len(config.flights) > 1
        names = [f"autopilot-{i}" if several else "autopilot" for i in range(len(config.flights))]
        table += [ProcessSpec(name, "autopilot", number=i) for i, name in enumerate(names)]
    one = len(config.robots) == 1
    for robot in config.robots:
        kind = robot_named(robot).name
        if not config.policy:
            table.append(ProcessSpec("learner" if one else f"learner-{kind}", "learner", robot, nice=10))
        if config.from_logs:
            table.append(ProcessSpec("feeder" if one else f"feeder-{kind}", "feeder", robot, nice=2))
        for i in range(config.actors):
            name = f"actor-{i}" if one else f"actor-{kind}-{i}"
            nice = 0 if config.flights else 2
            table.append(ProcessSpec(name, "actor", robot, i * config.robots_per_actor, nice))
    return table


def say_where(folder: Path, bus: BusSettings) -> None:
    """Write down where the run's router is; `client_of` reads it."""
    keys = bus.keys and str(bus.keys.absolute())
    said = {"endpoint": bus.listen[0], "pid": os.getpid(), "keys": keys, "metrics": bus.metrics}
    write_atomically(folder / ENDPOINT, json.dumps(said).encode())


def client_of(folder: Path) -> BusSettings:
    """How a client gets on the bus of the run in a folder.

    Raises:
        OSError, ValueError, KeyError: there is no run.
    """
    said = json.loads((folder / ENDPOINT).read_text())
    keys = said.get("keys")
    return BusSettings(connect=(said["endpoint"],), keys=Path(keys) if keys else None)


def metrics_of(folder: Path, number: int) -> str:
    """Where the process of that row in the table serves its metrics: behind the launcher; empty: nowhere."""
    host, colon, port = json.loads((folder / ENDPOINT).read_text()).get("metrics", "").rpartition(":")
    return f"{host}{colon}{int(port) + 1 + number}" if port else ""


def launcher_of(folder: Path) -> int:
    """Its process id. Raises as `client_of`."""
    return int(json.loads((folder / ENDPOINT).read_text())["pid"])
