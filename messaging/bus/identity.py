"""Who a process is to the others: its certificate, from a folder of keys (messaging/bus/certificate_authority.py
makes one).
"""

from __future__ import annotations

from pathlib import Path

from brakeline.errors import BadKeys
from brakeline.messaging.topics import ROLES

SERVERS = ("safety", "launcher", "router")  # roles that may be a router; others' certificates are a client's only


def role_of(name: str) -> str:
    """What a process of that name is: the name up to its first hyphen or dot.

    Raises:
        ValueError: no such role.
    """
    role = name.split(".", 1)[0].split("-", 1)[0]
    if role not in ROLES:
        raise ValueError(f"{name!r} begins with no role; there are: {', '.join(ROLES)}")
    return role


def certified_name(source: str) -> str:
    """The name on the certificate of a process called `source`: one certificate serves NAME and all of NAME.MORE."""
    return source.split(".", 1)[0]


def certificate_file(folder: Path, name: str) -> Path:
    return folder / f"{name}.pem"


def key_file(folder: Path, name: str) -> Path:
    return folder / f"{name}.key"


def names_in(folder: Path) -> tuple[str, ...]:
    """Whom a router with these keys lets in.

    Raises:
        BadKeys: there is no list, or a name on it has no role.
    """
    try:
        names = tuple((folder / "names").read_text().split())
        for name in names:
            role_of(name)
    except (OSError, ValueError) as error:
        raise BadKeys(f"{folder / 'names'} is no list of whom to let in: {error}") from error
    return names


def tls(folder: Path, source: str, listens: bool) -> dict[str, object]:
    """Zenoh's settings for mutual TLS under the certificate of `source`: nobody without one of our authority's gets in,
    and nobody else is believed to be a router.

    Raises:
        BadKeys: a file is missing, or it listens with a certificate that is a client's only.
    """
    name = certified_name(source)
    try:
        role = role_of(name)
    except ValueError as error:
        raise BadKeys(f"no certificate can be had under that name: {error}") from error
    if listens and role not in SERVERS:
        raise BadKeys(f"a {role} cannot be a router: only {', '.join(SERVERS)} can; give it --connect")
    root, certificate, key = folder / "ca.pem", certificate_file(folder, name), key_file(folder, name)
    for path in (root, certificate, key):
        if not path.is_file():
            raise BadKeys(
                f"{path} is missing: no keys of {name} here; issue them with `brakeline keys {folder} {name}`"
            )
    return {
        "root_ca_certificate": str(root),
        "listen_certificate": str(certificate),
        "listen_private_key": str(key),
        "connect_certificate": str(certificate),
        "connect_private_key": str(key),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
