"""What is scraped is what the processes say; what the dashboard and the autoscaler ask for is exported."""

import json
import re
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from brakeline.messaging.bus import BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.metrics_endpoint import FIGURES, MetricsServer, ProcessStatus
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.topics import LOG
from tests.waiting import until

DEPLOY = Path(__file__).parents[2] / "deploy"


def get(port, path):
    return urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10.0).read().decode()


def scraped(port):
    """Value by name and labels other than the process's."""
    return {
        (sample.name, sample.labels.get("topic", "")): (sample.value, sample.labels["process"], sample.labels["role"])
        for family in text_string_to_metric_families(get(port, "/metrics"))
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
        with pytest.raises(urllib.error.HTTPError, match="503"):
            get(port, "/ready")
        process.figures.update(decisions=7, decide_ms=2.5)
        process.bus.publisher(LOG)
        process.announce()
        assert get(port, "/ready") == get(port, "/live") == "yes\n"
        until(lambda: scraped(port).get(("brakeline_published_total", "health"), (0,))[0] >= 1, "a Health")
        metrics = scraped(port)
        assert metrics["brakeline_decisions_total", ""] == (7.0, "safety-0", "safety")
        assert metrics["brakeline_decide_seconds", ""][0] == pytest.approx(2.5e-3)
        assert metrics["brakeline_connected", ""][0] == 1.0 and metrics["brakeline_passed_over_total", ""][0] == 0.0
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(port, "/keys")
    with pytest.raises(urllib.error.URLError):
        get(port, "/metrics")


def test_who_is_stuck_does_not_live_and_who_is_cut_off_is_not_ready(exposed):
    stuck, cut = exposed(everything(live=False)), exposed(everything(ready=False, connected=False))
    with pytest.raises(urllib.error.HTTPError, match="503"):
        get(stuck, "/live")
    with pytest.raises(urllib.error.HTTPError, match="503"):
        get(cut, "/ready")
    assert get(cut, "/live") == "yes\n" and scraped(cut)["brakeline_connected", ""][0] == 0.0


def test_where_nothing_can_be_served_is_said(exposed):
    with pytest.raises(ValueError, match="HOST:PORT"):
        MetricsServer("nonsense", everything)
    with pytest.raises(OSError, match="in use"):
        MetricsServer(str(exposed(everything())), everything)


@pytest.mark.parametrize("path", ["grafana/brakeline.json", "kubernetes/autoscaler.yaml"])
def test_what_is_asked_for_is_exported(exposed, path):
    text = (DEPLOY / path).read_text()
    asked = set(re.findall(r"\bbrakeline_[a-z_]+", text))
    assert asked
    assert asked <= {name for name, _ in scraped(exposed(everything()))}
    if path.endswith(".json"):
        assert len(asked) > 15 and json.loads(text)["panels"]
