"""A service accepts only models that a trusted signer signed for their robot."""

import errno
import hashlib
import itertools
import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from brakeline.deploy.data.data_paths import model_path
from brakeline.deploy.run.log_contents import attachments
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.run_models import newest_model, signed_last
from brakeline.errors import BadModel, Untrusted
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import HEALTH, MODEL
from brakeline.safety.methods import archive_path, decode
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.model_config import AUTO
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.windows import recorded_domain
from brakeline.safety.service.server import ModelRegistry
from brakeline.safety.service.signature import (
    CONTEXT,
    ModelSigner,
    SignedModel,
    TrustedSigners,
    seal_of,
    write_signer,
)
from tests.faults.failing_calls import Died, failing, full
from tests.messaging.keyring import keyring
from tests.waiting import until


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    write_signer(tmp_path / "keys")
    return tmp_path / "keys"


@pytest.fixture
def trust(keys: Path) -> TrustedSigners:
    return TrustedSigners.load(keys)


@pytest.fixture
def signed(model: ModelSet, keys: Path) -> SignedModel:
    return ModelSigner.load(keys).sign(model)


@pytest.fixture
def newer(model: ModelSet) -> ModelSet:
    return replace(model, stands=3)


def claimed(keys: Path, file: bytes, claim: bytes) -> SignedModel:
    key = load_pem_private_key((keys / "signer.key").read_bytes(), None)
    assert isinstance(key, Ed25519PrivateKey)
    return SignedModel(file, claim, key.sign(CONTEXT + claim))


def resigned(keys: Path, signed: SignedModel, **changes: object) -> SignedModel:
    """Return the model with a changed claim that a trusted key signed."""
    return claimed(keys, signed.file, json.dumps(json.loads(signed.claim) | changes, sort_keys=True).encode())


def shrunken(model: ModelSet) -> ModelSet:
    """Return a forged model set: sets a tenth as wide, and a matching hash."""
    steps = tuple(ErrorBound(s.C, s.W, 0.1 * s.M, 0.1 * s.kappa, 0.1 * s.w, s.generators) for s in model.steps)
    return replace(model, steps=steps)


def test_a_signed_model_is_accepted(model: ModelSet, signed: SignedModel, trust, keys: Path, tmp_path: Path) -> None:
    assert trust.open(signed, "ground").version == model.version
    path = tmp_path / "model.safetensors"
    signed.save(path)
    assert trust.load_model(path).version == model.version
    assert SignedModel.load(path) == signed
    assert (keys / "signer.key").stat().st_mode & 0o077 == 0


def test_a_matching_hash_without_a_signature_is_refused(model: ModelSet, signed: SignedModel, trust, keys) -> None:
    evil = shrunken(model)
    assert ModelSet.decode(evil.encode()).version == evil.version, "its own hash is right"
    with pytest.raises(Untrusted, match="not the one that was signed"):
        trust.open(replace(signed, file=evil.encode()), "ground")
    claim = json.dumps(json.loads(signed.claim) | {"version": evil.version}).encode()
    write_signer(keys.parent / "rogue")
    for forged in (
        replace(signed, file=evil.encode(), claim=claim),
        SignedModel(evil.encode(), b"", b""),
        ModelSigner.load(keys.parent / "rogue").sign(evil),
    ):
        with pytest.raises(Untrusted, match="no trusted signer"):
            trust.open(forged, "ground")
    with pytest.raises(Untrusted, match="no trusted signer"):
        TrustedSigners().open(signed, "ground")


def test_a_model_must_be_of_the_robot_that_topic_and_key_name(model: ModelSet, signed, trust, tmp_path: Path) -> None:
    with pytest.raises(Untrusted, match="published as one of quadrotor"):
        trust.open(signed, "quadrotor")
    write_signer(tmp_path / "other", robots=("quadrotor",))
    with pytest.raises(Untrusted, match="may not sign models of ground"):
        TrustedSigners.load(tmp_path / "other").open(ModelSigner.load(tmp_path / "other").sign(model), "ground")


def test_the_claim_must_match_the_file(model: ModelSet, signed: SignedModel, trust, keys: Path) -> None:
    """Even if a trusted key signed the claim: the file must agree with each entry."""
    nothing, narrower = np.full(model.domain.shape, np.nan).tolist(), (0.5 * model.domain).tolist()
    wrong: dict[str, list[Any]] = {name: ["quadrotor"] for name in ("robot", "layout", "version")} | {
        "domain": [nothing, narrower, None, "1", [[1.0], [1.0, 2.0]], {}, 10**400],
        "number": [-1, 2**63, True, "1", 1.5, None],
    }
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(Untrusted, match=name):
                trust.open(resigned(keys, signed, **{name: value}))
    wider = np.full(model.domain.shape, [[-np.inf], [np.inf]]).tolist()
    assert trust.open(resigned(keys, signed)) and trust.open(resigned(keys, signed, domain=wider))


def test_a_domain_wider_than_the_data_is_not_signed(model: ModelSet, data, trust, keys: Path) -> None:
    signer, recorded = ModelSigner.load(keys), recorded_domain(data)
    assert (model.domain[0] >= recorded[0]).all() and (model.domain[1] <= recorded[1]).all()
    assert trust.open(signer.sign(model, data))
    wider = replace(model, domain=np.stack([recorded[0], recorded[1] + 0.1]))
    with pytest.raises(Untrusted, match="wider"):
        signer.sign(wider, data)


def test_a_restart_uses_the_newest_signed_model(model: ModelSet, signed, trust, tmp_path: Path) -> None:
    evil = shrunken(model)
    good, bad = (archive_path(tmp_path, "ground", m.version) for m in (model, evil))
    signed.save(good)
    evil.save(bad)
    assert newest_model(tmp_path, "ground", trust) == good
    seal_of(bad).write_bytes(seal_of(good).read_bytes())
    assert newest_model(tmp_path, "ground", trust) == good


def test_a_restarted_service_goes_on_with_a_set_that_it_was_sent_after_the_one_in_use(
    model: ModelSet, newer: ModelSet, trust, keys: Path, tmp_path: Path
) -> None:
    """It began with the older one again: an adapted set was lost, and two replicas had two versions."""
    signer, in_use, archive = ModelSigner.load(keys), tmp_path / "in_use.safetensors", tmp_path / "archive"
    sent = archive_path(archive, "ground", newer.version)

    def chosen(mode: str = AUTO) -> Path:
        return signed_last(in_use, archive, "ground", trust, mode)

    signer.sign(model).save(in_use)
    assert chosen() == in_use
    signer.sign(newer).save(sent)
    assert chosen() == chosen(newer.model_config.mode) == sent and chosen("recursion") == in_use
    signer.sign(model).save(in_use)  # put to use again
    assert chosen() == in_use
    seal_of(in_use).unlink()
    with pytest.raises(Untrusted, match="no seal"):
        chosen()


def test_the_times_of_files_and_a_clock_set_back_bring_no_older_model_into_use(
    model: ModelSet, newer: ModelSet, trust, keys: Path, tmp_path: Path, monkeypatch
) -> None:
    older, signer = model, ModelSigner.load(keys)
    paths = [archive_path(tmp_path, "ground", m.version) for m in (older, newer)]
    signer.sign(older).save(paths[0])
    monkeypatch.setattr(time, "time_ns", lambda: 1)
    signed = signer.sign(newer)
    signed.save(paths[1])
    for path, at in zip(paths, (4e9, 1e9), strict=True):
        os.utime(path, (at, at))
    assert newest_model(tmp_path, "ground", trust) == paths[1]
    registry = ModelRegistry(accept_bound=1.0)
    registry.install(newer, signed, trust.number(signed))
    old = SignedModel.load(paths[0])
    with pytest.raises(BadModel, match=r"signed before the model in use.*--sign"):
        registry.install(older, old, trust.number(old))
    assert registry.filters["ground"].version == newer.version
    again = signer.sign(older)  # on purpose
    registry.install(older, again, trust.number(again))
    assert registry.filters["ground"].version == older.version


def test_a_key_in_a_folder_that_cannot_be_written_still_signs_in_order(model, trust, keys, monkeypatch, caplog) -> None:
    signer = ModelSigner.load(keys)

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("brakeline.safety.service.signature.write_atomically", read_only)
    monkeypatch.setattr(time, "time_ns", lambda: 10**18)
    first, second = (trust.number(signer.sign(model)) for _ in range(2))
    assert second > first and "Read-only file system" in caplog.text
    (keys / "signer.last").write_text("x")
    with pytest.raises(Untrusted, match=r"signer\.last: damaged"):
        signer.sign(model)


def test_without_keys_a_restart_uses_the_model_that_a_service_used_last(
    model: ModelSet, newer: ModelSet, tmp_path: Path
) -> None:
    registry = ModelRegistry(tmp_path, accept_bound=1.0)
    for m in (model, newer):
        registry.install(m)
    os.utime(archive_path(tmp_path, "ground", model.version), (4e9, 4e9))
    last = archive_path(tmp_path, "ground", newer.version)
    assert newest_model(tmp_path, "ground", None) == last
    for damage in (b"", b"\xff", b"../x", model.version.encode() + b"0"):
        (last.parent / "in_use").write_bytes(damage)
        assert newest_model(tmp_path, "ground", None) is None, "then the model that the run began with"


def test_a_dangling_link_in_the_archive_is_named_and_nothing_ends(
    model, signed, trust, tmp_path, monkeypatch, caplog
) -> None:
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    model.save(model_path(model.robot, ModelConfig()))
    path = archive_path(tmp_path, "ground", model.version)
    signed.save(path)
    gone = path.with_name("000000000000.safetensors")
    gone.symlink_to(tmp_path / "nothing")
    assert newest_model(tmp_path, "ground", trust) == path
    files = attachments(RunConfig(model_config=ModelConfig()), tmp_path)
    assert any(model.version in name for name in files)
    named = [record.getMessage() for record in caplog.records if gone.name in record.getMessage()]
    assert len(named) == 2


DEEP = b'{"a":' * 200_000


def test_whatever_is_signed_a_reading_error_is_ours(signed: SignedModel, trust, keys: Path, tmp_path: Path) -> None:
    deep = len(DEEP).to_bytes(8, "little") + DEEP
    for file in (deep, b"", b"\xff" * 9, signed.file[:-1]):
        with pytest.raises(BadModel):
            trust.open(resigned(keys, replace(signed, file=file), sha256=hashlib.sha256(file).hexdigest()))
    for claim in (DEEP, b"[]", b"5", b"\xff", b'{"number": 1}'):
        with pytest.raises(Untrusted):
            trust.open(claimed(keys, signed.file, claim))
    path = tmp_path / "model.safetensors"
    signed.save(path)
    for seal in (DEEP, b"[]", b"{}", b'{"claim": 1, "signature": 1}'):
        seal_of(path).write_bytes(seal)
        with pytest.raises(Untrusted):
            trust.load_model(path)
    (keys / "signers" / "gone.json").symlink_to(tmp_path / "nothing")
    with pytest.raises(Untrusted, match=r"gone\.json"):
        TrustedSigners.load(keys)


def test_metadata_of_any_type_in_a_model_file_is_a_bad_model(model: ModelSet) -> None:
    payload, random = model.encode(), Random(0)
    size = int.from_bytes(payload[:8], "little")
    header = json.loads(payload[8 : 8 + size])
    about = json.loads(header["__metadata__"]["model_set"])
    values = (None, 5, -1, 1e999, float("nan"), "x", [], {}, [[]], {"a": [1]}, 10**30, DEEP.decode())
    for name in about:
        for value in values:
            header["__metadata__"]["model_set"] = json.dumps(about | {name: value})
            words = json.dumps(header).encode()
            with suppress(BadModel):
                decode(len(words).to_bytes(8, "little") + words + payload[8 + size :])
    for _ in range(200):
        place = random.randrange(size)
        with pytest.raises(BadModel):
            decode(payload[:place] + bytes([payload[place] ^ 1 << random.randrange(8)]) + payload[place + 1 : -1])


def test_a_full_disk_or_a_kill_in_a_write_to_the_archive_leaves_a_whole_model_or_none(
    model, signed, trust, tmp_path
) -> None:
    for error in (Died, full):
        for at in itertools.count():
            archive = tmp_path / f"{error.__name__}{at}"
            registry = ModelRegistry(archive, accept_bound=1.0)
            with failing(archive, at, error) as disk, suppress(Died):
                registry.install(model, signed, trust.number(signed))
            if len(disk.seen) <= at:
                break
            path = newest_model(archive, "ground", trust)
            assert path is None or trust.load_model(path).version == model.version
            assert error is Died or registry.filters["ground"].version == model.version, "the service goes on"


def test_a_signer_whose_private_key_is_kept_elsewhere_stays_the_trusted_one(signed, keys: Path) -> None:
    """Another certificate by `brakeline keys` made a new signer in its place: services refused the models in use."""
    private = (keys / "signer.key").read_bytes()
    (keys / "signer.key").unlink()
    write_signer(keys)
    assert not (keys / "signer.key").exists() and TrustedSigners.load(keys).open(signed)
    (keys / "signer.key").write_bytes(private)
    (keys / "signers" / "certify.json").unlink()  # the process ended between the two files
    write_signer(keys)
    assert (keys / "signer.key").read_bytes() == private and TrustedSigners.load(keys).open(signed)


SERVICE = """
import sys
from pathlib import Path
from brakeline.messaging.bus import BusSettings
from brakeline.safety.service.server import SafetySettings, main
endpoint, keys, model, archive = sys.argv[1:]
bus = BusSettings(connect=(endpoint,), keys=Path(keys))
main(SafetySettings(bus, (Path(model),), Path(archive), accept_bound=1.0))
"""


def test_a_service_accepts_only_signed_models_over_the_bus(model: ModelSet, newer: ModelSet, tmp_path: Path) -> None:
    """A certificate of `certify` gets a message through; what is in it has to be signed all the same."""
    keys, archive = keyring(tmp_path / "keys"), tmp_path / "archive"
    write_signer(keys)
    path, evil = tmp_path / "model.safetensors", shrunken(model)
    ModelSigner.load(keys).sign(model).save(path)
    endpoint, notes = free_endpoint("tls"), dict[str, str]()
    settings = BusSettings(connect=(endpoint,), keys=keys)
    with Bus(BusSettings(listen=(endpoint,), keys=keys), "launcher") as router:
        router.subscribe(HEALTH, lambda sample: notes.update(sample.message().notes))
        words = [sys.executable, "-c", SERVICE, endpoint, keys, path, archive]
        service = subprocess.Popen([str(word) for word in words], stderr=subprocess.DEVNULL)
        try:
            until(lambda: notes.get("model ground") == model.version)
            with Bus(settings, "certify") as certify:
                publisher = certify.publisher(MODEL, robot="ground")
                for file, claims in ((evil, None), (evil, model), (newer, newer)):
                    seal = {}
                    if claims is not None:
                        signed = ModelSigner.load(keys).sign(claims)
                        seal = {"claim": signed.claim, "signature": signed.signature}
                    publisher.put(pb.Model(robot="ground", version=file.version, file=file.encode(), **seal))
                until(lambda: notes.get("model ground") == newer.version)
        finally:
            service.terminate()
            service.wait(20.0)
    archived = {path.stem for path in archive_path(archive, "ground", "*").parent.glob("*.safetensors")}
    assert archived == {model.version, newer.version}, "the archive holds no refused model"
    assert newest_model(archive, "ground", TrustedSigners.load(keys)) == archive_path(archive, "ground", newer.version)
