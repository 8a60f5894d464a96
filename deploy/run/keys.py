"""The keys of a run that makes its own: for one machine and one user, in the run's folder."""

from __future__ import annotations

from pathlib import Path

from deploy.run.configurations import RunConfig
from deploy.run.places import places
from messaging.bus.authority import Authority

KEYS = "keys"  # under the run's folder
OTHERS = ("launcher", "viewer", "client", "certify")  # who may join in, besides the run's processes


def own_keys(config: RunConfig, folder: Path) -> Path:
    """The folder of the run's keys, made if there is none; a run that goes on has the same: they signed its models."""
    keys = folder / KEYS
    authority = Authority(keys)
    for name in (*OTHERS, *(place.name for place in places(config) if place.kind != "autopilot")):
        authority.issue(name)
    return keys
