"""Test a simulated ROS 2 robot that a node of another implementation drives at obstacles.

Time is simulated and each period waits for its command, so the results do not depend on other load on the machine.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from mcap.reader import make_reader
from mcap_ros2_support_fast.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from brakeline.deploy.data import model_store
from brakeline.messaging.free_ports import free_endpoint
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND
from tests.system.runs import BRAKELINE
from tests.waiting import PATIENCE, until

DRIVER = Path(__file__).with_name("ros2_driver.py")
STEADY = ("--sim-time", "--lockstep")  # at the pace of real time: while a test waits, the robot leaves the cores alone
SIMULATED = (*STEADY, "--factor", 6)
GRAPH = """
import json, sys, time
from zenoh_ros2_sdk.discovery import get_topic_info, get_topic_names_and_types
where = {"domain_id": 0, "router_port": int(sys.argv[1]), "timeout": 2.0}
for _ in range(20):  # what does not answer in time, on a busy machine, is not in an answer
    found = dict(get_topic_names_and_types(**where))
    info = get_topic_info("/cmd_vel", verbose=True, **where)
    if info is not None and info.publishers and len(found) >= 8:
        break
    time.sleep(0.5)
print(json.dumps({"topics": found, "publishers": [(end.node_name, end.qos) for end in info.publishers]}))
"""


@pytest.fixture(scope="session")
def late_folder(data_folder: Path) -> Path:
    """`$BRAKELINE_DATA` with the ground robot's model set in real time."""
    model_store.model_for(GROUND.in_real_time(), ModelConfig())
    return data_folder


class Bench:
    """Processes of a simulated robot, the filter before it, and the driver. They are killed at the end of the block."""

    def __init__(self, folder: Path, *bridge: object, filtered: bool = True, node: tuple[object, ...] = ()) -> None:
        self.folder, self._endpoint = folder, free_endpoint()
        self._started: list[subprocess.Popen[bytes]] = []
        self.port = self._endpoint.rsplit(":", 1)[1]
        self._home = folder / "home"  # the SDK may edit git's configuration there
        self._home.mkdir(parents=True)
        self.robot = self.start("bridge", *BRAKELINE, "bridge-sim", "--listen", self._endpoint, "--json", *bridge)
        if filtered:
            words = ("ros2", "ground", "--router", self._endpoint, "--json", *node)
            self.filter = self.start("filter", *BRAKELINE, *words)
        self.driver = self.start("driver", sys.executable, DRIVER, self.port, *([] if filtered else ["--direct"]))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._started:
            process.kill()
            process.wait()

    def start(self, name: str, *words: object) -> subprocess.Popen[bytes]:
        environment = os.environ | ({"HOME": str(self._home)} if name in ("driver", "graph") else {})
        with (self.folder / f"{name}.out").open("w") as out, (self.folder / f"{name}.err").open("w") as err:
            process = subprocess.Popen([*map(str, words)], stdout=out, stderr=err, env=environment)
        self._started.append(process)
        return process

    def said(self, name: str) -> dict[str, Any]:
        """Return the last JSON object that a process printed; empty before the first one.

        A line without its end is still being written, and is left for the next look.
        """
        whole, _, _ = (self.folder / f"{name}.out").read_text().rpartition("\n")
        return json.loads(whole.splitlines()[-1]) if whole else {}

    def errors(self, name: str) -> str:
        return (self.folder / f"{name}.err").read_text()[-3000:]

    def end(self, patience: float) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Wait for the end of the robot, and end the filter. Returns the last output of robot, filter and driver."""
        self.robot.wait(patience)
        self.filter.send_signal(signal.SIGINT)
        assert self.filter.wait(PATIENCE) == 0, self.errors("filter")
        return self.said("bridge"), self.said("filter"), self.said("driver")


def rammed(
    folder: Path, arena: str, seed: int, seconds: float, *node: object, dropped: float = 0.0
) -> tuple[dict[str, Any], ...]:
    """Return the last output of robot, filter and driver after `seconds` of simulated time."""
    bridge = ("--arena", arena, "--seed", seed, "--seconds", seconds)
    bridge += ("--perception", "scan", "--dropped", dropped) if dropped else ()
    with Bench(folder, *SIMULATED, *bridge, node=("--sim-time", *node)) as bench:
        figures = bench.end(PATIENCE + 2.0 * seconds)
    assert figures[0], bench.errors("bridge")
    return figures


@pytest.fixture(scope="module")
def run(
    late_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, tuple[dict[str, Any], ...]]]:
    """Simulate 80 s, and record a bag of them."""
    folder = tmp_path_factory.mktemp("ros2")
    yield folder / "bag", rammed(folder, "default", 1, 80.0, "--bag", folder / "bag")


def test_raw_commands_that_ram_hit_nothing(run: Any) -> None:
    robot, node, driver = run[1]
    print(robot, node)
    assert robot["collisions"] == 0 and robot["closest"] > 0.0
    assert robot["driven"] > 1.0 and node["commands"] > 100 and driver["scans"] > 100
    assert node["adjusted"] + node["failsafe"] > 10 and node["allowed"] > 50
    assert node["left the predicted set"] <= 0.03 * node["periods"] and node["passed over"] == 0


def test_the_same_without_the_filter_collides(tmp_path: Path) -> None:
    with Bench(tmp_path, *SIMULATED, "--seed", 1, "--seconds", 20.0, filtered=False) as bench:
        bench.robot.wait(3.0 * PATIENCE)
        assert bench.said("bridge")["collisions"] > 0, bench.errors("driver")


def test_a_bag_is_one_to_readers_of_bags(run: Any) -> None:
    bag: Path = run[0]
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts.keys() >= {
            *("/odom", "/scan", "/clock", "/tf_static", "/cmd_vel_raw", "/cmd_vel", "/diagnostics"),
            "/brakeline/markers",
        }
        assert counts["/tf_static"] == 1 and counts["/cmd_vel"] >= 330 and counts["/scan"] >= 330
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert stamps == sorted(stamps) and len(stamps) == sum(counts.values())
    seen: Counter[str] = Counter()
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        mcap = make_reader(file, decoder_factories=[DecoderFactory()])
        assert mcap.get_header().profile == "ros2"
        for schema, channel, _, decoded in mcap.iter_decoded_messages():
            assert schema is not None and schema.encoding == "ros2msg" and channel.message_encoding == "cdr"
            seen[channel.topic] += 1
            if channel.topic == "/cmd_vel":
                assert 0.0 <= decoded.linear.x <= 0.25 and abs(decoded.angular.z) <= 0.5
    assert seen == counts


def test_it_is_seen_in_the_graph_and_stops_when_it_is_killed(late_folder: Path, tmp_path: Path) -> None:
    with Bench(tmp_path, *STEADY, "--seed", 2, node=("--sim-time",)) as bench:
        until(
            lambda: bench.said("driver").get("delays"),
            lambda: (
                f"a raw command goes through: {bench.said('driver')} {bench.said('filter')} {bench.errors('filter')}"
            ),
        )
        graph = bench.start("graph", sys.executable, "-c", GRAPH, bench.port)
        assert graph.wait(PATIENCE) == 0, bench.errors("graph")
        listed = bench.said("graph")
        kinds = {
            "/cmd_vel": "geometry_msgs/msg/Twist",
            "/cmd_vel_raw": "geometry_msgs/msg/Twist",
            "/odom": "nav_msgs/msg/Odometry",
            "/scan": "sensor_msgs/msg/LaserScan",
            "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
            "/brakeline/markers": "visualization_msgs/msg/MarkerArray",
        }
        assert {topic: kind for topic, [kind] in listed["topics"].items() if topic in kinds} == kinds
        assert listed["publishers"] == [["brakeline", "::,10:,:,:,,"]]
        bench.filter.kill()
        time.sleep(5.0)  # a period without a command lasts a second there
        bench.robot.send_signal(signal.SIGINT)
        assert bench.robot.wait(PATIENCE) == 0, bench.errors("bridge")
        robot = bench.said("bridge")
        assert robot["timeouts"] >= 1 and robot["collisions"] == 0


@pytest.mark.long
def test_in_real_time_it_hits_nothing_and_says_what_delay_it_adds(late_folder: Path, tmp_path: Path) -> None:
    """Two minutes by this machine's clock; the driver measures from its publishing to what comes out."""
    with Bench(tmp_path, "--seed", 3, "--seconds", 120.0) as bench:
        robot, node, driver = bench.end(2.0 * PATIENCE)
    delays = sorted(driver["delays"])
    print(robot, node, f"{len(delays)} delays: p50 {delays[len(delays) // 2]:.3f} s, worst {delays[-1]:.3f} s")
    assert robot["collisions"] == 0 and delays[len(delays) // 2] < 0.4


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_with_beams_without_information_it_drives_on_and_hits_nothing(late_folder: Path, tmp_path: Path) -> None:
    """Four arenas, two of them dense, a simulated minute in each, for each share of such beams."""
    for dropped in (0.0, 0.01, 0.05, 0.1):
        total: Counter[str] = Counter()
        for seed in range(4):
            arena, folder = "dense" if seed % 2 else "default", tmp_path / f"{dropped:g}-{seed}"
            robot, node, _ = rammed(folder, arena, seed, 60.0, dropped=dropped)
            assert robot["collisions"] == 0, (dropped, seed)
            total.update({name: node[name] for name in ("periods", "allowed", "adjusted", "failsafe")})
        print(dropped, dict(total), f"{total['allowed'] / total['periods']:.1%} allowed")
        assert total["allowed"] > 0.5 * total["periods"]


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_an_hour_of_ramming_hits_nothing(late_folder: Path, tmp_path: Path) -> None:
    """60 arenas, half of them dense, a simulated minute in each."""
    total: Counter[str] = Counter()
    for seed in range(60):
        robot, node, _ = rammed(tmp_path / f"{seed}", "dense" if seed % 2 else "default", seed, 60.0)
        assert robot["collisions"] == 0, seed
        total.update({name: robot[name] for name in ("seconds", "driven", "collisions")})
        total.update({name: node[name] for name in ("periods", "allowed", "adjusted", "failsafe", "commands")})
        total["left the predicted set"] += node["left the predicted set"]
    print(dict(total))
    assert total["seconds"] >= 3600 and total["driven"] > 60.0
