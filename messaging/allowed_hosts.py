"""Decide which HTTP requests may read a running system: those of programs, and of a page of this server itself.

A foreign web page can make a browser send requests to this machine. It can read the reply after DNS rebinding (the
`Host` header then has the foreign name), and it can always read a WebSocket (the `Origin` header then has the foreign
page).
"""

from __future__ import annotations

from collections.abc import Collection
from email.message import Message
from ipaddress import ip_address
from urllib.parse import urlsplit


def rejection_reason(headers: Message, hosts: Collection[str], port: int | None, origins: Collection[str] = ()) -> str:
    """Return why a request is rejected; empty if it is allowed.

    An allowed request names one of `hosts`, localhost or an IP address with `port`, and comes from a page of this
    server, from one of `origins`, or from a program that is no browser. Without `port`, any port is allowed.
    """
    named, sources = headers.get_all("Host") or [], headers.get_all("Origin") or []
    if len(named) != 1 or not _names_this_server(named[0], hosts, port):
        return f"{' and '.join(named)[:200] or 'no host'} is not this machine"
    if len(sources) > 1 or any(origin not in (f"http://{named[0]}", *origins) for origin in sources):
        return f"a page of {' and '.join(sources)[:200]} may not look"
    return ""


def _names_this_server(header: str, hosts: Collection[str], port: int | None) -> bool:
    """Return whether a `Host` header names this server."""
    try:
        place = urlsplit(f"//{header}")
        name, number = place.hostname or "", place.port or 80
    except ValueError:
        return False
    if place.path or place.username is not None or port not in (None, number):
        return False
    return name in ("localhost", *(host.lower() for host in hosts if host)) or _is_address(name)


def _is_address(name: str) -> bool:
    """Return whether a name is an IP address, which DNS rebinding cannot forge."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
