"""Decide which browser requests may read a running system: only those of the live page itself.

A foreign web page can make a browser send requests to this machine. It can read the reply after DNS rebinding (the
`Host` header then has the foreign name), and it can always read a WebSocket (the `Origin` header then has the foreign
page).
"""

from __future__ import annotations

from collections.abc import Collection
from email.message import Message
from ipaddress import ip_address
from urllib.parse import urlsplit


def rejection_reason(headers: Message, host: str, port: int, origins: Collection[str] = ()) -> str:
    """Return why a request is rejected; empty if it is allowed.

    An allowed request names `host`, localhost or an IP address with `port`, and comes from a page of this server, from
    one of `origins`, or from a program that is no browser.
    """
    hosts, sources = headers.get_all("Host") or [], headers.get_all("Origin") or []
    if len(hosts) != 1 or not _names_this_server(hosts[0], host, port):
        return f"{' and '.join(hosts)[:200] or 'no host'} is not this machine"
    if len(sources) > 1 or any(origin not in (f"http://{hosts[0]}", *origins) for origin in sources):
        return f"a page of {' and '.join(sources)[:200]} may not look"
    return ""


def _names_this_server(header: str, host: str, port: int) -> bool:
    """Return whether a `Host` header names this server."""
    try:
        place = urlsplit(f"//{header}")
        name, number = place.hostname or "", place.port or 80
    except ValueError:
        return False
    if place.path or place.username is not None or number != port:
        return False
    return name in ("localhost", host.lower()) or _is_address(name)


def _is_address(name: str) -> bool:
    """Return whether a name is an IP address, which DNS rebinding cannot forge."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
