"""`brakeline fly`: quadrotors in real time, with all that they need on this machine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from brakeline.actors.flight_process import FlightSettings
from brakeline.deploy.commands.common_options import Flags, Flight, Meeting, Physics, Serving, console, errors, say_json
from brakeline.deploy.commands.train import STOPPED, stamped
from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.deploy.run.display import Display, summary
from brakeline.deploy.run.launcher import Launcher, prepare
from brakeline.deploy.run.run_config import Embedded, RunConfig
from brakeline.messaging.free_ports import free_udp_port
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import address_in_real_time

LEARN = "learn"
TOLD = ("periods ", "lateness", "worst", "link", "true", "estimate")  # beginnings of figures' names


@dataclass(frozen=True)
class Fly:
    robot: Annotated[str, tyro.conf.Positional] = "quadrotor"
    minutes: float = 10.0
    policy: str = "astar"
    """A file, or trained | untrained | random | greedy | adversary | astar | careful; learn: from what it flies."""
    url: tuple[str, ...] = ()
    """An autopilot that runs elsewhere: udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT. Without one: our own. Of
    several each flies alone on its own map, and all ask one safety service."""
    systems: tuple[int, ...] = ()
    """MAVLink system ids of several, where they are not all --system."""
    vehicles: int = 1
    """So many of our own."""
    flight: Flags[Flight] = field(default_factory=Flight)
    rules: Literal["px4", "ardupilot"] = "px4"
    """Of our own autopilot."""
    setpoint_timeout: float = Embedded.setpoint_timeout
    """s without a setpoint until our own autopilot brakes by itself."""
    arena: str = "default"
    seed: int = 0
    filtering: Flags[Serving] = field(default_factory=Serving)
    physics: Flags[Physics] = field(default_factory=Physics)
    practice: float = 0.0
    """Share of steps at which it starts to follow its committed plan to the stop: what `certify LOG` needs."""
    deadline: float = 0.12
    """s, for an answer of the safety service; the answer counts from the next period on, of 0.2 s."""
    pictures: float = RunConfig.pictures
    """A second, drawn for Foxglove in the log besides all interventions; 0: none at all."""
    out: Path | None = None
    """The run's folder; default: runs/ and the time."""
    meeting: Flags[Meeting] = field(default_factory=Meeting)
    json: bool = False
    """Print the final figures as one JSON object on stdout; the display goes to stderr."""

    def run(self) -> int:
        config, folder, shown = self.config(), self.out or stamped(), errors if self.json else console
        prepare(config, folder, resume=False)
        with Display(shown, config.steps * len(config.flights)) as display:
            figures = Launcher(config, folder, self.meeting.settings(config, folder)).run(display)
        actors = [f"actor-{i}" for i in range(len(config.flights))]
        figures["flight"] = flown(figures, actors[0])
        if len(actors) > 1:
            figures["flights"] = {actor: timing(figures, actor) for actor in actors}
        if self.json:
            say_json(figures)
        else:
            summary(console, figures)
            for name, value in figures["flight"].items():
                console.print(f"{name}: {value}", markup=False)
            for actor, values in figures.get("flights", {}).items():
                for name, value in values.items():
                    console.print(f"{actor}: {name}: {value}", markup=False)
        return 0 if figures["finished"] else STOPPED

    def config(self) -> RunConfig:
        """The run's configuration. Raises ValueError for a robot that does not fly."""
        robot = robot_named(self.robot)
        if robot.position_dim != 3:
            raise ValueError(f"a {robot.kind} robot does not fly")
        robot = robot if robot.late else robot.in_real_time()
        flights = self._flights()
        return RunConfig(
            robots=(address_in_real_time(self.robot),),
            method=self.filtering.method,
            model_config=self.filtering.model_config(),
            accept_bound=self.filtering.accept_bound,
            arena=self.arena,
            actors=len(flights),
            steps=max(1, round(60.0 * self.minutes / robot.period)),
            seed=self.seed,
            deadline=self.deadline,
            practice=self.practice,
            pictures=self.pictures,
            conditions=self.physics.conditions(),
            policy="" if self.policy == LEARN else self.policy,
            flights=flights,
            autopilot=None if self.url else Embedded(self.rules, self.setpoint_timeout),
        )

    def _flights(self) -> tuple[FlightSettings, ...]:
        """Raises ValueError: not as many system ids as URLs, or our own vehicles beside others'."""
        if not self.url:
            ports = [(free_udp_port(), free_udp_port()) for _ in range(self.vehicles)]
            return tuple(FlightSettings(f"udpin:127.0.0.1:{port}", truth=truth) for port, truth in ports)
        if self.vehicles != 1:
            raise ValueError("--vehicles are our own: name others by --url, one after the other")
        systems = self.systems or (self.flight.system,) * len(self.url)
        if len(systems) != len(self.url):
            raise ValueError(f"{len(self.url)} URLs and {len(systems)} system ids: name one for each")
        arena = flight_arena(self.arena, self.seed)
        named = zip(self.url, systems, strict=True)
        return tuple(replace(self.flight.settings(url, arena), system=system) for url, system in named)


def timing(figures: dict[str, Any], actor: str) -> dict[str, Any]:
    """How an actor kept real time, and what a judge of its flight saw, of a finished run's figures."""
    told = figures["processes"].get(actor, {}).get("figures", {})
    names = ("periods", "answers in time", "answers in time share", "answers late", "answers none", "answers lost")
    more = {name: value for name, value in told.items() if name.startswith(TOLD)}
    return {name: told.get(name) for name in names} | more


def flown(figures: dict[str, Any], actor: str) -> dict[str, Any]:
    """How real time was kept by that actor, and what the whole run came to."""
    return {
        **timing(figures, actor),
        "collisions": figures["collisions"],
        "goals": figures["goals"],
        "decision_ms": _pair(figures["decision_ms"]),
        "round_trip_ms": _pair(figures["round_trip_ms"]),
        "left the predicted set": figures["containment"]["violations"],
    }


def _pair(times: dict[str, Any] | None) -> dict[str, float] | None:
    return None if times is None else {name: times[name] for name in ("p50", "p99")}
