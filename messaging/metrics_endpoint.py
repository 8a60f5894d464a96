"""Serve the state of a process over HTTP: /metrics in Prometheus format, /live and /ready for a process manager.

The metrics are the figures of the process's Health that are in the table `FIGURES`, and the number of messages that it
has published on each topic.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import MetricsHandler

from brakeline.messaging.http_server import BoundedHandler, BoundedServer

LOCALHOST = "127.0.0.1"


@dataclass(frozen=True)
class MetricSpec:
    """The metric of a figure. Prometheus adds `_total` to a counter's name; `factor` converts to base units."""

    name: str
    help: str
    is_counter: bool = False
    factor: float = 1.0


COUNT = True
# By the name of the figure in Health. Figures that are not in this table are not exported.
FIGURES: dict[str, MetricSpec] = {
    "passed over": MetricSpec("brakeline_passed_over", "Messages that could not be handled", COUNT),
    "decisions": MetricSpec("brakeline_decisions", "Decisions of a safety service", COUNT),
    "errors": MetricSpec("brakeline_decision_errors", "Requests answered with an error", COUNT),
    "compared": MetricSpec("brakeline_predictions", "States compared with a predicted set", COUNT),
    "violations": MetricSpec("brakeline_prediction_violations", "States outside the predicted set", COUNT),
    "unverified": MetricSpec("brakeline_unverified_decisions", "Decisions without a verified plan", COUNT),
    "token_rejected": MetricSpec(
        "brakeline_unvouched_requests", "Requests with a plan token that does not match", COUNT
    ),
    "not_finite": MetricSpec("brakeline_not_finite_proposals", "Proposed actions with NaN or infinity", COUNT),
    "decide_ms": MetricSpec("brakeline_decide_seconds", "Mean time of a decision", factor=1e-3),
    "busy": MetricSpec("brakeline_busy", "Share of the last second in which a safety service was busy"),
    "steps": MetricSpec("brakeline_steps", "Steps of an actor, or steps inserted by a learner", COUNT),
    "steps_per_s": MetricSpec("brakeline_steps_per_second", "Mean steps per second since the actor's start"),
    "fallbacks": MetricSpec("brakeline_fallbacks", "Steps along the committed plan without a decision", COUNT),
    "waits": MetricSpec("brakeline_waits", "Requests that a standing robot repeated", COUNT),
    "collisions": MetricSpec("brakeline_collisions", "Steps with a collision", COUNT),
    "round_trip_ms": MetricSpec("brakeline_round_trip_seconds", "Mean time from request to reply", factor=1e-3),
    "updates_per_s": MetricSpec("brakeline_updates_per_second", "Updates per second of a learner"),
    "missing": MetricSpec("brakeline_missing_steps", "Published steps that never reached the learner"),
    "duplicates": MetricSpec("brakeline_duplicate_steps", "Steps that arrived more than once", COUNT),
    "refused": MetricSpec("brakeline_refused_steps", "Steps that a learner refused", COUNT),
    "recorded": MetricSpec("brakeline_recorded", "Messages in a recorder's files", COUNT),
    "dropped": MetricSpec("brakeline_dropped", "Messages that a recorder dropped", COUNT),
    "waiting": MetricSpec("brakeline_waiting", "Backlog: steps of a learner, bytes of a recorder"),
}
CONNECTED = MetricSpec("brakeline_connected", "1 if the process is connected to the bus")
PUBLISHED = MetricSpec("brakeline_published", "Messages published, by topic", COUNT)


@dataclass(frozen=True)
class ProcessStatus:
    """The state of a process at the time of a request."""

    process: str
    live: bool  # its health thread works
    ready: bool  # it has started, is connected and is not stopping
    connected: bool
    figures: Mapping[str, float]
    published: Mapping[str, int]  # messages by key


class MetricsServer:
    """An HTTP server in threads of its own, until `close`."""

    def __init__(self, address: str, status: Callable[[], ProcessStatus]) -> None:
        """Start the server.

        Args:
            address: PORT on this machine, or HOST:PORT; port 0 selects a free one.
            status: called for each request.

        Raises:
            ValueError: the address has another form.
            OSError: the server cannot listen there.
        """
        host, _, port = address.rpartition(":")
        if not port.isdecimal():
            raise ValueError(f"--metrics {address}: PORT, or HOST:PORT")
        metrics = CollectorRegistry()
        metrics.register(ProcessCollector(status))

        class Handler(BoundedHandler, MetricsHandler):
            registry = metrics

            def do_GET(self) -> None:
                path = self.path.split("?")[0]
                if path == "/metrics":
                    super().do_GET()
                elif path == "/live":
                    self._answer(status().live)
                elif path == "/ready":
                    self._answer(status().ready)
                else:
                    self.reply_text(404, "there are /metrics, /live and /ready\n")

            def _answer(self, yes: bool) -> None:
                self.reply_text(200 if yes else 503, "yes\n" if yes else "no\n")

        self._server = BoundedServer((host or LOCALHOST, int(port)), Handler, own_port=False)
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class ProcessCollector:
    """Convert a process's status to metrics, each labelled with the process's name and role."""

    def __init__(self, status: Callable[[], ProcessStatus]) -> None:
        self._status = status

    def describe(self) -> Iterable[Metric]:
        """Return no names: the metrics depend on the status."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics of the current status."""
        status = self._status()
        labels = [status.process, status.process.replace(".", "-").split("-", 1)[0]]
        yield _family(CONNECTED, {(): float(status.connected)}, labels)
        for name, spec in FIGURES.items():
            if name in status.figures:
                yield _family(spec, {(): status.figures[name] * spec.factor}, labels)
        topics: Counter[str] = Counter()
        for key, count in status.published.items():
            topics[key.split("/", 1)[0]] += count
        counts: dict[tuple[str, ...], float] = {(topic,): float(count) for topic, count in sorted(topics.items())}
        yield _family(PUBLISHED, counts, labels, ("topic",))


def _family(
    spec: MetricSpec, values: Mapping[tuple[str, ...], float], labels: list[str], extra_names: tuple[str, ...] = ()
) -> Metric:
    kind = CounterMetricFamily if spec.is_counter else GaugeMetricFamily
    family = kind(spec.name, spec.help, labels=("process", "role", *extra_names))
    for extra, value in values.items():
        family.add_metric([*labels, *extra], value)
    return family
