"""Make the keys of a run on one machine, in the run's folder, and sign the models that the run starts with."""

from __future__ import annotations

from pathlib import Path

from brakeline.deploy.run.processes import process_specs
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.run_models import model_in_run
from brakeline.errors import Untrusted
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.methods import Model, archive_path, load
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, RECURSION, ModelSet
from brakeline.safety.service.plan_token import write_key
from brakeline.safety.service.signature import KEY, ModelSigner, TrustedSigners, write_signer

KEYS = "keys"  # folder in the run's folder
OTHER_ROLES = ("launcher", "viewer", "client", "certify")  # that may join the bus, besides the run's processes
NO_KEYS = ("autopilot", "certifier")  # kinds of processes: not on the bus; on it with the keys of `certify`


def make_run_keys(config: RunConfig, folder: Path) -> Path:
    """Return the folder of the run's keys. Makes the keys, unless a resumed run has them already."""
    keys = folder / KEYS
    authority = Authority(keys)
    for name in (*OTHER_ROLES, *(spec.name for spec in process_specs(config) if spec.kind not in NO_KEYS)):
        authority.issue(name)
    write_signer(keys)
    write_key(keys)
    return keys


def sign_models(config: RunConfig, folder: Path, keys: Path) -> None:
    """Sign the models that the run starts with, and save them in the run's archive.

    If the signing key is elsewhere, this does nothing: the models must have signatures already.
    """
    if not (keys / KEY).exists():
        return
    signer, trust = ModelSigner.load(keys), TrustedSigners.load(keys)
    for name in config.robots if config.filtered else ():
        model = load(model_in_run(config, folder, robot_maybe_with_task(name)))
        archived = archive_path(folder, model.robot.name, model.version)
        try:
            trust.load_model(archived)
        except Untrusted:  # it has no seal yet, or not a whole one
            signer.sign(model).save(archived)


def check_signer(keys: Path | None) -> None:
    """Check that the certifier of a run or of a safety service can sign model sets.

    Raises:
        Untrusted: there are no keys, or not the one that signs.
    """
    if keys is None:
        raise Untrusted("--adapt needs keys: a safety service takes no model set over a bus without keys")
    ModelSigner.load(keys)


def check_adaptable(model: Model) -> None:
    """Check that a model set states boxes of positions for whole plans, with which new ones can be compared.

    Raises ValueError.
    """
    if not model.robot.position_dim:
        raise ValueError(f"--adapt compares sets of positions, and {model.robot.name} has none: certify it by hand")
    if not isinstance(model, ModelSet) or model.model_config.mode == RECURSION:
        raise ValueError(
            f"--adapt needs a model set of mode {ONE_STEP} or {DIRECT}, for {model.robot.name} another one is in use: "
            f"give --mode {ONE_STEP}, or certify with `brakeline certify {model.robot.kind} --use`"
        )
