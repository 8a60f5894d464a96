"""Signatures of models: an Ed25519 signature by a key that no process of a run needs, made where the data are.

signer.key          the private key, in the folder of keys of the person who certifies; keep it offline
signer.last         the number of the last signature by this key
signers/NAME.json   a public key that a service trusts, and the robots whose models it may sign
MODEL.seal          beside a model's file: a claim and its signature

The signature covers a claim about the file: its SHA-256, robot, layout and version, the recorded domain, and the number
of the signature, which orders the models of a robot. A number is the time of signing [ns since the Unix epoch], or one
more than the number before if the clock was set back. A service checks the signature before it reads anything else of a
model, and takes no model with a lower number than that of the model in use.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any, Self

import numpy as np
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from brakeline.errors import BadModel, Untrusted
from brakeline.messaging.atomic_files import write_atomically, write_secret
from brakeline.messaging.robot import Array
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.methods import Model, decode
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.windows import recorded_domain

log = logging.getLogger("brakeline.safety")

CONTEXT = b"brakeline model 1\n"  # signed with each claim, so that a signature is valid for nothing else
KEY, LAST, SIGNERS = "signer.key", "signer.last", "signers"
MOST = 2**63  # numbers of signatures are below
SIGN = "sign it with `brakeline keys FOLDER --sign FILE`, by a key in `signers/` of the service's keys"
ANY = "*"  # in a signer's list of robots: it may sign models of all


@dataclass(frozen=True)
class SignedModel:
    """The bytes of a model's file, of the claim about it (JSON), and of the claim's signature."""

    file: bytes
    claim: bytes
    signature: bytes

    def save(self, path: Path) -> None:
        """Write the file and its seal. The seal comes first, so that no model is ever without one."""
        seal = {"claim": self.claim.decode(), "signature": self.signature.hex()}
        write_atomically(seal_of(path), json.dumps(seal, indent=2).encode())
        write_atomically(path, self.file)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a model's file and its seal. Raises Untrusted if either is missing or not readable."""
        try:
            seal = parse_json(seal_of(path).read_bytes())
            return cls(path.read_bytes(), str(seal["claim"]).encode(), bytes.fromhex(seal["signature"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Untrusted(
                f"{path} has no seal ({error}): sign it with `brakeline keys FOLDER --sign {quote(str(path))}`"
            ) from error


def seal_of(path: Path) -> Path:
    """Return the path of the seal of a model's file."""
    return path.with_suffix(".seal")


class ModelSigner:
    """Signs models with a private key."""

    def __init__(self, key: Ed25519PrivateKey, last: Path) -> None:
        """last: the file with the number of the last signature."""
        self._key, self._last, self._number = key, last, 0

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the private key in a folder. Raises Untrusted if there is none."""
        return cls(_private_key(folder), folder / LAST)

    def sign(self, model: Model, data: Dataset | None = None) -> SignedModel:
        """Return a model with a signed claim about it.

        Args:
            model: a model set or a rival's model.
            data: the data set that the model set was made from. Without it, the claim states the model set's domain.

        Raises:
            Untrusted: the model set's domain is larger than the data's, or the note of the last number is damaged.
        """
        file = model.encode()
        domain = None
        if isinstance(model, ModelSet):
            domain = recorded_domain(data) if data is not None else model.domain
            _within(model, domain)
        claim = {
            "robot": model.robot.name,
            "layout": model.robot.layout(),
            "version": model.version,
            "sha256": hashlib.sha256(file).hexdigest(),
            "domain": None if domain is None else domain.tolist(),
            "number": self._next_number(),
        }
        words = json.dumps(claim, sort_keys=True).encode()
        return SignedModel(file, words, self._key.sign(CONTEXT + words))

    def _next_number(self) -> int:
        """Return the number of the next signature, and note it. Raises Untrusted if the note before is damaged."""
        try:
            noted = int(self._last.read_text()) if self._last.exists() else 0
        except (OSError, ValueError) as error:
            raise Untrusted(
                f"{self._last}: damaged: {error}. Delete it if the clock of this computer is right"
            ) from error
        self._number = max(time.time_ns(), noted + 1, self._number + 1)
        try:
            write_atomically(self._last, str(self._number).encode())
        except OSError as error:  # a folder that cannot be written: the clock orders the signatures
            log.warning("the number of a signature was not noted: %s", error)
        return self._number


@dataclass(frozen=True)
class TrustedSigners:
    """The public keys that a service trusts, each with the robots whose models it may sign."""

    signers: tuple[tuple[Ed25519PublicKey, tuple[str, ...]], ...] = ()

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the public keys in a folder. Raises Untrusted if a file holds none."""
        signers = []
        for path in sorted((folder / SIGNERS).glob("*.json")):
            try:
                signer = parse_json(path.read_bytes())
                key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(signer["key"]))
                signers.append((key, tuple(map(str, signer["robots"]))))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise Untrusted(f"{path}: no signer's public key: {error!r}") from error
        return cls(tuple(signers))

    def open(self, signed: SignedModel, robot: str | None = None) -> Model:
        """Return the model in a signed file; robot: the name under which it was published, if it was.

        Raises:
            Untrusted: no trusted signer signed it, or it is not what was signed.
            BadModel: the file holds no model.
        """
        robots = self._robots_of_signer(signed)
        claim = _claim(signed)
        if hashlib.sha256(signed.file).hexdigest() != claim["sha256"]:
            raise Untrusted(f"the model's file is not the one that was signed: {SIGN}")
        if ANY not in robots and claim["robot"] not in robots:
            raise Untrusted(f"the signer may not sign models of {claim['robot']}")
        if robot is not None and claim["robot"] != robot:
            raise Untrusted(f"a model of {claim['robot']} was published as one of {robot}")
        model = decode(signed.file)
        for name, value in (
            ("robot", model.robot.name),
            ("layout", model.robot.layout()),
            ("version", model.version),
        ):
            if claim[name] != value:
                raise Untrusted(f"the model's {name} is {value}, but {claim[name]} was signed")
        if isinstance(model, ModelSet):
            _within(model, _domain_in(claim))
        return model

    def number(self, signed: SignedModel) -> int:
        """Return the number of the signature. Raises Untrusted if no trusted signer signed the claim."""
        self._robots_of_signer(signed)
        return int(_claim(signed)["number"])

    def load_model(self, path: Path) -> Model:
        """Return the model in a file with a seal beside it. Raises like `open`, with the file's name."""
        try:
            return self.open(SignedModel.load(path))
        except Untrusted as error:
            raise Untrusted(f"{path}: {error}") from error
        except BadModel as error:
            raise BadModel(f"{path}: {error}") from error

    def _robots_of_signer(self, signed: SignedModel) -> tuple[str, ...]:
        """Return the robots whose models the signer may sign. Raises Untrusted if the signer is not trusted."""
        for key, robots in self.signers:
            try:
                key.verify(signed.signature, CONTEXT + signed.claim)
            except InvalidSignature:
                continue
            return robots
        raise Untrusted(f"no trusted signer signed the model: {SIGN}")


def write_signer(folder: Path, robots: tuple[str, ...] = (ANY,)) -> None:
    """Write a new private key, and its public key among the trusted ones, if the folder trusts no signer yet.

    The private key of a trusted signer may be kept elsewhere; a new one would take its place.

    Raises:
        Untrusted: the folder has a private key that cannot be read.
    """
    if any((folder / SIGNERS).glob("*.json")):
        return
    if not (folder / KEY).exists():  # else the process ended between these two files
        key = Ed25519PrivateKey.generate()
        write_secret(folder / KEY, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public = _private_key(folder).public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    signer = {"key": public.hex(), "robots": list(robots)}
    write_atomically(folder / SIGNERS / "certify.json", json.dumps(signer, indent=2).encode())


def _private_key(folder: Path) -> Ed25519PrivateKey:
    """Read the private key in a folder. Raises Untrusted if there is none."""
    try:
        key = load_pem_private_key((folder / KEY).read_bytes(), None)
    except (OSError, ValueError) as error:
        raise Untrusted(f"{folder / KEY}: no key to sign models with: {error}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise Untrusted(f"{folder / KEY}: not an Ed25519 key")
    return key


def _claim(signed: SignedModel) -> dict[str, Any]:
    """Return the claim that was signed. Raises Untrusted if it is not readable."""
    try:
        claim = parse_json(signed.claim)
        known = {name: claim[name] for name in ("robot", "layout", "version", "sha256", "domain")}
        number = claim.get("number", 0)  # earlier versions wrote none
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise Untrusted(f"the claim about the model can't be read: {error!r}") from error
    if type(number) is not int or not 0 <= number < MOST:
        raise Untrusted(f"the number of the signature is {number!r:.40}")
    return known | {"number": number}


def _domain_in(claim: dict[str, Any]) -> Array:
    """Return the recorded domain that a claim states. Raises Untrusted."""
    try:
        return np.array(claim["domain"], float)
    except (ValueError, TypeError, OverflowError) as error:
        raise Untrusted(f"the claim does not state the recorded domain: {error}") from error


def _within(model: ModelSet, recorded: Array) -> None:
    """Raise Untrusted if a model set's domain is larger than the recorded one (2, regressor_dim)."""
    if recorded.shape != model.domain.shape:
        raise Untrusted("the claim does not state the recorded domain")
    if not ((model.domain[0] >= recorded[0]).all() and (model.domain[1] <= recorded[1]).all()):  # NaN fails too
        raise Untrusted("the model claims a wider domain than was recorded")
