"""Keys of an authority, made in a moment, for tests."""

from pathlib import Path

from brakeline.messaging.bus.certificate_authority import Authority

NAMES = (
    *("launcher", "safety", "safety-1", "learner", "actor-0", "actor-1", "recorder", "certify", "viewer", "client"),
    *("feeder", "router"),
)


def keyring(folder: Path, *names: str) -> Path:
    """A folder with keys of these names, or of all roles."""
    authority = Authority(folder)
    for name in names or NAMES:
        authority.issue(name)
    return folder
