"""The identity of a process: its name, role and certificate in a folder of keys (`certificate_authority`)."""

from __future__ import annotations

import secrets
from pathlib import Path
from shlex import quote

from brakeline.errors import BadKeys
from brakeline.messaging.message_checks import NAME
from brakeline.messaging.topics import ROLES

SERVERS = ("safety", "launcher", "router")  # roles that may be routers; other certificates are for clients only


def role_of(name: str) -> str:
    """Return the role of a process: its name up to the first hyphen or dot.

    Raises:
        ValueError: there is no such role, or the name cannot be part of a key.
    """
    role = name.split(".", 1)[0].split("-", 1)[0]
    if role not in ROLES:
        raise ValueError(f"{name!r} begins with no role; there are: {', '.join(ROLES)}")
    if not NAME.fullmatch(name):  # a wildcard would speak for others, and a slash is a place elsewhere
        raise ValueError(f"{name!r} cannot be the name of a process: letters, digits, '_', '.' and '-' only")
    return role


def role_on_certificate(name: str) -> str:
    """Return the role of the holder of a certificate with this name.

    Raises:
        ValueError: as `role_of`, or the name has a dot: no process would look for that certificate.
    """
    if (holder := certified_name(name)) != name:
        raise ValueError(f"{name!r}: a certificate's name has no dot; that of {holder!r} serves all {holder}.MORE")
    return role_of(name)


def certified_name(source: str) -> str:
    """Return the name on the certificate of a process: one certificate serves NAME and all NAME.MORE."""
    return source.split(".", 1)[0]


def distinct_name(name: str) -> str:
    """Return a name of its own for a process that may share the name of a role with others; other names stay.

    Otherwise, a service would take the processes for one: it answers the askers in turn, and keeps few queries of each.
    """
    return f"{name}.{secrets.token_hex(4)}" if name in ROLES else name


def identity_of(source: str) -> str:
    """Return who answers for what a source sends: the holder of the certificate NAME, for all NAME.MORE.

    Several processes may share the certificate of a whole role, such as the actors `actor.POD`. Each one then counts
    for itself, although the certificate does not tell them apart.
    """
    name, _, more = source.partition(".")
    return f"{name}.{more.partition('.')[0]}" if more and name in ROLES else name


def speaks_for(owner: str, name: str) -> bool:
    """Return whether a process may speak under a name: its own, or one that begins with it and a dot."""
    return name == owner or name.startswith(f"{owner}.")


def certificate_file(folder: Path, name: str) -> Path:
    """Return the path of a certificate."""
    return folder / f"{name}.pem"


def key_file(folder: Path, name: str) -> Path:
    """Return the path of a key."""
    return folder / f"{name}.key"


def names_in(folder: Path) -> tuple[str, ...]:
    """Return the names that a router with these keys accepts.

    Raises:
        BadKeys: there is no list, or a name on it has no role.
    """
    try:
        names = tuple((folder / "names").read_text().split())
        for name in names:
            role_of(name)
    except (OSError, ValueError) as error:
        raise BadKeys(f"{folder / 'names'} is no list of the names to accept: {error}") from error
    return names


def tls(folder: Path, source: str, listens: bool) -> dict[str, object]:
    """Return Zenoh's settings for mutual TLS: both ends of a link need a certificate of the authority.

    Args:
        folder: the keys.
        source: name of the process.
        listens: whether the process is a router.

    Raises:
        BadKeys: a file is missing, or a router has a certificate for clients only.
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
                f"{path} is missing: no keys of {name} here; issue them with "
                f"`brakeline keys {quote(str(folder))} {name}`"
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
