"""`brakeline autopilot`: quadrotors behind MAVLink, in real time, for any ground station or companion."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from deploy.commands.common import errors, say_json
from deploy.run.autopilot import AutopilotSettings, fly
from sim.wind import Wind
from sim.world import Arena


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
    json: bool = False

    def run(self) -> int:
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
