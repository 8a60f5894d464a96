"""Implement `brakeline keys`: make keys and certificates for the processes of several machines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from brakeline.deploy.commands.command_output import console
from brakeline.messaging.atomic_files import write_secret
from brakeline.messaging.bus.certificate_authority import DAYS, Authority
from brakeline.messaging.bus.identity import SERVERS, role_of, role_on_certificate
from brakeline.safety.methods import load
from brakeline.safety.service.plan_token import KEY_FILE as PLAN_TOKEN_KEY
from brakeline.safety.service.plan_token import write_key
from brakeline.safety.service.signature import ANY, SIGNERS, ModelSigner, seal_of, write_signer
from brakeline.safety.service.signature import KEY as SIGNING_KEY


@dataclass(frozen=True)
class KeysCommand:
    """The options of `brakeline keys`."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER]")] = Path("keys")
    """Make the keys in this folder. The command makes the folder if it does not exist."""
    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[NAME ...]")] = ()
    """Issue certificates to these processes. Each name begins with its role, such as actor-7. A process that has a
    certificate gets a new one."""
    host: tuple[str, ...] = ()
    """Let others reach the processes that may be routers at these names and addresses, besides this machine's."""
    days: int = DAYS
    """Let the certificates be valid for this many days."""
    signer: bool = True
    """Make a key that signs models, if the folder trusts no signer yet. Keep it offline, with the person who certifies
    models."""
    robots: tuple[str, ...] = (ANY,)
    """Let a new signer sign the models of these robots; * stands for all."""
    sign: tuple[Path, ...] = ()
    """Sign these model files as they are. To sign a model set together with its data set, use `brakeline certify --use
    --keys FOLDER` instead."""
    hand_out: Path | None = None
    """Copy the files that each named process needs, and no others, to a folder of its name in this folder. Carry that
    folder to the machine of the process."""

    def run(self) -> int:
        """Sign the models, or else make the keys. Returns the exit status."""
        if self.sign:
            signer = ModelSigner.load(self.folder)
            for path in self.sign:
                signer.sign(load(path)).save(path)
                console.print(str(seal_of(path)), markup=False)
            return 0
        for name in self.names:
            role_on_certificate(name)  # a wrong name is refused before there is a folder
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
    """Copy the files that a process of this name needs to the folder `to`."""
    role = role_of(name)
    files = ["ca.pem", f"{name}.pem", f"{name}.key"]
    if role in SERVERS:
        files.append("names")
    if role == "safety":
        files += [PLAN_TOKEN_KEY, *(str(path.relative_to(keys)) for path in (keys / SIGNERS).glob("*.json"))]
    if role == "certify" and (keys / SIGNING_KEY).exists():  # it may be kept offline
        files.append(SIGNING_KEY)
    for file in files:
        write_secret(to / file, (keys / file).read_bytes())
    console.print(f"{to}: {', '.join(files)}", markup=False)
