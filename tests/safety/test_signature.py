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

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from brakeline.deploy.data.data_paths import model_path
from brakeline.deploy.run.log_contents import attachments
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.run_models import newest_model
from brakeline.errors import BadModel, Untrusted
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import HEALTH, MODEL
from brakeline.safety.methods import archive_path, decode
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.service.server import ModelRegistry, SafetySettings, main
from brakeline.safety.service.signature import (
    CONTEXT,
    ModelSigner,
    SignedModel,
    TrustedSigners,
    recorded_domain,
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


def resigned(keys: Path, signed: SignedModel, **changes: object) -> SignedModel:
    """Return the model with a changed claim that a trusted key signed."""
    claim = json.dumps(json.loads(signed.claim) | changes, sort_keys=True).encode()
    key = load_pem_private_key((keys / "signer.key").read_bytes(), None)
    assert isinstance(key, Ed25519PrivateKey)
    return replace(signed, claim=claim, signature=key.sign(CONTEXT + claim))


def shrunken(model: ModelSet) -> ModelSet:
    """Return a forged model set: sets a tenth as wide, and a matching hash."""
    steps = tuple(ErrorBound(s.C, s.W, 0.1 * s.M, 0.1 * s.kappa, 0.1 * s.w, s.generators) for s in model.steps)
    return replace(model, steps=steps)


def test_a_signed_model_is_accepted(model: ModelSet, keys: Path, tmp_path: Path) -> None:
    signed = ModelSigner.load(keys).sign(model)
    assert TrustedSigners.load(keys).open(signed, "ground").version == model.version
    path = tmp_path / "model.safetensors"
    signed.save(path)
    assert TrustedSigners.load(keys).load_model(path).version == model.version
    assert SignedModel.load(path) == signed
    assert (keys / "signer.key").stat().st_mode & 0o077 == 0


def test_a_matching_hash_without_a_signature_is_refused(model: ModelSet, keys: Path) -> None:
    signed, trust = ModelSigner.load(keys).sign(model), TrustedSigners.load(keys)
    evil = shrunken(model)
    assert ModelSet.decode(evil.encode()).version == evil.version, "its own hash is right"
    with pytest.raises(Untrusted, match="not the one that was signed"):
        trust.open(replace(signed, file=evil.encode()), "ground")
    claim = json.loads(signed.claim) | {"version": evil.version}
    with pytest.raises(Untrusted, match="no trusted signer"):
        trust.open(replace(signed, file=evil.encode(), claim=json.dumps(claim).encode()), "ground")
    with pytest.raises(Untrusted, match="no trusted signer"):
        trust.open(SignedModel(evil.encode(), b"", b""), "ground")
    write_signer(keys.parent / "rogue")
    with pytest.raises(Untrusted, match="no trusted signer"):
        trust.open(ModelSigner.load(keys.parent / "rogue").sign(evil), "ground")
    assert TrustedSigners().signers == ()
    with pytest.raises(Untrusted):
        TrustedSigners().open(signed, "ground")


def test_a_model_must_be_of_the_robot_that_topic_and_key_name(model: ModelSet, tmp_path: Path) -> None:
    write_signer(tmp_path / "any")
    signed = ModelSigner.load(tmp_path / "any").sign(model)
    with pytest.raises(Untrusted, match="published as one of quadrotor"):
        TrustedSigners.load(tmp_path / "any").open(signed, "quadrotor")
    write_signer(tmp_path / "other", robots=("quadrotor",))
    with pytest.raises(Untrusted, match="may not sign models of ground"):
        TrustedSigners.load(tmp_path / "other").open(ModelSigner.load(tmp_path / "other").sign(model), "ground")


@pytest.mark.parametrize("field", ["robot", "layout", "version", "domain", "no domain"])
def test_the_claim_must_match_the_file(model: ModelSet, keys: Path, field: str) -> None:
    """Even if a trusted key signed the claim: the file must agree with each entry."""
    signed, trust = ModelSigner.load(keys).sign(model), TrustedSigners.load(keys)
    domain = {"domain": (0.5 * model.domain).tolist()} if field == "domain" else {"domain": None}
    with pytest.raises(Untrusted):
        trust.open(resigned(keys, signed, **(domain if "domain" in field else {field: "quadrotor"})))
    assert trust.open(resigned(keys, signed))


def test_a_domain_wider_than_the_data_is_not_signed(model: ModelSet, data, keys: Path) -> None:
    signer, recorded = ModelSigner.load(keys), recorded_domain(data)
    assert (model.domain[0] >= recorded[0]).all() and (model.domain[1] <= recorded[1]).all()
    assert TrustedSigners.load(keys).open(signer.sign(model, data))
    wider = replace(model, domain=np.stack([recorded[0], recorded[1] + 0.1]))
    with pytest.raises(Untrusted, match="wider"):
        signer.sign(wider, data)


def test_a_restart_uses_the_newest_signed_model(model: ModelSet, keys: Path, tmp_path: Path) -> None:
    trust, evil = TrustedSigners.load(keys), shrunken(model)
    good, bad = (archive_path(tmp_path, "ground", m.version) for m in (model, evil))
    ModelSigner.load(keys).sign(model).save(good)
    evil.save(bad)
    assert newest_model(tmp_path, "ground", trust) == good
    seal_of(bad).write_bytes(seal_of(good).read_bytes())
    assert newest_model(tmp_path, "ground", trust) == good


def test_the_times_of_files_and_a_clock_set_back_bring_no_older_model_into_use(
    model: ModelSet, models: dict[tuple[str, str], ModelSet], keys: Path, tmp_path: Path, monkeypatch
) -> None:
    older, newer = model, models["set-membership", "direct"]
    signer, trust = ModelSigner.load(keys), TrustedSigners.load(keys)
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


def test_a_key_in_a_folder_that_cannot_be_written_still_signs_in_order(model, keys, monkeypatch, caplog) -> None:
    signer, trust = ModelSigner.load(keys), TrustedSigners.load(keys)

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
    model: ModelSet, models: dict[tuple[str, str], ModelSet], tmp_path: Path
) -> None:
    registry = ModelRegistry(tmp_path, accept_bound=1.0)
    for m in (model, models["set-membership", "direct"]):
        registry.install(m)
    os.utime(archive_path(tmp_path, "ground", model.version), (4e9, 4e9))
    last = archive_path(tmp_path, "ground", models["set-membership", "direct"].version)
    assert newest_model(tmp_path, "ground", None) == last
    for damage in (b"", b"\xff", b"../x", model.version.encode() + b"0"):
        (last.parent / "in_use").write_bytes(damage)
        assert newest_model(tmp_path, "ground", None) is None, "then the model that the run began with"


def test_a_dangling_link_in_the_archive_is_named_and_nothing_ends(model, keys, tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    model.save(model_path(model.robot, ModelConfig()))
    path = archive_path(tmp_path, "ground", model.version)
    ModelSigner.load(keys).sign(model).save(path)
    gone = path.with_name("000000000000.safetensors")
    gone.symlink_to(tmp_path / "nothing")
    assert newest_model(tmp_path, "ground", TrustedSigners.load(keys)) == path
    files = attachments(RunConfig(model_config=ModelConfig()), tmp_path)
    assert any(model.version in name for name in files)
    named = [record.getMessage() for record in caplog.records if gone.name in record.getMessage()]
    assert len(named) == 2


@pytest.mark.parametrize("domain", [float("nan"), float("inf"), "1", [[1.0], [1.0, 2.0]], {}, 10**400])
def test_no_domain_passes_that_is_none(model: ModelSet, keys: Path, domain: object) -> None:
    signed = ModelSigner.load(keys).sign(model)
    stated = np.full(model.domain.shape, domain).tolist() if isinstance(domain, float) else domain
    if domain == float("inf"):
        stated[0] = (-np.array(stated[0])).tolist()
        assert TrustedSigners.load(keys).open(resigned(keys, signed, domain=stated)), "it is wider than any"
        return
    with pytest.raises(Untrusted, match="domain"):
        TrustedSigners.load(keys).open(resigned(keys, signed, domain=stated))


DEEP = b'{"a":' * 200_000


def test_whatever_is_signed_a_reading_error_is_ours(model: ModelSet, keys: Path, tmp_path: Path) -> None:
    trust, signed = TrustedSigners.load(keys), ModelSigner.load(keys).sign(model)
    key = load_pem_private_key((keys / "signer.key").read_bytes(), None)
    assert isinstance(key, Ed25519PrivateKey)
    deep = len(DEEP).to_bytes(8, "little") + DEEP
    for file in (deep, b"", b"\xff" * 9, signed.file[:-1]):
        with pytest.raises(BadModel):
            trust.open(resigned(keys, replace(signed, file=file), sha256=hashlib.sha256(file).hexdigest()))
    for claim in (DEEP, b"[]", b"5", b"\xff", b'{"number": 1}'):
        with pytest.raises(Untrusted):
            trust.open(SignedModel(signed.file, claim, key.sign(CONTEXT + claim)))
    for number in (-1, 2**63, True, "1", 1.5, None):
        with pytest.raises(Untrusted, match="number"):
            trust.open(resigned(keys, signed, number=number))
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


def test_a_full_disk_or_a_kill_in_a_write_to_the_archive_leaves_a_whole_model_or_none(model, keys, tmp_path) -> None:
    trust, signer = TrustedSigners.load(keys), ModelSigner.load(keys)
    for error in (Died, full):
        for at in itertools.count():
            archive = tmp_path / f"{error.__name__}{at}"
            registry = ModelRegistry(archive, accept_bound=1.0)
            signed = signer.sign(model)
            with failing(archive, at, error) as disk, suppress(Died):
                registry.install(model, signed, trust.number(signed))
            if len(disk.seen) <= at:
                break
            path = newest_model(archive, "ground", trust)
            assert path is None or trust.load_model(path).version == model.version
            assert error is Died or registry.filters["ground"].version == model.version, "the service goes on"


SERVICE = """
import sys
from pathlib import Path
from brakeline.messaging.bus import BusSettings
from brakeline.safety.service.server import SafetySettings, main
endpoint, keys, model, archive = sys.argv[1:]
bus = BusSettings(connect=(endpoint,), keys=Path(keys))
main(SafetySettings(bus, (Path(model),), Path(archive), accept_bound=1.0))
"""


def test_a_service_accepts_only_signed_models_over_the_bus(
    model: ModelSet, models: dict[tuple[str, str], ModelSet], tmp_path: Path
) -> None:
    """A certificate of `certify` gets a message through; what is in it has to be signed all the same."""
    keys, archive = keyring(tmp_path / "keys"), tmp_path / "archive"
    write_signer(keys)
    path, newer, evil = tmp_path / "model.safetensors", models["set-membership", "direct"], shrunken(model)
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
                rest = {"robot": "ground", "version": evil.version}
                publisher.put(pb.Model(file=evil.encode(), **rest))
                signed = ModelSigner.load(keys).sign(model)
                publisher.put(pb.Model(file=evil.encode(), claim=signed.claim, signature=signed.signature, **rest))
                signed = ModelSigner.load(keys).sign(newer)
                fields = {"claim": signed.claim, "signature": signed.signature}
                publisher.put(pb.Model(robot="ground", version=newer.version, file=signed.file, **fields))
                until(lambda: notes.get("model ground") == newer.version)
        finally:
            service.terminate()
            service.wait(20.0)
    archived = {path.stem for path in archive_path(archive, "ground", "*").parent.glob("*.safetensors")}
    assert archived == {model.version, newer.version}, "the archive holds no refused model"
    assert newest_model(archive, "ground", TrustedSigners.load(keys)) == archive_path(archive, "ground", newer.version)


def test_with_keys_a_models_file_must_be_signed_too(model: ModelSet, tmp_path: Path) -> None:
    keys, endpoint = keyring(tmp_path / "keys"), free_endpoint("tls")
    write_signer(keys)
    unsigned = tmp_path / "unsigned.safetensors"
    model.save(unsigned)
    with pytest.raises(Untrusted, match="no seal"):
        main(SafetySettings(BusSettings(listen=(endpoint,), keys=keys), (unsigned,)))
