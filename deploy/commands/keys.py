"""`brakeline keys`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deploy.commands.common import console
from messaging.bus.authority import DAYS, Authority


@dataclass(frozen=True)
class KeysCommand:
    folder: Annotated[Path, tyro.conf.Positional] = Path("keys")
    """Where the keys are, or are to be."""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Processes to issue certificates to, anew if they have one; each begins with its role, such as actor-7."""
    host: tuple[str, ...] = ()
    """Names and addresses at which the others reach those that may be routers, besides this machine's."""
    days: int = DAYS
    """That the certificates are valid."""

    def run(self) -> int:
        authority = Authority(self.folder, self.days)
        for name in self.names:
            authority.issue(name, self.host)
            console.print(f"{self.folder / name}.pem, .key", markup=False)
        return 0
