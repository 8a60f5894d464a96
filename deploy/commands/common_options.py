"""Options and small things that several commands share.

Nothing heavy is imported before it is used: `--help` and a typing mistake are answered at once.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from rich.console import Console

from brakeline.actors.actor_settings import FlightSettings
from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.safety.model.model_config import ModelConfig
from brakeline.sim.sim_conditions import Conditions, NoiseLevels, Perception, QuadrotorNoise, SensorFaults, Wind

if TYPE_CHECKING:
    from brakeline.deploy.run.run_config import RunConfig
    from brakeline.messaging.bus import BusSettings
    from brakeline.sim.arena import Arena

Certificate = Literal["residual", "set-membership", "matrix-zonotope"]
Mode = Literal["direct", "recursion"]
Method = Literal["ddpc", "secas", "sailr", "none"]
T = TypeVar("T")
Flags = Annotated[T, tyro.conf.OmitArgPrefixes]

LATEST = Path("runs/latest")


@dataclass(frozen=True)
class Filtering:
    """Which filter stands before the policy."""

    method: Method = "ddpc"
    """ddpc: ours; secas, sailr: the rivals; none: no filter."""
    certificate: Certificate = "residual"
    """What the model set trusts in the data (docs/certificates.md)."""
    mode: Mode = "direct"
    """A predictor for each step of the plan, or the paper's recursion."""

    def model_config(self) -> ModelConfig:
        return ModelConfig(self.certificate, self.mode)


@dataclass(frozen=True)
class Serving(Filtering):
    """Which filter is put to use, and how loose its statement may be."""

    accept_bound: float | None = None
    """Use model sets that state at most this share of plans outside their tubes (0.26: 26 %). Without it the limit of
    the robot's description counts: `accept_bound`, 0.01 unless the description has one."""


@dataclass(frozen=True)
class Physics:
    """What may differ between the robot that was recorded and the one that drives."""

    payload: float = 0.0
    """kg on top of the robot."""
    friction: float = 1.0
    """Friction coefficient of the wheels on the floor."""
    noise: float = 1.0
    """Factor on all sensor errors."""
    wind: float = 0.0
    """m/s on average, on the quadrotor, from a side that is drawn anew each episode."""
    gust: float = 0.0
    """m/s, standard deviation of the wind on each axis."""
    perception: Literal["map", "scan"] = "map"
    """Where free space comes from: the arena's map, or what a sensor shows (360 beams; in the air 90 rings of 180)."""
    dropped: float = 0.0
    """Share of the scan's beams that say nothing."""
    false_far: float = 0.0
    """Share of the scan's beams that see through what is there."""
    ghosts: float = 0.0
    """Share of the scan's beams that return from where nothing is."""
    blind: float = 0.0
    """Degrees about straight behind that the sensor does not see."""
    late: int = 0
    """Periods until a scan is there."""
    tracks: bool = False
    """By scans, among things that move: follow what is seen from scan to scan, to know how fast it may go on."""

    def conditions(self) -> Conditions:
        return Conditions(
            NoiseLevels(scale=self.noise),
            self.payload,
            self.friction,
            QuadrotorNoise(scale=self.noise),
            Wind(self.wind, gust=self.gust),
            Perception(
                self.perception,
                SensorFaults(self.dropped, self.false_far, self.ghosts, math.radians(self.blind), self.late),
                self.tracks,
            ),
        )


@dataclass(frozen=True)
class Flight:
    """The autopilot behind a link, and where it is."""

    system: int = 1
    """MAVLink system id of the vehicle."""
    truth: int = 0
    """UDP port at which a simulator on this machine tells of collisions (`brakeline autopilot --truth`); 0: none."""
    height: float = 3.0
    """m above the ground that it climbs to first, unless it flies already. Nothing is filtered on this way."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m: where in the arena the autopilot's local frame begins."""
    at_start: bool = False
    """Its local frame begins on the floor below the arena's start: a simulator on its home position."""
    raise_limits: bool = False
    """Set those of its parameters that hold it below what the filter may ask for: speeds, accelerations, tilt."""
    lead: bool = False
    """Tell it places to go to in place of velocities: when setpoints stop it stays at the last one, where an ArduCopter
    without GUID_TIMEOUT flies on for 3 s. It flies otherwise then: `collect` and `fly` both with it."""

    def settings(self, url: str, arena: Arena) -> FlightSettings:
        """For the flight in an arena."""
        x, y, *_ = arena.start
        origin = (x, y, 0.0) if self.at_start else self.origin
        return FlightSettings(url, self.system, self.truth, self.height, origin, self.raise_limits, self.lead)


@dataclass(frozen=True)
class Endpoints:
    """Where the bus is, as Zenoh writes it: tls/HOST:PORT with keys, tcp/HOST:PORT without."""

    connect: tuple[str, ...] = ()
    """Routers to connect to; without any: that of the newest run here."""
    listen: tuple[str, ...] = ()
    """Be the router at these endpoints."""

    keys: Path | None = None
    """Folder with this process's keys (`brakeline keys` makes them); default: $BRAKELINE_KEYS, else none."""
    insecure: bool = False
    """Listen beyond this machine without keys. Whoever reaches the bus can command the robots; every Health says so."""
    metrics: str = ""
    """PORT of this machine, or HOST:PORT, for /metrics (Prometheus), /live and /ready; without one: nowhere."""

    def bus(self) -> BusSettings:
        """Raises ValueError when there is neither an endpoint nor a run."""
        from brakeline.messaging.bus import BusSettings

        if self.connect or self.listen:
            keys = self.keys or default_keys()
            return BusSettings(
                connect=self.connect, listen=self.listen, keys=keys, insecure=self.insecure, metrics=self.metrics
            )
        return replace(bus_of(LATEST), metrics=self.metrics)


@dataclass(frozen=True)
class Meeting:
    """Where the processes of a run meet, and how they know each other."""

    listen: str | None = None
    """The router's endpoint; default: a free port of this machine."""
    keys: Path | None = None
    """Folder with keys of all processes (`brakeline keys`); default: $BRAKELINE_KEYS, else the run's own."""
    secured: bool = True
    """Make keys of the run's own where none are given; without, whoever reaches the bus can command the robots."""
    insecure: bool = False
    """Let --listen be beyond this machine without keys. Every Health says so."""
    metrics: str = ""
    """PORT of this machine, or HOST:PORT, for the launcher's /metrics; its processes have the ports after it."""

    def settings(self, config: RunConfig, folder: Path) -> BusSettings:
        """The launcher's place on the bus."""
        from brakeline.deploy.run.run_keys import own_keys
        from brakeline.messaging.bus import BusSettings
        from brakeline.messaging.free_ports import free_endpoint

        keys = self.keys or default_keys() or (own_keys(config, folder) if self.secured else None)
        endpoint = self.listen or free_endpoint("tcp" if keys is None else "tls")
        return BusSettings(listen=(endpoint,), keys=keys, insecure=self.insecure, metrics=self.metrics)


def default_keys() -> Path | None:
    """`$BRAKELINE_KEYS`, if it is set."""
    folder = os.environ.get("BRAKELINE_KEYS")
    return Path(folder) if folder else None


def bus_of(run: Path) -> BusSettings:
    """How a client gets on the bus of a run on this machine. Raises ValueError with what to do."""
    from brakeline.deploy.run.processes import client_of

    try:
        return client_of(run)
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"no run at {run}: give --connect tls/HOST:PORT, or start `brakeline train`") from error


def say_json(figures: dict[str, Any]) -> None:
    """One JSON object on stdout; what is not finite becomes null."""
    print(json.dumps(_finite(figures)))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value


# Soft wrap: lines are the terminal's to break, and a pipe's not to be broken.
console = Console(highlight=False, soft_wrap=True)
errors = Console(stderr=True, highlight=False, soft_wrap=True)

Robot = Annotated[str, tyro.conf.Positional]


def conditions(about: dict[str, str]) -> StackingTable:
    """How data were recorded, a line each."""
    shown = StackingTable(show_header=False, **PLAIN)
    for name, value in about.items():
        shown.add_row(name.replace("_", " "), value)
    return shown
