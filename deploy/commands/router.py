"""`brakeline router`: what the processes of several machines meet at."""

from __future__ import annotations

from dataclasses import dataclass, field

from brakeline.deploy.commands.common_options import Endpoints, Flags


@dataclass(frozen=True)
class Router:
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    name: str = "router"
    """On the bus; each router has its own."""

    def run(self) -> int:
        from brakeline.messaging.process_runtime import Process

        settings = self.endpoints.bus()
        if not settings.listen:
            raise ValueError("a router needs --listen; --connect links it to other routers")
        with Process(settings, self.name) as process:
            process.announce()
            process.stop.wait()
        return 0
