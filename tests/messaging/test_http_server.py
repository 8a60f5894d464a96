"""Clients that send slowly, or nothing, keep nobody from the metrics, the live page and the Foxglove server. What is
scraped is what the processes say; what the dashboard and the autoscaler ask for is exported.
"""

import json
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from brakeline.logs.watch import websocket_gate
from brakeline.logs.watch.live_page_server import MOST_STREAMS, LivePageServer
from brakeline.logs.watch.websocket_gate import WebSocketGate
from brakeline.messaging import http_server
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.http_server import MOST_CLIENTS, ConnectionSlots
from brakeline.messaging.metrics_endpoint import FIGURES, MetricsServer, ProcessStatus
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.topics import LOG
from tests.http_client import asked, port_of
from tests.waiting import until

CROWD = 3 * MOST_CLIENTS


def view() -> dict[str, object]:
    return {"robots": []}


@pytest.fixture(params=["metrics", "page"])
def served(request: pytest.FixtureRequest) -> Iterator[tuple[int, str]]:
    """The port of a server, and a path that it serves."""
    if request.param == "page":
        with LivePageServer(view) as page:
            yield port_of(page.url), "/view.json"
        return
    server = MetricsServer("0", everything)
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


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-"], ids=repr)
def test_a_crowd_that_sends_no_whole_request_keeps_nobody_out(
    served: tuple[int, str], connect: Callable[[int, bytes], socket.socket], sent: bytes
) -> None:
    port, path = served
    crowd = [connect(port, sent) for _ in range(CROWD)]
    assert asked(port, path)[0] == 200
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
        port = port_of(page.url)
        asking = f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        answers = [connect(port, asking).recv(12) for _ in range(MOST_STREAMS + 1)]
        assert answers == [b"HTTP/1.1 200"] * MOST_STREAMS + [b"HTTP/1.1 503"]
        assert asked(port, "/view.json")[0] == 200


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


def test_a_foreign_page_does_not_read_the_metrics_and_a_scraper_names_the_machine(exposed) -> None:
    """By DNS rebinding a page of `evil` reaches this machine, and names `evil` as the host."""
    port = exposed(everything())
    for host in ("evil", "evil:9100", "127.0.0.1.evil.com", ""):
        headers = {"Host": host} if host else {"Origin": "http://evil"}
        for path in ("/metrics", "/live", "/ready", "/elsewhere"):
            status, text = asked(port, path, **headers)
            assert status == 403 and b"brakeline" not in text, (headers, path)
    for host in ("localhost:9100", "10.1.2.3:9100", "[fd00::1]:9100", socket.gethostname()):
        assert b"brakeline_connected" in asked(port, "/metrics", Host=host)[1], host


DEPLOY = Path(__file__).parents[2] / "deploy"


def scraped(port):
    """Value by name and labels other than the process's."""
    return {
        (sample.name, sample.labels.get("topic", "")): (sample.value, sample.labels["process"], sample.labels["role"])
        for family in text_string_to_metric_families(asked(port, "/metrics")[1].decode())
        for sample in family.samples
    }


def everything(**more):
    figures = {name: float(i + 1) for i, name in enumerate(FIGURES)}
    state = dict.fromkeys(("live", "ready", "connected"), True)
    return ProcessStatus(**({"process": "safety-3", "figures": figures, "published": {"log/a": 2}} | state | more))


@pytest.fixture
def exposed():
    """`exposed(state)`: the port at which it is served."""
    started = []

    def serve(state):
        started.append(MetricsServer("0", lambda: state))
        return started[-1].port

    yield serve
    for exposition in started:
        exposition.close()


def test_a_process_is_scraped_and_asked_whether_it_is_ready():
    settings = BusSettings(listen=(free_endpoint(),), metrics="0")
    with Process(settings, "safety-0", stderr=False) as process:
        port = process._metrics.port
        assert asked(port, "/ready")[0] == 503
        process.figures.update(decisions=7, decide_ms=2.5)
        process.bus.publisher(LOG)
        process.announce()
        assert asked(port, "/ready") == asked(port, "/live") == (200, b"yes\n")
        until(lambda: scraped(port).get(("brakeline_published_total", "health"), (0,))[0] >= 1, "a Health")
        metrics = scraped(port)
        assert metrics["brakeline_decisions_total", ""] == (7.0, "safety-0", "safety")
        assert metrics["brakeline_decide_seconds", ""][0] == pytest.approx(2.5e-3)
        assert metrics["brakeline_connected", ""][0] == 1.0 and metrics["brakeline_passed_over_total", ""][0] == 0.0
        assert asked(port, "/keys")[0] == 404
    with pytest.raises(ConnectionRefusedError):
        asked(port, "/metrics")


def test_who_is_stuck_does_not_live_and_who_is_cut_off_is_not_ready(exposed):
    stuck, cut = exposed(everything(live=False)), exposed(everything(ready=False, connected=False))
    assert asked(stuck, "/live")[0] == asked(cut, "/ready")[0] == 503
    assert asked(cut, "/live") == (200, b"yes\n") and scraped(cut)["brakeline_connected", ""][0] == 0.0


def test_where_nothing_can_be_served_is_said(exposed):
    with pytest.raises(ValueError, match="HOST:PORT"):
        MetricsServer("nonsense", everything)
    with pytest.raises(OSError, match=r"in use: cannot listen at .*:\d+, give another port"):
        MetricsServer(str(exposed(everything())), everything)
    with pytest.raises(OSError, match="70000 is no port"):
        MetricsServer("127.0.0.1:70000", everything)


@pytest.mark.parametrize("path", ["grafana/brakeline.json", "kubernetes/autoscaler.yaml"])
def test_what_is_asked_for_is_exported(exposed, path):
    text = (DEPLOY / path).read_text()
    wanted = set(re.findall(r"\bbrakeline_[a-z_]+", text))
    assert wanted
    assert wanted <= {name for name, _ in scraped(exposed(everything()))}
    if path.endswith(".json"):
        assert len(wanted) > 15 and json.loads(text)["panels"]
