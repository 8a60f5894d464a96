"""Implement `brakeline fly`: fly quadrotors in real time, with all processes on this machine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import tyro

from brakeline.actors.actor_settings import FlightSettings
from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import console, errors, print_json
from brakeline.deploy.commands.train_command import STOPPED, run_folder
from brakeline.deploy.run.run_config import AutopilotConfig, RunConfig
from brakeline.messaging.free_ports import free_udp_port
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import address_in_real_time

LEARN = "learn"  # value of --policy
TIMING_PREFIXES = ("periods ", "lateness", "worst", "link", "true", "estimate")  # of an actor's figures


@dataclass(frozen=True)
class FlyCommand:
    """The options of `brakeline fly`."""

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT]")] = "quadrotor"
    """Fly this robot. Give its name, or the path of a robot description (.toml)."""
    minutes: float = 10.0
    """Fly for this long [min]."""
    policy: str = "astar"
    """Let this policy fly: trained, untrained, random, greedy, adversary, astar, careful or a weights file.
    With `learn`, learn a policy from the flight."""
    url: tuple[str, ...] = ()
    """Fly the vehicles behind these links: udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT. Each vehicle flies
    as if it were alone on the same map: nothing keeps vehicles apart. All share one safety service. Without a link the
    command simulates the vehicles."""
    systems: tuple[int, ...] = ()
    """Address the vehicles by these MAVLink system ids, one for each link. Defaults to --system for all."""
    vehicles: int = 1
    """Simulate this many vehicles."""
    flight: options.Unprefixed[options.FlightOptions] = field(default_factory=options.FlightOptions)
    rules: Literal["px4", "ardupilot"] = "px4"
    """Simulate an autopilot with these rules: modes, refusals and parameters."""
    setpoint_timeout: float = AutopilotConfig.setpoint_timeout
    """Let the simulated autopilot brake after this time without a setpoint [s]."""
    arena: options.ArenaName = "default"
    seed: options.Seed = 0
    filtering: options.Unprefixed[options.ServiceOptions] = field(default_factory=options.ServiceOptions)
    physics: options.Unprefixed[options.PhysicsOptions] = field(default_factory=options.PhysicsOptions)
    practice: float = 0.0
    """At this share of the steps, let a vehicle begin to follow its backup plan to the stop. The log then has the stops
    that `brakeline certify ROBOT --data LOG` needs."""
    adapt: bool = False
    """Certify the vehicle anew in flight. If the vehicle needs wider sets than its model set states for some time, a
    certifier process fits a model set to the last minutes and puts it to use. --practice is then 0.01, unless you give
    it."""
    deadline: float = 0.12
    """Let an actor wait this long for an answer of the safety service [s]. The answer applies from the next control
    period (0.2 s) on."""
    pictures: options.Pictures = RunConfig.pictures
    out: options.RunFolder = None
    bus: options.Unprefixed[options.RunBusOptions] = field(default_factory=options.RunBusOptions)
    verbose: options.Verbose = False
    quiet: options.Quiet = False
    json: options.Json = False

    least: ClassVar[dict[str, float]] = {"vehicles": 1, "practice": 0}
    above: ClassVar[dict[str, float]] = {"minutes": 0, "deadline": 0, "setpoint_timeout": 0}

    @property
    def extras(self) -> tuple[str, ...]:
        """The optional parts that the command needs."""
        return ("sim", "mavlink", "logs", *(("train",) if self.policy == LEARN else ()))

    def run(self) -> int:
        """Fly. Returns the exit status."""
        from brakeline.deploy.run.display import Display, summary
        from brakeline.deploy.run.launcher import Launcher, prepare
        from brakeline.deploy.run.run_lock import only_launcher

        config = self.config()
        with run_folder(self.out) as folder:
            config = prepare(config, folder, resume=False)
            shown = Display(errors if self.json else console, config.steps * len(config.flights))
            with only_launcher(folder), shown as display:
                figures = Launcher(config, folder, self.bus.settings(config, folder)).run(display)
        actors = [f"actor-{i}" for i in range(len(config.flights))]
        figures["flight"] = flight_figures(figures, actors[0])
        if len(actors) > 1:
            figures["flights"] = {actor: timing_figures(figures, actor) for actor in actors}
        if self.json:
            print_json(figures)
        else:
            summary(console, figures, self.verbose)
            for prefix, values in [("", figures["flight"]), *figures.get("flights", {}).items()]:
                for name, value in values.items():
                    if self.verbose or name.startswith("true"):  # what the autopilot's own simulator says
                        console.print(f"{prefix}: {name}: {value}".removeprefix(": "), markup=False)
        return 0 if figures["finished"] else STOPPED

    def config(self) -> RunConfig:
        """Return the run's configuration. Raises ValueError if options contradict or the robot does not fly."""
        robot = robot_named(self.robot)
        if robot.position_dim != 3:
            raise ValueError(f"a {robot.kind} robot does not fly: name a robot with three position coordinates")
        robot = robot if robot.late else robot.in_real_time()
        flights = self._flights()
        return options.settings_from(
            RunConfig,
            self,
            robots=(address_in_real_time(self.robot),),
            **self.filtering.settings(),
            actors=len(flights),
            steps=max(1, round(60.0 * self.minutes / robot.period)),
            conditions=self.physics.conditions(),
            policy="" if self.policy == LEARN else self.policy,
            flights=flights,
            autopilot=None if self.url else options.settings_from(AutopilotConfig, self),
        )

    def _flights(self) -> tuple[FlightSettings, ...]:
        if not self.url:
            ports = [(free_udp_port(), free_udp_port()) for _ in range(self.vehicles)]
            return tuple(FlightSettings(f"udpin:127.0.0.1:{port}", truth=truth) for port, truth in ports)
        if self.vehicles != 1:
            raise ValueError("--vehicles counts simulated vehicles: give one --url for each other vehicle instead")
        systems = self.systems or (self.flight.system,) * len(self.url)
        if len(systems) != len(self.url):
            raise ValueError(f"{len(self.url)} links and {len(systems)} system ids: give one id for each --url")
        from brakeline.deploy.quadrotor_vehicles import flight_arena  # brings the simulator

        arena = flight_arena(self.arena, self.seed)
        pairs = zip(self.url, systems, strict=True)
        return tuple(replace(self.flight.settings(url, arena), system=system) for url, system in pairs)


def timing_figures(figures: dict[str, Any], actor: str) -> dict[str, Any]:
    """Select an actor's figures of real time, and of the ground truth, from the figures of a finished run."""
    values = figures["processes"].get(actor, {}).get("figures", {})
    names = ("periods", "answers in time", "answers in time share", "answers late", "answers none", "answers lost")
    more = {name: value for name, value in values.items() if name.startswith(TIMING_PREFIXES)}
    return {name: values.get(name) for name in names} | more


def flight_figures(figures: dict[str, Any], actor: str) -> dict[str, Any]:
    """Return the timing figures of an actor, and the outcome of the whole run."""
    return {
        **timing_figures(figures, actor),
        "collisions": figures["collisions"],
        "goals": figures["goals"],
        "decision_ms": _percentiles(figures["decision_ms"]),
        "round_trip_ms": _percentiles(figures["round_trip_ms"]),
        "left the predicted set": figures["containment"]["violations"],
    }


def _percentiles(times: dict[str, Any] | None) -> dict[str, float] | None:
    return None if times is None else {name: times[name] for name in ("p50", "p99")}
