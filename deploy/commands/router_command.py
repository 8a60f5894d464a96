"""Implement `brakeline router`: run a router of the bus."""

from __future__ import annotations

from dataclasses import dataclass, field

from brakeline.deploy.commands.common_options import BusOptions, Unprefixed


@dataclass(frozen=True)
class RouterCommand:
    """The options of `brakeline router`."""

    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    name: str = "router"
    """Give the router this name on the bus. Each router needs its own."""

    def run(self) -> int:
        """Route messages until SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.messaging.process_runtime import Process

        settings = self.endpoints.bus()
        if not settings.listen:
            raise ValueError("a router needs --listen; --connect links it to other routers")
        with Process(settings, self.name) as process:
            process.announce()
            process.stop.wait()
        return 0
