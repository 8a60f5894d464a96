"""Who may look at a running system through a browser: nobody's page but ours, under no name that somebody else gave to
this machine.

A page of a stranger can make a browser ask any address, also this machine's own. It can read the answer if the name in
its own address leads here (DNS rebinding: the `Host` that is asked for is the stranger's), and what a websocket says in
any case; then `Origin` is the stranger's.
"""

from __future__ import annotations

from collections.abc import Collection
from email.message import Message
from ipaddress import ip_address
from urllib.parse import urlsplit


def rejection_reason(headers: Message, host: str, port: int, origins: Collection[str] = ()) -> str:
    """Why a request with these headers is refused; empty: it is not.

    It is for `host`:`port` (or an address, or localhost), and comes from a page from there, from one of `origins`, or
    from a program that is no browser.
    """
    hosts, said = headers.get_all("Host") or [], headers.get_all("Origin") or []
    if len(hosts) != 1 or not _leads_here(hosts[0], host, port):
        return f"{' and '.join(hosts)[:200] or 'no host'} is not this machine"
    if len(said) > 1 or any(origin not in (f"http://{hosts[0]}", *origins) for origin in said):
        return f"a page of {' and '.join(said)[:200]} may not look"
    return ""


def _leads_here(asked: str, host: str, port: int) -> bool:
    """Is it what a visitor would write who means this server?"""
    try:
        place = urlsplit(f"//{asked}")
        name, number = place.hostname or "", place.port or 80
    except ValueError:
        return False
    if place.path or place.username is not None or number != port:
        return False
    return name in ("localhost", host.lower()) or _is_address(name)


def _is_address(name: str) -> bool:
    """A stranger's page has a name; an address leads where it says."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
