"""Reading logs: all figures of a log of 200 MB (of 2 GB when asked), beside the `mcap` package that only decodes them.

The log is made of real messages, over and over with new numbers; each measurement is a process of its own, so that its
peak memory is its own. `python -m benchmarks logs-2gb` needs 2.5 GB in the temporary folder, and some minutes.
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
    """Keys and messages of some episodes, driven in process (what it takes is not loaded where memory is measured)."""
    import numpy as np

    from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
    from brakeline.deploy.data.model_store import model_for
    from brakeline.deploy.experiments.evaluate import in_process
    from brakeline.deploy.vehicle_factory import environment
    from brakeline.messaging.task import robot_with_task
    from brakeline.safety.model.model_set import ModelConfig
    from brakeline.sim.scripted_policies import scripted

    ground = robot_with_task("ground")
    ask = in_process(model_for(ground, ModelConfig()))
    driver = EpisodeRunner(ground, environment(ground, "default", 7), ActorIdentity("actor-0", 0, 7))
    policy = scripted("greedy", ground, np.random.default_rng(7))
    found: list[tuple[str, Any]] = []
    for number in range(EPISODES):
        found.append(("episode/ground/actor-0", driver.begin(number)))
        while driver.running:
            proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
            outcome = driver.decide(proposal, ask)
            assert outcome is not None
            found.append(("exchange/ground/actor-0", outcome.exchange(driver.info["time"])))
            found.append(("step/ground/actor-0", driver.execute(proposal, outcome)))
        found.append(("health/actor-0", pb.Health(process="actor-0", figures={"steps_per_s": 100.0, "steps": number})))
        found.append(("metrics/ground", pb.LearnerMetrics(robot="ground", steps=number, weights_version=number)))
    return found


def endless(messages: list[tuple[str, Any]]) -> Iterator[Entry]:
    """The messages over and over, numbered and dated as if they had been published one after the other."""
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


def synthesise(path: Path, size: int) -> int:
    """Write a log of that many bytes; returns how many messages it has."""
    segment, entries, count = open_segment(path, {}), endless(real()), 0
    while segment.size < size:
        segment.save(islice(entries, PORTION))
        count += PORTION
    segment.finish()
    return count


def measured(what: str, path: Path) -> dict[str, float]:
    """In a process of its own: messages a second, and the peak of its memory."""
    words = [*PYTHON, "-m", "benchmarks.log_reading", what, str(path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # nothing installs the benchmarks
    run = subprocess.run(words, check=True, capture_output=True, text=True, env=environment)
    found: dict[str, float] = json.loads(run.stdout)
    return found


def ours(path: Path, pictures: bool) -> int:
    figures = analyse_runs(path, AnalysisOptions(pictures)).figures()
    return int(sum(segment["messages"] for segment in figures["segments"]))


def peer(path: Path) -> int:
    """The first messages, decoded by the `mcap` package."""
    with path.open("rb") as file:
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in islice(reader.iter_decoded_messages(log_time_order=False), PEER))


def of_size(size: int) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        synthesise(path, size)
        name = f"{size // MB} MB"
        found = {
            f"all figures, {name}": measured("figures", path),
            f"and what the report draws, {name}": measured("report", path),
        }
        return found if size > SMALL else found | {f"mcap, decoded only, first {PEER}": measured("mcap", path)}


def run() -> Figures:
    return of_size(SMALL)


def run_large() -> Figures:
    return of_size(SMALL) | of_size(LARGE)


def main() -> None:
    """One measurement, as JSON on stdout."""
    what, path = sys.argv[1], Path(sys.argv[2])
    wall, cpu = time.perf_counter(), time.process_time()
    count = peer(path) if what == "mcap" else ours(path, pictures=what == "report")
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps({"messages": count, "messages/s": count / wall, "per CPU s": count / cpu, "peak MiB": peak()}))


def peak() -> float:
    """The most memory that this process had, in MiB (getrusage would count the process that started it too)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


if __name__ == "__main__":
    main()
