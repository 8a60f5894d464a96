"""Implement `brakeline recorder`: run a recorder alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import tyro

from brakeline.deploy.commands.common_options import BusOptions, Pictures, Unprefixed
from brakeline.deploy.run.run_config import RunConfig
from brakeline.logs.segment_rotation import Rotation


@dataclass(frozen=True)
class RecorderCommand:
    """The options of `brakeline recorder`."""

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[LOG]")] = Path("runs/run.mcap")
    """Write this log file (.mcap). If the file exists, the recorder writes the next one of the same log."""
    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    name: str = "recorder"
    """Give the recorder this name on the bus."""
    pictures: Pictures = RunConfig.pictures
    rotation: Rotation = field(default_factory=Rotation)

    def run(self) -> int:
        """Record until SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.deploy.run.log_contents import derive_entries
        from brakeline.logs import recorder

        metadata = {"versions": {"brakeline": version("brakeline")}}
        derive = derive_entries(self.pictures)
        settings = recorder.LogSettings(self.log, metadata, derive=derive, rotation=self.rotation)
        recorder.main(self.endpoints.bus(), settings, self.name)
        return 0
