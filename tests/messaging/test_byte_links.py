"""Bytes there and back over each kind of link, and peers that are gone."""

import pytest

from brakeline.errors import BadLink
from brakeline.messaging.byte_links import Link, Tcp, TcpServer, Udp, open_link
from tests.waiting import until


def arrives(link: Link, expected: bytes) -> bool:
    """Within a second, in however many pieces."""
    data = bytearray()
    return bool(until(lambda: data.extend(link.receive()) or data == expected, seconds=1.0))


@pytest.mark.parametrize(("listening", "calling"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_bytes_go_both_ways(listening: str, calling: str) -> None:
    server = open_link(f"{listening}:127.0.0.1:0")
    assert isinstance(server, Udp | TcpServer)
    client = open_link(f"{calling}:127.0.0.1:{server.port}")
    client.send(b"hello")
    assert arrives(server, b"hello")
    server.send(b"good day")
    assert arrives(client, b"good day")
    assert client.receive() == b""
    client.close()
    server.close()


@pytest.mark.parametrize(("listening", "calling"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_pieces_name_their_senders_and_one_of_them_can_be_answered(listening: str, calling: str) -> None:
    server = open_link(f"{listening}:127.0.0.1:0")
    assert isinstance(server, Udp | TcpServer)
    first, second = (open_link(f"{calling}:127.0.0.1:{server.port}") for _ in range(2))
    pieces: dict[bytes, str] = {}
    for end, word in ((first, b"first"), (second, b"second")):
        end.send(word)
    until(lambda: pieces.update((data, peer) for peer, data in server.receive_by_peer()) or len(pieces) == 2)
    assert pieces[b"first"] != pieces[b"second"] and pieces[b"first"].startswith("127.0.0.1:")
    server.send(b"only you", pieces[b"second"])
    assert arrives(second, b"only you") and first.receive() == b""
    for end in (first, second, server):
        end.close()


def test_a_peer_that_is_gone_is_no_error() -> None:
    server = open_link("tcpin:127.0.0.1:0")
    assert isinstance(server, TcpServer)
    client = open_link(f"tcp:127.0.0.1:{server.port}")
    assert isinstance(client, Tcp)
    client.send(b"x")
    assert arrives(server, b"x")
    server.close()
    until(lambda: client.receive() or not client.open, seconds=1.0)
    client.send(b"y")
    client.close()

    nobody = open_link("udpout:127.0.0.1:9")
    nobody.send(b"x")
    nobody.send(b"y")
    assert nobody.receive() == b""
    nobody.close()


@pytest.mark.parametrize("url", ["", "udpin", "udpin:127.0.0.1", "carrier:pigeon:1", "tcp:127.0.0.1:99999"])
def test_what_is_no_link_is_refused(url: str) -> None:
    with pytest.raises(BadLink):
        open_link(url)
