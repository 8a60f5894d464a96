"""The keys of a run that makes its own, for one machine and one user, in the run's folder; and the models that it
starts with, signed."""

from __future__ import annotations

import logging
from pathlib import Path

from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.run.processes import places
from brakeline.deploy.run.run_config import RunConfig
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.methods import load
from brakeline.safety.model.model_set import BadModel
from brakeline.safety.service.plan_token import write_key
from brakeline.safety.service.server import archive_path
from brakeline.safety.service.signature import KEY, ModelSigner, TrustedSigners, seal_of, write_signer

log = logging.getLogger("brakeline.launcher")

KEYS = "keys"  # under the run's folder
OTHERS = ("launcher", "viewer", "client", "certify")  # who may join in, besides the run's processes


def own_keys(config: RunConfig, folder: Path) -> Path:
    """The folder of the run's keys, made if there is none; a run that goes on has the same: they signed its models."""
    keys = folder / KEYS
    authority = Authority(keys)
    for name in (*OTHERS, *(place.name for place in places(config) if place.kind != "autopilot")):
        authority.issue(name)
    write_signer(keys)
    write_key(keys)
    return keys


def seal_models(config: RunConfig, folder: Path, keys: Path) -> None:
    """Whoever can certify signs the models that the run is to start with, in the run's archive.

    Where the key to sign with is elsewhere, the models have to bring their seals along.
    """
    if not (keys / KEY).exists():
        return
    signer = ModelSigner.load(keys)
    for name in config.robots if config.filtered else ():
        model = load(method_path(robot_maybe_with_task(name), config.method, config.model_config))
        archived = archive_path(folder, model.robot.name, model.version)
        if not seal_of(archived).exists():
            signer.sign(model).save(archived)


def newest_model(folder: Path, robot: str, trust: TrustedSigners | None) -> Path | None:
    """The version that a service of this run used last: a restarted one goes on with it.

    trust: with keys, whoever may have signed it; others' versions are passed over.
    """
    versions = archive_path(folder, robot, "*")
    newest = sorted(versions.parent.glob(versions.name), key=lambda path: path.stat().st_mtime_ns, reverse=True)
    for path in newest:
        try:
            if trust is not None:
                trust.load_model(path)
        except BadModel as error:
            log.warning("not used: %s", error)
            continue
        return path
    return None
