"""Clients that send slowly, or nothing, keep nobody from the metrics, the live page and the Foxglove server."""

import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from brakeline.logs.watch import websocket_gate
from brakeline.logs.watch.live_page_server import MOST_STREAMS, LivePageServer
from brakeline.logs.watch.websocket_gate import WebSocketGate
from brakeline.messaging import http_server
from brakeline.messaging.http_server import MOST_CLIENTS, ConnectionSlots
from brakeline.messaging.metrics_endpoint import MetricsServer, ProcessStatus

CROWD = 3 * MOST_CLIENTS


def view() -> dict[str, object]:
    return {"robots": []}


def status() -> ProcessStatus:
    return ProcessStatus("safety-0", True, True, True, {}, {})


@pytest.fixture(params=["metrics", "page"])
def served(request: pytest.FixtureRequest) -> Iterator[tuple[int, str]]:
    """The port of a server, and a path that it serves."""
    if request.param == "page":
        with LivePageServer(view) as page:
            yield int(page.url.rsplit(":", 1)[1].strip("/")), "/view.json"
        return
    server = MetricsServer("0", status)
    yield server.port, "/live"
    server.close()


@pytest.fixture
def connect() -> Iterator[Callable[[int, bytes], socket.socket]]:
    """`connect(port, sent)`: a client that has sent these bytes; it is closed after the test."""
    with ExitStack() as stack:

        def make(port: int, sent: bytes = b"") -> socket.socket:
            client = stack.enter_context(socket.create_connection(("127.0.0.1", port), 10.0))
            client.sendall(sent)
            return client

        yield make


def get(port: int, path: str) -> int:
    return int(urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10.0).status)


@pytest.mark.parametrize("sent", [b"", b"GET /metrics HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-"], ids=repr)
def test_a_crowd_that_sends_no_whole_request_keeps_nobody_out(
    served: tuple[int, str], connect: Callable[[int, bytes], socket.socket], sent: bytes
) -> None:
    port, path = served
    crowd = [connect(port, sent) for _ in range(CROWD)]
    assert get(port, path) == 200
    assert crowd[0].recv(1) == b"", "the one that waited longest had to go"


def test_a_client_that_drips_bytes_is_cut_off(
    served: tuple[int, str], connect: Callable[[int, bytes], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_server, "REQUEST_TIME", 0.3)
    client = connect(served[0], b"GET / HTTP/1.1\r\n")
    client.settimeout(0.05)
    drips = 0
    while drips < 200:
        drips += 1
        try:
            client.sendall(b"X: 1\r\n")
            if client.recv(1) == b"":
                break
        except TimeoutError:
            continue
        except OSError:
            break
    assert drips < 100, "each byte may not renew the patience"


def test_pages_that_stay_open_leave_places_for_short_requests(
    connect: Callable[[int, bytes], socket.socket],
) -> None:
    with LivePageServer(view) as page:
        port = int(page.url.rsplit(":", 1)[1].strip("/"))
        asking = f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        answers = [connect(port, asking).recv(12) for _ in range(MOST_STREAMS + 1)]
        assert answers == [b"HTTP/1.1 200"] * MOST_STREAMS + [b"HTTP/1.1 503"]
        assert get(port, "/view.json") == 200


def test_a_crowd_before_the_foxglove_server_keeps_nobody_out(
    connect: Callable[[int, bytes], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as behind:
        gate = WebSocketGate("127.0.0.1", 0, behind.getsockname(), ())
        try:
            crowd = [connect(gate.port, b"GET") for _ in range(CROWD)]
            connect(gate.port, f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{gate.port}\r\n\r\n".encode())
            behind.settimeout(10.0)
            inside, _ = behind.accept()
            with inside:
                assert inside.recv(5) == b"GET /"
            monkeypatch.setattr(websocket_gate, "TIMEOUT", 0.2)
            assert connect(gate.port, b"GET / H").recv(1) == b"", "and none may wait for ever"
            assert len(crowd) == CROWD
        finally:
            gate.close()


def test_the_one_that_waited_longest_gives_way_and_one_that_is_served_does_not() -> None:
    slots, pairs = ConnectionSlots(2), [socket.socketpair() for _ in range(4)]
    first, second, third, fourth = (pair[0] for pair in pairs)
    for _, client in pairs:
        client.settimeout(10.0)  # s: of a client that is not cut off
    assert slots.enter(first) and slots.enter(second)
    slots.serve(first)
    assert slots.enter(third), "in the place of the second"
    assert pairs[1][1].recv(1) == b""
    slots.serve(third)
    assert not slots.enter(fourth), "all are served"
    slots.await_request(first)
    assert slots.enter(fourth) and pairs[0][1].recv(1) == b""
    for connection in (first, second, third, fourth):
        slots.leave(connection)
    assert slots.enter(first) and slots.enter(second)
    for pair in pairs:
        for end in pair:
            end.close()


@pytest.mark.parametrize("path", ["/metrics", "/live", "/ready", "/elsewhere"])
@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil"}, {"Host": "evil:9100"}, {"Host": "127.0.0.1.evil.com"}, {"Origin": "http://evil"}],
    ids=str,
)
def test_a_foreign_page_does_not_read_the_metrics(path: str, headers: dict[str, str]) -> None:
    """By DNS rebinding a page of `evil` reaches this machine, and names `evil` as the host."""
    server = MetricsServer("0", status)
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}", headers=headers)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=10.0)
    assert refused.value.code == 403 and b"brakeline" not in refused.value.read()
    server.close()


@pytest.mark.parametrize("host", ["localhost:9100", "10.1.2.3:9100", "[fd00::1]:9100", socket.gethostname()])
def test_a_scraper_names_the_machine_or_its_address_at_any_port(host: str) -> None:
    server = MetricsServer("0", status)
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}/metrics", headers={"Host": host})
    with urllib.request.urlopen(request, timeout=10.0) as answer:
        assert b"brakeline_connected" in answer.read()
    server.close()
