"""Foreign web pages cannot read a running system, whatever host name they use."""

import json
import re
import socket
from collections.abc import Iterator

import psutil
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.foxglove_server import FoxgloveServer
from brakeline.logs.watch.live_page_server import FILES, LivePageServer
from tests.http_client import asked, port_of


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """The port of a live page."""
    with LivePageServer(Dashboard().view) as server:
        yield port_of(server.url)


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "[::1]:{port}", "192.168.1.7:{port}"])
def test_the_live_page_itself_is_allowed(port: int, host: str) -> None:
    status, body = asked(port, "/view.json", Host=host, Origin=f"http://{host}")
    assert status == 200 and json.loads(body)["robots"] == []


@pytest.mark.parametrize(
    "headers",
    [
        *({"Host": host} for host in ("evil", "evil:{port}", "evil.localhost:{port}", "127.0.0.1.evil.com:{port}")),
        *({"Host": host} for host in ("", "127.0.0.1", "127.0.0.1:1", "a@127.0.0.1:{port}", "[:{port}", "x" * 2000)),
        *({"Origin": origin} for origin in ("http://evil", "http://evil:{port}", "null", "https://127.0.0.1:{port}")),
    ],
    ids=str,
)
def test_a_foreign_page_is_rejected(port: int, headers: dict[str, str]) -> None:
    for path in ("/", "/view.json", "/events", "/page.js", "/viewer.js", "/report.html"):
        status, body = asked(port, path, **headers)
        assert status == 403 and b"robots" not in body, path


def test_the_live_page_has_every_script_that_it_names(port: int) -> None:
    names = re.findall(r'(?:src|href)="(/[^"]+)"', asked(port, "/")[1].decode())
    assert set(names) == set(FILES) - {"/"} | {"/report.html"}
    assert all(asked(port, name)[0] == 200 for name in FILES)


@pytest.fixture(scope="module")
def live() -> Iterator[FoxgloveServer]:
    with FoxgloveServer() as live:
        yield live


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev"])
def test_foxglove_can_connect(live: FoxgloveServer, origin: str | None) -> None:
    with connect(live.url, subprotocols=["foxglove.sdk.v1"], origin=origin) as visit:  # type: ignore[arg-type, list-item]
        assert json.loads(visit.recv(timeout=10.0))["op"] == "serverInfo"


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "https://evil"}, {"Origin": "null"}, {"Host": "evil"}, {"Origin": "https://app.foxglove.dev.evil"}],
)
def test_a_foreign_page_cannot_connect_to_the_foxglove_server(live: FoxgloveServer, headers: dict[str, str]) -> None:
    url = live.url.replace("127.0.0.1", headers.get("Host", "127.0.0.1"))
    there = socket.create_connection(("127.0.0.1", live.port))
    with there, pytest.raises(InvalidStatus) as refused:
        connect(url, sock=there, subprotocols=["foxglove.sdk.v1"], origin=headers.get("Origin"))  # type: ignore
    assert refused.value.response.status_code == 403


def listening() -> set[tuple[str, int]]:
    return {tuple(c.laddr) for c in psutil.Process().net_connections("tcp") if c.status == psutil.CONN_LISTEN}


def test_the_foxglove_server_listens_on_a_hidden_address() -> None:
    before = listening()  # also a server that was told to stop, and has not yet
    with FoxgloveServer() as live:
        new = listening() - before
    assert ("127.0.0.1", live.port) in new
    ((ip, _),) = new - {("127.0.0.1", live.port)}
    assert ip.startswith("127.") and ip != "127.0.0.1"
