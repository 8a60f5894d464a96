"""Measure the figures of a log of 200 MB (or 2 GB) beside the `mcap` package, which only decodes the messages.

The log repeats real messages with new numbers. Each measurement is a process of its own, which has a peak memory of its
own. `python -m benchmarks logs-2gb` needs 2.5 GB in the temporary folder, and some minutes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory

from benchmarks.timing import Figures
from brakeline.deploy.interpreter import PYTHON
from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
from brakeline.logs.segment import Entry, open_segment
from brakeline.messaging import brakeline_pb2 as pb

MB = 10**6
ROOT = Path(__file__).parents[1]
SMALL, LARGE = 200 * MB, 2000 * MB
EPISODES = 6  # of real messages
PEER = 100_000  # messages that the peer decodes
PORTION = 400  # messages between flushes
PERIOD = 2_000_000  # ns between messages: some 250 steps a second


def real() -> list[tuple[str, Any]]:
    """Return the keys and messages of some episodes, driven in this process."""
    from benchmarks.situations import driven  # here, so that it takes no memory where memory is measured
    from brakeline.messaging.task import robot_with_task

    messages: list[tuple[str, Any]] = []
    for episode, outcome, step in driven("greedy", 7, robot_with_task("ground")):
        if step.episode == EPISODES:
            break
        if episode is not None:
            messages.append(("episode/ground/actor-0", episode))
        messages.append(("exchange/ground/actor-0", outcome.exchange(step.header.time)))
        messages.append(("step/ground/actor-0", step))
        if step.terminated or step.truncated:
            figures = {"steps_per_s": 100.0, "steps": step.episode}
            messages.append(("health/actor-0", pb.Health(process="actor-0", figures=figures)))
            metrics = pb.LearnerMetrics(robot="ground", steps=step.episode, weights_version=step.episode)
            messages.append(("metrics/ground", metrics))
    return messages


def endless(messages: list[tuple[str, Any]]) -> Iterator[Entry]:
    """Yield the messages again and again, with the numbers and times of a publisher."""
    numbers: dict[str, int] = {}
    now, rounds = 1_700_000_000 * 10**9, 0
    while True:
        for key, message in messages:
            now += PERIOD
            numbers[key] = number = numbers.get(key, 0) + 1
            header = message.header
            header.sequence, header.source, header.run, header.wall_time = number, "actor-0", 1, now
            if hasattr(message, "episode"):
                message.episode = message.episode % EPISODES + EPISODES * rounds
            elif isinstance(message, pb.Exchange):
                message.request.episode = message.request.episode % EPISODES + EPISODES * rounds
            yield Entry(key, type(message), message.SerializeToString(), now, now, number)
        rounds += 1


def synthesise(path: Path, size: int) -> None:
    """Write a log of `size` bytes."""
    segment, entries = open_segment(path, {}), endless(real())
    while segment.size < size:
        segment.save(islice(entries, PORTION))
    segment.finish()


def measured(what: str, path: Path) -> dict[str, float]:
    """Measure one way to read a log in a process of its own: messages a second, and peak memory."""
    words = [*PYTHON, "-m", "benchmarks.log_reading", what, str(path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # nothing installs the benchmarks
    run = subprocess.run(words, check=True, capture_output=True, text=True, env=environment)
    figures: dict[str, float] = json.loads(run.stdout)
    return figures


def ours(path: Path, pictures: bool) -> int:
    """Compute all figures of a log, and what the report draws. Returns the number of messages."""
    figures = analyse_runs(path, AnalysisOptions(pictures)).figures()
    return int(sum(segment["messages"] for segment in figures["segments"]))


def peer(path: Path) -> int:
    """Decode the first messages with the `mcap` package. Returns their number."""
    with path.open("rb") as file:
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in islice(reader.iter_decoded_messages(log_time_order=False), PEER))


def of_size(size: int) -> Figures:
    """Return a row for each way to read a log of `size` bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        synthesise(path, size)
        name = f"{size // MB} MB"
        rows = {
            f"all figures, {name}": measured("figures", path),
            f"and what the report draws, {name}": measured("report", path),
        }
        return rows if size > SMALL else rows | {f"mcap, decoded only, first {PEER}": measured("mcap", path)}


def run() -> Figures:
    """Return the rows of a small log."""
    return of_size(SMALL)


def run_large() -> Figures:
    """Return the rows of a small and of a large log."""
    return of_size(SMALL) | of_size(LARGE)


def main() -> None:
    """Make one measurement, and print it as JSON."""
    what, path = sys.argv[1], Path(sys.argv[2])
    wall, cpu = time.perf_counter(), time.process_time()
    count = peer(path) if what == "mcap" else ours(path, pictures=what == "report")
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps({"messages": count, "messages/s": count / wall, "per CPU s": count / cpu, "peak MiB": peak()}))


def peak() -> float:
    """Return the peak memory of this process [MiB]; getrusage would include the process that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


if __name__ == "__main__":
    main()
