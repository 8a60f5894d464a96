"""Define the options that several commands share.

This module imports nothing heavy, so that `--help` and a mistyped option are answered at once.
"""

from __future__ import annotations

import math
import os
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

import tyro

from brakeline.actors.actor_settings import FlightSettings
from brakeline.messaging.robot_files import task_file, task_values
from brakeline.safety.model.model_config import ModelConfig
from brakeline.sim.sim_conditions import (
    Conditions,
    NoiseLevels,
    Perception,
    ProcessNoise,
    QuadrotorNoise,
    SensorFaults,
    Wind,
)

if TYPE_CHECKING:
    from brakeline.deploy.data.log_options import LogOptions
    from brakeline.deploy.run.run_config import RunConfig
    from brakeline.learner.learner_config import LearnerConfig
    from brakeline.messaging.bus import BusSettings
    from brakeline.sim.arena import Arena

LATEST = Path("runs/latest")

T = TypeVar("T")
Unprefixed = Annotated[T, tyro.conf.OmitArgPrefixes]
Certificate = Literal["residual", "set-membership", "matrix-zonotope"]
Mode = Literal["auto", "one-step", "direct", "recursion"]
Method = Literal["ddpc", "secas", "sailr", "cbf", "psf", "none"]

Robot = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(help="Use this robot. Give its name, or the path of a robot description (.toml).", metavar="[ROBOT]"),
]
Logs = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(help="Read these log files (.mcap) or run folders.", metavar="[LOG ...]"),
]
Seed = Annotated[int, tyro.conf.arg(help="Draw everything random from this seed. The same seed gives the same result.")]
ArenaName = Annotated[
    str,
    tyro.conf.arg(
        help="Drive in arenas of this name. A ground robot has default, open, dense, few-walkers, walkers, "
        "many-walkers and crossing. A quadrotor has default, dense, tall and traffic. Another robot has those of its "
        "task file."
    ),
]
RunFolder = Annotated[
    Path | None, tyro.conf.arg(help="Store the run in this folder. Defaults to runs/DATE-TIME.", metavar="FOLDER")
]
AcceptBound = Annotated[
    float | None,
    tyro.conf.arg(
        help="Use a model set only if its stated bound is at most this share of plans outside their tubes (0.26 means "
        "26 %). Defaults to `accept_bound` of the robot description, or 0.01 if the description has none."
    ),
]
Pictures = Annotated[
    float,
    tyro.conf.arg(
        help="Draw this many pictures a second of each robot into the log for Foxglove, and up to as many of each kind "
        "of intervention. 0 draws none at all."
    ),
]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Verbose = Annotated[Flag, tyro.conf.arg(aliases=("-v",), help="Print all figures and conditions.")]
Quiet = Annotated[Flag, tyro.conf.arg(aliases=("-q",), help="Show no progress.")]
Watch = Annotated[Flag, tyro.conf.arg(help="Open a live page in a browser.")]
Json = Annotated[Flag, tyro.conf.arg(help="Print one JSON object on stdout.")]


@dataclass(frozen=True)
class LogReadOptions:
    """Set how to read logs of other programs."""

    unit: tuple[str, ...] = ()
    """Read these names in units that are not SI, each as NAME=UNIT: heading=deg, speed=km/h, time=ms."""
    topics: tuple[str, ...] = ()
    """Take a quantity from these topics or message types, if several hold it."""
    read_seconds: float = 0.0
    """Stop reading a foreign log after this computing time [s]. 0 means 3 s, and 1 s more for each 200 kB."""
    read_gib: float = 4.0
    """Stop reading a foreign log that needs more than this memory [GiB]."""

    def options(self, places: tuple[str, ...]) -> LogOptions:
        """Return the options of a log, with the words of `--map`. Raises NoSource if a word is malformed."""
        from brakeline.deploy.data.log_options import LogOptions
        from brakeline.deploy.data.sources.isolated_reader import ReadLimits

        return LogOptions.parse(places, self.unit, self.topics, ReadLimits(self.read_seconds, self.read_gib))


@dataclass(frozen=True)
class FilterOptions:
    """Choose the filter that checks what the policy proposes."""

    method: Method = "ddpc"
    """Filter with this method: ddpc (this project's own), a rival (see docs/rivals.md), or none for no filter."""
    certificate: Certificate = "residual"
    """Use a model set with this error bound (see docs/certificates.md)."""
    mode: Mode = "auto"
    """Predict in this mode: one-step rolls out one learned period, direct uses one linear predictor for each period of
    the plan, recursion repeats the paper's linear model, and auto takes the model set that was last put to
    use (one-step or direct)."""

    def model_config(self) -> ModelConfig:
        """Return the configuration of the model set that the options select."""
        return ModelConfig(self.certificate, self.mode)


@dataclass(frozen=True)
class ServiceOptions(FilterOptions):
    """Choose the filter that checks what the policy proposes, and how loose its model set may be."""

    accept_bound: AcceptBound = None

    def settings(self) -> dict[str, Any]:
        """Return the values by the names that settings have for them."""
        return {"method": self.method, "model_config": self.model_config(), "accept_bound": self.accept_bound}


@dataclass(frozen=True)
class EvaluatedFilter(ServiceOptions):
    """Choose the filter that checks what the policy proposes: also one of your own."""

    method: Method | str = "ddpc"  # type: ignore[assignment]  # wider than a service's: the code runs in this process
    """Filter with this method: ddpc (this project's own), a rival or FILE.py:CLASS for a class of your own (see
    docs/rivals.md), or none for no filter."""


@dataclass(frozen=True)
class PhysicsOptions:
    """Set how the simulated robot differs from the robot that was recorded."""

    payload: float = 0.0
    """Add this mass to the robot [kg]."""
    weak_motor: float = 1.0
    """Leave one motor (of the left wheel, or of the first rotor) this share of its force."""
    friction: float = 1.0
    """Set the friction coefficient of the wheels on the floor."""
    noise: float = 1.0
    """Scale all sensor errors by this factor."""
    process_noise: float = 1.0
    """Scale the disturbances of the ground robot's motion by this factor: unequal motors, uneven wheels and floor."""
    wind: float = 0.0
    """Let a wind of this mean speed blow at the quadrotor [m/s]. Each episode draws the direction of the wind anew."""
    gust: float = 0.0
    """Let the wind vary on each axis with this standard deviation [m/s]."""
    perception: Literal["map", "scan"] = "map"
    """Take free space from this source: the arena's map, or the scan of a sensor (360 beams on the ground, 90 rings
    of 180 beams in the air)."""
    dropped: float = 0.0
    """Let this share of the beams of a scan return nothing."""
    false_far: float = 0.0
    """Let this share of the beams of a scan pass through an obstacle."""
    ghosts: float = 0.0
    """Let this share of the beams of a scan return from a point in free space."""
    blind: float = 0.0
    """Hide a sector of this width behind the robot from the sensor [deg]."""
    late: int = 0
    """Delay each scan by this number of control periods."""
    tracks: bool = False
    """With --perception scan, track moving obstacles from scan to scan, so that their speed is known."""

    def conditions(self) -> Conditions:
        """Return the simulator's conditions for these options. Raises ValueError if the options contradict."""
        faults = SensorFaults(self.dropped, self.false_far, self.ghosts, math.radians(self.blind), self.late)
        return Conditions(
            NoiseLevels(scale=self.noise),
            self.payload,
            self.friction,
            QuadrotorNoise(scale=self.noise),
            Wind(self.wind, gust=self.gust),
            Perception(self.perception, faults, self.tracks),
            ProcessNoise(scale=self.process_noise),
            self.weak_motor,
        )


@dataclass(frozen=True)
class SimulationOptions(PhysicsOptions):
    """Set how the simulated robot differs from the robot that was recorded, or let its model set simulate it."""

    learned: bool = False
    """Simulate the robot with its model set of mode one-step, which was fitted to its own log, instead of with the
    simulator of its task."""

    def conditions(self) -> Conditions:
        """Return the simulator's conditions for these options. Raises ValueError if the options contradict."""
        return replace(super().conditions(), learned=self.learned)


@dataclass(frozen=True)
class FlightOptions(FlightSettings):
    """Describe the vehicle behind a MAVLink link, and its place in the arena."""

    url: Annotated[str, tyro.conf.Suppress] = ""
    at_start: bool = False
    """Place the origin of the autopilot's local frame on the floor below the arena's start, where a simulated vehicle
    has its home position. Overrides --origin."""

    def settings(self, url: str, arena: Arena) -> FlightSettings:
        """Return the settings of a flight over the link `url` in an arena."""
        origin = (*arena.start[:2], 0.0) if self.at_start else self.origin
        return settings_from(FlightSettings, self, url=url, origin=origin)


@dataclass(frozen=True)
class BusOptions:
    """Join the message bus. Write endpoints as Zenoh does: tls/HOST:PORT with keys, tcp/HOST:PORT without."""

    connect: tuple[str, ...] = ()
    """Connect to these routers. Defaults to the router of the newest run on this machine."""
    listen: tuple[str, ...] = ()
    """Act as the router at these endpoints."""
    keys: Path | None = None
    """Use the keys of this process in this folder, which `brakeline keys` made. Defaults to $BRAKELINE_KEYS, else to no
    keys."""
    insecure: bool = False
    """Listen beyond this machine without keys. Everyone who reaches the bus can then command the robots, and each
    Health message warns of it."""
    metrics: str = ""
    """Serve /metrics (Prometheus), /live and /ready at PORT of this machine, or at HOST:PORT. By default the process
    serves none."""

    def bus(self) -> BusSettings:
        """Return the bus settings. Raises ValueError if there is neither an endpoint nor a run on this machine."""
        from brakeline.messaging.bus import BusSettings

        if self.connect or self.listen:
            return settings_from(BusSettings, self, keys=self.keys or default_keys())
        return replace(bus_of(LATEST), metrics=self.metrics)


@dataclass(frozen=True)
class RunBusOptions:
    """Set up the message bus of a run, and the keys of its processes."""

    listen: str | None = None
    """Let the run's router listen at this endpoint. Defaults to a free port of this machine."""
    keys: Path | None = None
    """Use the keys of all processes in this folder, which `brakeline keys` made. Defaults to $BRAKELINE_KEYS, else to
    keys of the run's own."""
    secured: bool = True
    """Make keys for the run if you give none. With --no-secured everyone who reaches the bus can command the robots."""
    insecure: bool = False
    """Allow --listen beyond this machine without keys. Each Health message then warns of it."""
    metrics: str = ""
    """Serve /metrics of the launcher at PORT of this machine, or at HOST:PORT. Its processes use the next ports."""

    def settings(self, config: RunConfig, folder: Path) -> BusSettings:
        """Return the bus settings of the launcher. Makes the run's own keys if the run needs any.

        Raises:
            ValueError: the port is 0, so that the run's processes could not know it; or there are too few ports for
                the metrics of the processes.
        """
        if self.listen and self.listen.partition("#")[0].endswith(":0"):
            raise ValueError(f"--listen {self.listen}: give a port, or leave it out for a free port of this machine")
        from brakeline.deploy.run.processes import process_specs
        from brakeline.deploy.run.run_keys import make_run_keys
        from brakeline.messaging.bus import BusSettings
        from brakeline.messaging.bus.bus_settings import local
        from brakeline.messaging.free_ports import free_endpoint
        from brakeline.messaging.http_server import LARGEST_PORT

        port, last = self.metrics.rpartition(":")[2], LARGEST_PORT - len(process_specs(config))
        if port.isdecimal() and not 1 <= int(port) <= last:
            raise ValueError(f"--metrics {self.metrics}: the run's processes use the next ports, so give 1 to {last}")
        keys = self.keys or default_keys() or (make_run_keys(config, folder) if self.secured else None)
        endpoints: tuple[str, ...] = (free_endpoint("tcp" if keys is None else "tls"),)
        if self.listen:
            # The run's own processes have another endpoint, so connections from other machines cannot delay them.
            endpoints = (self.listen,) if local(self.listen) else (*endpoints, self.listen)
        return BusSettings(listen=endpoints, keys=keys, insecure=self.insecure, metrics=self.metrics)


def settings_from(kind: type[T], options: object, **values: Any) -> T:
    """Return settings of a dataclass `kind`: the fields that the options have too, and `values`, which come first."""
    shared = {item.name for item in fields(cast("type[Any]", kind)) if hasattr(options, item.name)}
    return kind(**{name: getattr(options, name) for name in shared} | values)


def task_learner(learner: LearnerConfig, arguments: list[str], batch: bool = False) -> LearnerConfig:
    """Return the learner's settings, with those of the tasks of the robots that `arguments` name in place of defaults.

    For several robots, only settings that all their tasks have count.

    Args:
        batch: the learner trains with the backend batch, for which a task may have settings of its own.

    Raises:
        ValueError: TD3 has no such setting.
    """
    tables: list[dict[str, Any]] = []
    for word in [*arguments, "ground"]:  # which is the default
        # Another argument, or a file with mistakes, about which the run complains:
        with suppress(OSError, ValueError, TypeError, RecursionError):
            values = task_values(task_file(word))
            tables.append(values.get("learner", {}) | (values.get("batch", {}) if batch else {}))
    first, *others = tables[:-1] or tables
    shared = {name: value for name, value in first.items() if all(other.get(name) == value for other in others)}
    try:
        return replace(learner, td3=learner.td3.with_settings(shared))
    except ValueError as error:
        raise ValueError(f"[learner] or [batch] of the robot's task: {error}") from error


def given_settings(arguments: list[str], prefix: str) -> tuple[str, ...]:
    """Return the names of the settings that options such as --td3.n-step give, also with their default values.

    >>> given_settings(["ground", "--td3.n-step", "3", "--td3.no-symmetric", "--steps=9"], "--td3.")
    ('n_step', 'symmetric')
    """
    words = (word.partition("=")[0] for word in arguments if word.startswith(prefix))
    return tuple(word.removeprefix(prefix).removeprefix("no-").replace("-", "_") for word in words)


def default_keys() -> Path | None:
    """Return the folder in `$BRAKELINE_KEYS`, or None if the variable is not set."""
    folder = os.environ.get("BRAKELINE_KEYS")
    return Path(folder) if folder else None


def bus_of(run: Path) -> BusSettings:
    """Return the settings with which a client joins the bus of a run on this machine.

    Raises:
        ValueError: there is no run, or it has ended.
    """
    from brakeline.deploy.run.processes import client_settings
    from brakeline.messaging.free_ports import closed

    advice = "give --connect tls/HOST:PORT, or start `brakeline train`"
    try:
        settings = client_settings(run)
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"no run at {run}: {advice}") from error
    if closed(settings.connect[0]):
        raise ValueError(f"the run at {run} ({run.resolve().name}) has ended: {advice}")
    return settings
