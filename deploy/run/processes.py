"""Define THE table of a run's processes, and the files in the run's folder that they share."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brakeline.deploy.run.run_config import BATCH, RunConfig
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.robot import robot_named
from brakeline.messaging.structured_text import parse_json

CONFIG, ENDPOINT, LOG = "config.json", "endpoint", "run.mcap"
CERTIFIER = "certify.adapt"  # name of the process that certifies anew; its certificate is that of `certify`
HELD = "held"  # word on the command line of a process that begins when its standard input ends
UNFINISHED = 75  # exit status of a process that was asked to end before its work was done
HOPELESS = 76  # exit status of a process that must not, or cannot, go on after a restart: the run ends


@dataclass(frozen=True)
class ProcessSpec:
    """A process of a run."""

    name: str
    kind: str  # key of `run_process.PROCESSES`
    robot: str = ""  # name or path of the robot, as in the configuration
    number: int = 0  # of an actor's first robot, or of an autopilot
    nice: int = 0  # the safety of robots comes before learning
    needed: bool = True  # the run ends if the process keeps failing


def process_specs(config: RunConfig) -> list[ProcessSpec]:
    """Return THE table of a run's processes, in the order in which they start."""
    table = [ProcessSpec("recorder", "recorder", nice=5 if config.flights else 0)] if config.record else []
    if config.filtered and config.backend != BATCH:  # a batch is filtered in the process of its learner
        table += [ProcessSpec(f"safety-{i}", "safety") for i in range(config.replicas)]
        if config.adapt:
            table.append(ProcessSpec(CERTIFIER, "certifier", nice=10, needed=False))
    if config.autopilot is not None:
        several = len(config.flights) > 1
        names = [f"autopilot-{i}" if several else "autopilot" for i in range(len(config.flights))]
        table += [ProcessSpec(name, "autopilot", number=i) for i, name in enumerate(names)]
    one = len(config.robots) == 1
    for robot in config.robots:
        kind = robot_named(robot).name.replace(".", "_")  # a dot ends the name on the process's certificate
        if not config.policy:
            nice = 2 if config.backend == BATCH else 10  # a batch drives and filters its robots in this process
            table.append(ProcessSpec("learner" if one else f"learner-{kind}", "learner", robot, nice=nice))
        if config.from_logs:
            table.append(ProcessSpec("feeder" if one else f"feeder-{kind}", "feeder", robot, nice=2))
        for i in range(0 if config.backend == BATCH else config.actors):
            name = f"actor-{i}" if one else f"actor-{kind}-{i}"
            nice = 0 if config.flights else 2
            table.append(ProcessSpec(name, "actor", robot, i * config.robots_per_actor, nice))
    return table


def write_endpoint(folder: Path, bus: BusSettings) -> None:
    """Write the endpoint of the run's router to the run's folder, where `client_settings` reads it."""
    keys = bus.keys and str(bus.keys.absolute())
    values = {"endpoint": bus.listen[0], "pid": os.getpid(), "keys": keys, "metrics": bus.metrics}
    write_atomically(folder / ENDPOINT, json.dumps(values).encode())


def client_settings(folder: Path) -> BusSettings:
    """Return the settings with which a client joins the bus of the run in a folder.

    Raises:
        OSError, ValueError, KeyError: the folder has no run.
    """
    values = _read_endpoint(folder)
    keys = values.get("keys")
    return BusSettings(connect=(values["endpoint"],), keys=Path(keys) if keys else None)


def metrics_address(folder: Path, number: int) -> str:
    """Return PORT or HOST:PORT at which the process in row `number` of the table serves metrics; empty for none.

    The launcher has the first port, its processes have the next ones.
    """
    host, colon, port = _read_endpoint(folder).get("metrics", "").rpartition(":")
    return f"{host}{colon}{int(port) + 1 + number}" if port else ""


def launcher_pid(folder: Path) -> int:
    """Return the process id of the run's launcher. Raises as `client_settings`."""
    return int(_read_endpoint(folder)["pid"])


def _read_endpoint(folder: Path) -> dict[str, Any]:
    values: dict[str, Any] | None = parse_json((folder / ENDPOINT).read_text())
    if not isinstance(values, dict) or not isinstance(values["endpoint"], str):
        raise ValueError(f"{folder / ENDPOINT} does not name the endpoint of a run")
    return values
