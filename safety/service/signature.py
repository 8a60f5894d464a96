"""Who certified a model: an Ed25519 signature, made where the data are, by a key that no process of a run needs.

signer.key          the key, in the folder of keys of whoever certifies; kept offline
signers/NAME.json   a public key that a service takes models of, and the robots that it may speak about
MODEL.seal          beside a model's file: a claim, and its signature

What is signed is a claim about a file: its SHA-256, robot, layout and version, and the domain that was recorded. The
signature is looked at before anything else of a model is.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
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

from brakeline.messaging.atomic_files import write_atomically, write_secret
from brakeline.safety.methods import Model, decode
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import Array, BadModel, ModelSet
from brakeline.safety.model.windows import windows

CONTEXT = b"brakeline model 1\n"  # what a signature of ours is about, so that it is good for nothing else
KEY, SIGNERS = "signer.key", "signers"
ANY = "*"  # in a signer's list of robots


class Untrusted(BadModel):
    """Nobody who is believed says what the model is, or it is not that."""


@dataclass(frozen=True)
class SignedModel:
    """A model's file, the claim about it (JSON) and the claim's signature."""

    file: bytes
    claim: bytes
    signature: bytes

    def save(self, path: Path) -> None:
        """The file, with its seal beside it; the seal first, so that there is never a model without one."""
        said = {"claim": self.claim.decode(), "signature": self.signature.hex()}
        write_atomically(seal_of(path), json.dumps(said, indent=2).encode())
        write_atomically(path, self.file)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Raises Untrusted: there is no such file, or no seal beside it."""
        try:
            said = json.loads(seal_of(path).read_bytes())
            return cls(path.read_bytes(), str(said["claim"]).encode(), bytes.fromhex(said["signature"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Untrusted(
                f"{path} has no seal ({error}): sign it with `brakeline keys FOLDER --sign {path}`"
            ) from error


def seal_of(path: Path) -> Path:
    return path.with_suffix(".seal")


class ModelSigner:
    """Whoever certifies."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key

    @classmethod
    def load(cls, folder: Path) -> Self:
        """
        Raises:
            Untrusted: the folder has no key to sign with.
        """
        try:
            key = load_pem_private_key((folder / KEY).read_bytes(), None)
        except (OSError, ValueError) as error:
            raise Untrusted(f"{folder / KEY}: no key to sign models with: {error}") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise Untrusted(f"{folder / KEY}: not an Ed25519 key")
        return cls(key)

    def sign(self, model: Model, data: Dataset | None = None) -> SignedModel:
        """A model with a claim about it; data: those that it was made from, else its own word is taken for its domain.

        Raises:
            Untrusted: it claims to know more than was recorded.
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
        }
        words = json.dumps(claim, sort_keys=True).encode()
        return SignedModel(file, words, self._key.sign(CONTEXT + words))


@dataclass(frozen=True)
class TrustedSigners:
    """Whose models are taken: public keys, each with the robots that it may speak about."""

    signers: tuple[tuple[Ed25519PublicKey, tuple[str, ...]], ...] = ()

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Those in a folder of keys.

        Raises:
            Untrusted: a file there is none.
        """
        found = []
        for path in sorted((folder / SIGNERS).glob("*.json")):
            try:
                said = json.loads(path.read_bytes())
                key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(said["key"]))
                found.append((key, tuple(map(str, said["robots"]))))
            except (ValueError, KeyError, TypeError) as error:
                raise Untrusted(f"{path}: no signer's public key: {error!r}") from error
        return cls(tuple(found))

    def open(self, signed: SignedModel, robot: str | None = None) -> Model:
        """The model in a signed file; robot: what it is said to be for, by where it was published.

        Raises:
            Untrusted: nobody of these signed it, or it is not what was signed; BadModel: it is none.
        """
        robots = self._signer_of(signed)
        claim = _claim(signed)
        if hashlib.sha256(signed.file).hexdigest() != claim["sha256"]:
            raise Untrusted("the model's file is not the one that was signed")
        if ANY not in robots and claim["robot"] not in robots:
            raise Untrusted(f"who signed it may not speak about {claim['robot']}")
        if robot is not None and claim["robot"] != robot:
            raise Untrusted(f"a model of {claim['robot']} was published as one of {robot}")
        model = decode(signed.file)
        for name, value in (
            ("robot", model.robot.name),
            ("layout", model.robot.layout()),
            ("version", model.version),
        ):
            if claim[name] != value:
                raise Untrusted(f"its {name} is {value}, and {claim[name]} was signed")
        if isinstance(model, ModelSet):
            _within(model, np.array(claim["domain"], float))
        return model

    def load_model(self, path: Path) -> Model:
        """The model in a file with a seal beside it. Raises as `open`, naming the file."""
        try:
            return self.open(SignedModel.load(path))
        except Untrusted as error:
            raise Untrusted(f"{path}: {error}") from error

    def _signer_of(self, signed: SignedModel) -> tuple[str, ...]:
        """The robots that whoever signed it may speak about."""
        for key, robots in self.signers:
            try:
                key.verify(signed.signature, CONTEXT + signed.claim)
            except InvalidSignature:
                continue
            return robots
        raise Untrusted("nobody who is trusted signed the model")


def recorded_domain(data: Dataset) -> Array:
    """(2, regressor_dim): the smallest and largest [x_0; input in force] in the data."""
    known = windows(data, 1).z[:, : data.robot.regressor_dim]
    return np.stack([known.min(0), known.max(0)])


def write_signer(folder: Path, name: str = "certify", robots: tuple[str, ...] = (ANY,)) -> None:
    """A new key to sign with, and its public half among those that are trusted, if there is none yet."""
    if (folder / KEY).exists():
        return
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    write_secret(folder / KEY, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    said = {"key": public.hex(), "robots": list(robots)}
    write_atomically(folder / SIGNERS / f"{name}.json", json.dumps(said, indent=2).encode())


def _claim(signed: SignedModel) -> dict[str, Any]:
    """What was signed. Raises Untrusted."""
    try:
        claim = json.loads(signed.claim)
        return {name: claim[name] for name in ("robot", "layout", "version", "sha256", "domain")}
    except (ValueError, KeyError, TypeError) as error:
        raise Untrusted(f"the claim about the model can't be read: {error!r}") from error


def _within(model: ModelSet, recorded: Array) -> None:
    """Raises Untrusted for a model that claims to know more than was recorded."""
    if recorded.shape != model.domain.shape:
        raise Untrusted("the claim does not say what was recorded")
    if (model.domain[0] < recorded[0]).any() or (model.domain[1] > recorded[1]).any():
        raise Untrusted("the model claims a wider domain than was recorded")
