"""PROCESS: a long cable. It passes a TCP port on to another host, with a delay (for kernels without netem).

python -m tests.faults.cable_delay 0.0.0.0:7447=10.0.0.1:7447 --delay 0.02 --jitter 0.01
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Annotated

import tyro

CHUNK = 2**16  # bytes read at a time
UNDER_WAY = 64  # chunks on the cable in each direction; then the sender waits


@dataclass(frozen=True)
class Delay:
    """Pass ports on, with a delay each way."""

    ports: Annotated[tuple[str, ...], tyro.conf.Positional]
    """LISTEN_HOST:PORT=TO_HOST:PORT of each port."""
    delay: float = 0.02
    """Delay each way [s]."""
    jitter: float = 0.0
    """Largest additional delay, drawn for each chunk [s]. The order of the chunks stays."""


async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, given: Delay, random: Random) -> None:
    """Pass chunks on until one end closes, each `delay` later and none before its predecessor."""
    clock = asyncio.get_running_loop().time
    cable: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(UNDER_WAY)

    async def fill() -> None:
        due = 0.0
        while chunk := await reader.read(CHUNK):
            due = max(due, clock() + given.delay + random.uniform(0.0, given.jitter))
            await cable.put((due, chunk))
        await cable.put((due, b""))

    filling = asyncio.create_task(fill())
    try:
        while True:
            due, chunk = await cable.get()
            await asyncio.sleep(due - clock())
            if not chunk:
                return
            writer.write(chunk)
            await writer.drain()
    finally:
        filling.cancel()
        with contextlib.suppress(asyncio.CancelledError, OSError):
            await filling


async def join(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, to: str, given: Delay) -> None:
    """Serve one connection both ways, until either end closes it."""
    host, _, port = to.rpartition(":")
    random = Random(0)
    with contextlib.suppress(OSError):
        there, here = await asyncio.open_connection(host, int(port))
        ways = [asyncio.create_task(pump(*way, given, random)) for way in ((reader, here), (there, writer))]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            here.close()
    writer.close()


async def serve(given: Delay) -> None:
    """Serve all ports, for ever."""
    for words in given.ports:
        listen, _, to = words.partition("=")
        host, _, port = listen.rpartition(":")
        await asyncio.start_server(partial(join, to=to, given=given), host, int(port))
    await asyncio.Event().wait()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(serve(tyro.cli(Delay, prog="python -m tests.faults.cable_delay", description=__doc__)))
    sys.exit(130)
