"""PROCESS: a long cable: passes a TCP port on to another host, each byte later than it came (kernels without netem).

python -m tests.faults.cable_delay 0.0.0.0:7447=10.0.0.1:7447 --delay 0.02 --jitter 0.01
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from dataclasses import dataclass
from random import Random
from typing import Annotated

import tyro

CHUNK = 2**16  # bytes read at a time
UNDER_WAY = 64  # chunks on the cable in each direction; then the sender waits, as on one that is full


@dataclass(frozen=True)
class Delay:
    """Pass ports on, with a delay each way."""

    ports: Annotated[tuple[str, ...], tyro.conf.Positional]
    """LISTEN_HOST:PORT=TO_HOST:PORT, of each."""
    delay: float = 0.02
    """s each way."""
    jitter: float = 0.0
    """s more, at the most; the order stays as it was."""
    seed: int = 0


async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, given: Delay, random: Random) -> None:
    """Whatever comes until one end closes, each chunk `delay` later and none before the one before it."""
    clock = asyncio.get_running_loop().time
    cable: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(UNDER_WAY)

    async def put_in() -> None:
        due = 0.0
        while chunk := await reader.read(CHUNK):
            due = max(due, clock() + given.delay + random.uniform(0.0, given.jitter))
            await cable.put((due, chunk))
        await cable.put((due, b""))

    filling = asyncio.create_task(put_in())
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
    """One connection: both ways, until either ends."""
    host, _, port = to.rpartition(":")
    random = Random(given.seed)
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
    """All ports, for ever."""
    async with contextlib.AsyncExitStack() as stack:
        for words in given.ports:
            listen, _, to = words.partition("=")
            host, _, port = listen.rpartition(":")

            async def one(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, to: str = to) -> None:
                await join(reader, writer, to, given)

            await stack.enter_async_context(await asyncio.start_server(one, host, int(port)))
        await asyncio.Event().wait()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(serve(tyro.cli(Delay, prog="python -m tests.faults.cable_delay", description=__doc__)))
    sys.exit(130)
