"""Implement `brakeline recover`: repair damaged logs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from brakeline.deploy.commands.command_output import console, print_json
from brakeline.deploy.commands.common_options import Json, Quiet
from brakeline.deploy.progress import under_way


@dataclass(frozen=True)
class RecoverCommand:
    """The options of `brakeline recover`."""

    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG ...")]
    """Repair these log files (.mcap) or run folders. A repaired file takes the place of the damaged one, which stays
    beside it as *.mcap.damaged."""
    out: Path | None = None
    """Repair one file only, without the files that continue its log: write the repaired file here, and leave the
    damaged one as it is."""
    quiet: Quiet = False
    json: Json = False

    def run(self) -> int:
        """Repair the logs. Returns the exit status."""
        from brakeline.logs.log_recovery import recover
        from brakeline.logs.reader import find

        one_file = self.out is not None and len(self.logs) == 1 and self.logs[0].is_file()
        paths = self.logs if one_file else find(self.logs)
        if self.out is not None and len(paths) > 1:
            raise ValueError(f"--out takes one file, but the logs have {len(paths)}: name one .mcap file")
        recovered = []
        for path in paths:
            with under_way(f"reading {path}"):
                recovered.append(recover(path, self.out))
            if not self.json:
                console.print(str(recovered[-1]), markup=False)
        if self.json:
            print_json({"files": [asdict(file) for file in recovered]})
        return 0
