"""What a process says of itself over HTTP: /metrics in Prometheus' format, and /live and /ready for who keeps it.

The metrics are the figures of its Health, by this table; `brakeline_published` counts messages by topic.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

HERE = "127.0.0.1"


@dataclass(frozen=True)
class Shown:
    """How a figure is shown: a counter's name gets `_total`; `factor` makes base units of it."""

    name: str
    what: str
    counts: bool = False
    factor: float = 1.0


COUNT = True
# By its name in Health. What is not here is for people: figures of single channels, for instance.
FIGURES: dict[str, Shown] = {
    "passed over": Shown("brakeline_passed_over", "Messages that could not be handled", COUNT),
    "decisions": Shown("brakeline_decisions", "Decisions of a safety service", COUNT),
    "errors": Shown("brakeline_decision_errors", "Requests answered with an error", COUNT),
    "compared": Shown("brakeline_predictions", "States that could be compared with a prediction", COUNT),
    "violations": Shown("brakeline_prediction_violations", "States outside of what was predicted", COUNT),
    "unverified": Shown("brakeline_unverified_decisions", "Decisions without a verified plan", COUNT),
    "token_rejected": Shown("brakeline_unvouched_requests", "Requests with a plan token that does not match", COUNT),
    "not_finite": Shown("brakeline_not_finite_proposals", "Proposed actions with NaN or infinity", COUNT),
    "decide_ms": Shown("brakeline_decide_seconds", "Mean time of a decision", factor=1e-3),
    "busy": Shown("brakeline_busy", "Share of the last second that a safety service was answering"),
    "steps": Shown("brakeline_steps", "Steps taken by an actor, or taken in by a learner", COUNT),
    "steps_per_s": Shown("brakeline_steps_per_second", "Mean since the actor's start"),
    "fallbacks": Shown("brakeline_fallbacks", "Steps along the committed plan, for want of a decision", COUNT),
    "waits": Shown("brakeline_waits", "Times that a standing robot got no answer and asked again", COUNT),
    "collisions": Shown("brakeline_collisions", "Steps with a collision", COUNT),
    "round_trip_ms": Shown("brakeline_round_trip_seconds", "Mean time of a question and its answer", factor=1e-3),
    "updates_per_s": Shown("brakeline_updates_per_second", "A learner's updates"),
    "missing": Shown("brakeline_missing_steps", "Steps published that a learner never saw"),
    "duplicates": Shown("brakeline_duplicate_steps", "Steps that came twice, and were learned from once", COUNT),
    "refused": Shown("brakeline_refused_steps", "Steps that a learner did not take", COUNT),
    "recorded": Shown("brakeline_recorded", "Messages in a recorder's files", COUNT),
    "dropped": Shown("brakeline_dropped", "Messages that a recorder had no room for", COUNT),
    "waiting": Shown("brakeline_waiting", "Not yet worked on: a learner's steps, a recorder's bytes"),
}
CONNECTED = Shown("brakeline_connected", "1: on the bus")
PUBLISHED = Shown("brakeline_published", "Messages put, by topic", COUNT)


@dataclass(frozen=True)
class State:
    """What a process is at the moment of being asked."""

    process: str
    live: bool  # it gives signs of life
    ready: bool  # it does its work
    connected: bool
    figures: Mapping[str, float]
    published: Mapping[str, int]  # by key


class MetricsServer:
    """Serves until `close`, in threads of its own."""

    def __init__(self, where: str, state: Callable[[], State]) -> None:
        """where: PORT of this machine, or HOST:PORT; port 0: a free one.

        Raises:
            ValueError: it is neither; OSError: it can't be listened on.
        """
        host, _, port = where.rpartition(":")
        if not port.isdecimal():
            raise ValueError(f"--metrics {where}: PORT, or HOST:PORT")
        registry = CollectorRegistry()
        registry.register(Collector(state))
        self._server = ThreadingHTTPServer((host or HERE, int(port)), _handler(registry, state))
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class Collector:
    """A process's state as Prometheus' metrics, each with the process's name and role."""

    def __init__(self, state: Callable[[], State]) -> None:
        self._state = state

    def describe(self) -> Iterable[Metric]:
        """Not known before it is asked."""
        return ()

    def collect(self) -> Iterable[Metric]:
        state = self._state()
        labels = [state.process, state.process.replace(".", "-").split("-", 1)[0]]
        yield _family(CONNECTED, [((), float(state.connected))], labels)
        for name, shown in FIGURES.items():
            if name in state.figures:
                yield _family(shown, [((), state.figures[name] * shown.factor)], labels)
        topics: Counter[str] = Counter()
        for key, count in state.published.items():
            topics[key.split("/", 1)[0]] += count
        yield _family(
            PUBLISHED, [((topic,), float(count)) for topic, count in sorted(topics.items())], labels, ("topic",)
        )


def _family(
    shown: Shown, values: list[tuple[tuple[str, ...], float]], labels: list[str], more: tuple[str, ...] = ()
) -> Metric:
    kind = CounterMetricFamily if shown.counts else GaugeMetricFamily
    family = kind(shown.name, shown.what, labels=("process", "role", *more))
    for extra, value in values:
        family.add_metric([*labels, *extra], value)
    return family


def _handler(registry: CollectorRegistry, state: Callable[[], State]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0  # s that a visitor may take

        def do_GET(self) -> None:
            path = self.path.split("?")[0]
            if path == "/metrics":
                self._say(200, CONTENT_TYPE_LATEST, generate_latest(registry))
            elif path == "/live":
                self._answer(state().live)
            elif path == "/ready":
                self._answer(state().ready)
            else:
                self._say(404, "text/plain", b"there are /metrics, /live and /ready\n")

        def log_message(self, format: str, *args: Any) -> None:
            """Nobody needs to know of each visit."""

        def _answer(self, good: bool) -> None:
            self._say(200 if good else 503, "text/plain", b"yes\n" if good else b"no\n")

        def _say(self, status: int, kind: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    return Handler
