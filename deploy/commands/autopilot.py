"""`brakeline autopilot`: quadrotors behind MAVLink, in real time, for any ground station or companion; with `--px4` the
autopilot is a real one, and only the physics are ours."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from brakeline.deploy.commands.common_options import errors, say_json
from brakeline.deploy.run.autopilot_run import AutopilotSettings, fly
from brakeline.deploy.run.px4_simulation import HilSettings
from brakeline.deploy.run.px4_simulation import fly as fly_px4
from brakeline.sim.arena import Arena
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT
from brakeline.sim.autopilot.hil_sensors import SensorNoise
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.wind import Wind


@dataclass(frozen=True)
class Autopilot:
    url: str = "udpout:127.0.0.1:14540"
    """udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT. PX4's simulator sends to UDP 14540, ArduPilot's listens on
    TCP 5760."""
    rules: Literal["px4", "ardupilot"] = "px4"
    """Whose modes, refusals and parameters."""
    vehicles: int = 1
    """By system id 1, 2, …; they pass through each other."""
    arena: str = ""
    """Of the quadrotor, drawn with the seed; without one: an open field."""
    seed: int = 0
    airborne: bool = False
    """Start hovering at the arena's start, armed, instead of on the ground below it."""
    setpoint_timeout: float | None = None
    """s without a setpoint until it brakes; without it: as the rules' parameter has it (1 s, 3 s)."""
    wind: float = 0.0
    """m/s, mean; its direction is drawn."""
    gust: float = 0.0
    """m/s, standard deviation on each axis."""
    truth: str = "127.0.0.1:14600"
    """Where states and collisions go, as JSON in UDP datagrams; empty: nowhere."""
    seconds: float = 0.0
    """Until it ends; 0: on ^C."""
    px4: Path | None = None
    """Folder of a PX4 that was built for SITL: it flies our vehicle, in lockstep, with its own rules and estimator."""
    speed: float = 1.0
    """Of a real PX4: times real time; 0: as fast as it goes."""
    sensors: float = SensorNoise.scale
    """Of a real PX4: factor on the errors of IMU, magnetometer, barometer and GPS."""
    gps: float = SensorNoise.gps_position
    """Of a real PX4: m, sigma of its GPS on each axis."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Of a real PX4: NAME VALUE ..."""
    json: bool = False

    def run(self) -> int:
        return self._embedded() if self.px4 is None else self._real(self.px4)

    def _real(self, folder: Path) -> int:
        if self.vehicles != 1 or self.airborne or self.rules != "px4":
            raise ValueError("a real PX4 flies one vehicle, by its own rules, and starts on the ground")
        timeout = {} if self.setpoint_timeout is None else {SETPOINT_TIMEOUT["px4"]: self.setpoint_timeout}
        settings = HilSettings(
            folder,
            self.url,
            self.arena,
            self.seed,
            SensorNoise(scale=self.sensors, gps_position=self.gps),
            Wind(self.wind, gust=self.gust),
            timeout | self.parameters,
            self.truth,
            self.speed,
            self.seconds,
        )
        flown = fly_px4(settings, self._answered)
        if self.json:
            say_json(asdict(flown))
        else:
            errors.print(str(flown))
        return 0

    def _embedded(self) -> int:
        settings = AutopilotSettings(
            self.url,
            self.rules,
            self.vehicles,
            self.arena,
            self.seed,
            self.airborne,
            self.setpoint_timeout,
            Wind(self.wind, gust=self.gust),
            self.truth,
            self.seconds,
        )
        tally = fly(settings, self._begun)
        if self.json:
            say_json(asdict(tally))
        else:
            errors.print(str(tally))
        return 0

    def _begun(self, arena: Arena) -> None:
        if not self.json:
            errors.print(f"{self.rules} on {self.url}, {self.vehicles} vehicle(s), {arena.name}; ^C ends it")

    def _answered(self, vehicle: Quadrotor) -> None:
        if not self.json:
            x, y, z = vehicle.true[:3]
            where = f"its local frame begins at {x:.2f} {y:.2f} {z:.2f}"
            errors.print(f"PX4 on {self.url}, {vehicle.arena.name}; {where}; ^C ends it")
