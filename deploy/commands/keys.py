"""`brakeline keys`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from brakeline.deploy.commands.common_options import console
from brakeline.messaging.atomic_files import write_secret
from brakeline.messaging.bus.certificate_authority import DAYS, Authority
from brakeline.messaging.bus.identity import SERVERS, role_of
from brakeline.safety.methods import load
from brakeline.safety.service.plan_token import KEY as VOUCHERS
from brakeline.safety.service.plan_token import write_key
from brakeline.safety.service.signature import ANY, SIGNERS, ModelSigner, seal_of, write_signer
from brakeline.safety.service.signature import KEY as SIGNER


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
    signer: bool = True
    """Make a key to sign models with, if there is none: it belongs to whoever certifies, offline."""
    robots: tuple[str, ...] = (ANY,)
    """Robots that a new signer may speak about; *: all."""
    sign: tuple[Path, ...] = ()
    """Model files to sign as they are; `brakeline certify --use --keys FOLDER` signs with the data at hand."""
    hand_out: Path | None = None
    """Copy what each of the names needs, and no more, to a folder of its name in here: to be carried to its machine."""

    def run(self) -> int:
        if self.sign:
            signer = ModelSigner.load(self.folder)
            for path in self.sign:
                signer.sign(load(path)).save(path)
                console.print(f"{seal_of(path)}", markup=False)
            return 0
        authority = Authority(self.folder, self.days)
        for name in self.names:
            authority.issue(name, self.host)
            console.print(f"{self.folder / name}.pem, .key", markup=False)
        write_key(self.folder)
        if self.signer:
            write_signer(self.folder, robots=self.robots)
        if self.hand_out is not None:
            for name in self.names:
                hand_out(self.folder, name, self.hand_out / name)
        return 0


def hand_out(keys: Path, name: str, to: Path) -> None:
    """Copy the files that a process of that name needs."""
    role = role_of(name)
    files = ["ca.pem", f"{name}.pem", f"{name}.key"]
    if role in SERVERS:
        files.append("names")
    if role == "safety":
        files += [VOUCHERS, *(str(path.relative_to(keys)) for path in (keys / SIGNERS).glob("*.json"))]
    if role == "certify":
        files.append(SIGNER)
    for file in files:
        write_secret(to / file, (keys / file).read_bytes())
    console.print(f"{to}: {', '.join(files)}", markup=False)
