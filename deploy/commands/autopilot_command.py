"""Implement `brakeline autopilot`: simulate quadrotors behind MAVLink in real time.

With `--px4` the autopilot is a real PX4, and this program simulates only the physics.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from brakeline.deploy.commands.command_output import errors, print_counts
from brakeline.deploy.commands.common_options import Json, Seed, settings_from
from brakeline.sim.sim_conditions import SensorNoise, Wind

if TYPE_CHECKING:
    from brakeline.deploy.run.px4_simulation import FlightResult
    from brakeline.sim.arena import Arena
    from brakeline.sim.autopilot.autopilot_server import ServerStats
    from brakeline.sim.quadrotor import Quadrotor


@dataclass(frozen=True)
class AutopilotCommand:
    """The options of `brakeline autopilot`."""

    url: str = "udpout:127.0.0.1:14540"
    """Serve MAVLink on this link: udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT. PX4's simulator sends to UDP
    port 14540; ArduPilot's listens on TCP port 5760."""
    rules: Literal["px4", "ardupilot"] = "px4"
    """Follow the rules of this autopilot: its modes, refusals and parameters."""
    vehicles: int = 1
    """Simulate this many vehicles, with system ids 1, 2, … They pass through each other."""
    arena: str = ""
    """Fly in this arena of the quadrotor, drawn with the seed. Defaults to an open field."""
    seed: Seed = 0
    airborne: bool = False
    """Start armed and hovering at the arena's start, instead of on the ground below it."""
    setpoint_timeout: float | None = None
    """Brake after this time without a setpoint [s]. Defaults to the parameter of --rules: 1 s for px4, 3 s for
    ardupilot."""
    wind: float = 0.0
    """Blow with this mean wind speed [m/s]. The seed draws its direction."""
    gust: float = 0.0
    """Let the wind vary on each axis with this standard deviation [m/s]."""
    truth: str = "127.0.0.1:14600"
    """Send true states and collisions to this HOST:PORT, as JSON in UDP datagrams. Empty sends none."""
    seconds: float = 0.0
    """Run for this long [s]. 0 runs until you press ^C."""
    px4: Path | None = None
    """Fly the simulated vehicle in lockstep with the PX4 in this folder, which you built for SITL. It has its own rules
    and estimator."""
    speed: float = 1.0
    """With --px4, run at this multiple of real time. 0 runs as fast as possible."""
    sensors: float = SensorNoise.scale
    """With --px4, scale the errors of IMU, magnetometer, barometer and GPS by this factor."""
    gps: float = SensorNoise.gps_position
    """With --px4, set the standard deviation of the GPS position on each axis [m]."""
    parameters: dict[str, float] = field(default_factory=dict)
    """With --px4, set these parameters, as NAME VALUE NAME VALUE ..."""
    json: Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "mavlink")
    least: ClassVar[dict[str, float]] = {"vehicles": 1, "seconds": 0, "speed": 0}
    above: ClassVar[dict[str, float]] = {"setpoint_timeout": 0}

    def run(self) -> int:
        """Fly until the duration ends, SIGINT or SIGTERM. Returns the exit status."""
        wind = Wind(self.wind, gust=self.gust)
        result: ServerStats | FlightResult
        if self.px4 is None:
            from brakeline.deploy.run import autopilot_run

            settings = settings_from(autopilot_run.AutopilotSettings, self, wind=wind)
            result = autopilot_run.fly(settings, self._print_start)
        else:
            result = self._fly_px4(self.px4, wind)
        print_counts(asdict(result), self.json)
        return 0

    def _fly_px4(self, folder: Path, wind: Wind) -> FlightResult:
        if self.vehicles != 1 or self.airborne or self.rules != "px4":
            raise ValueError(
                "a real PX4 flies one vehicle, by its own rules, and starts on the ground: leave out the option"
            )
        from brakeline.deploy.run import px4_simulation
        from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT

        timeout = {} if self.setpoint_timeout is None else {SETPOINT_TIMEOUT["px4"]: self.setpoint_timeout}
        settings = settings_from(
            px4_simulation.HilSettings,
            self,
            folder=folder,
            noise=SensorNoise(scale=self.sensors, gps_position=self.gps),
            wind=wind,
            parameters=timeout | self.parameters,
        )
        return px4_simulation.fly(settings, self._print_px4_start)

    def _print_start(self, arena: Arena) -> None:
        if not self.json:
            errors.print(f"{self.rules} on {self.url}, {self.vehicles} vehicle(s), {arena.name}; ^C ends it")

    def _print_px4_start(self, vehicle: Quadrotor) -> None:
        if not self.json:
            x, y, z = vehicle.true[:3]
            origin = f"its local frame begins at {x:.2f} {y:.2f} {z:.2f}"
            errors.print(f"PX4 on {self.url}, {vehicle.arena.name}; {origin}; ^C ends it")
