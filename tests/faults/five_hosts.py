"""A run over five hosts, with keys: each process is started by its own command, and started again when it dies.

host 1   router-0  safety-0  recorder-0         host 4   actors of the second robot
host 2   router-1  safety-1  recorder-1         host 5   learners
host 3   actors of the first robot

Every process knows both routers and uses the other one when its own is gone. The routers have a cable between them
besides the switch. The clocks of three hosts are hours off. A delay applies between the actors and the routers.
"""

from __future__ import annotations

import signal
import subprocess
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.interpreter import PYTHON
from brakeline.logs.metrics import Metrics
from brakeline.messaging.bus import Bus, BusSettings, Sample
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.task import robot_with_task
from brakeline.messaging.topics import RECORDED
from brakeline.safety.methods import load
from brakeline.safety.model.model_config import DDPC, ModelConfig
from brakeline.safety.service.plan_token import write_key
from brakeline.safety.service.signature import ModelSigner, write_signer
from tests.faults.network_hosts import Hosts

CABLE = Path(__file__).with_name("cable_delay.py")  # a program: nothing installs the tests as a package
PORT = 7447
CLOCKS = {2: -7.0, 3: 5.0, 4: -3.0}  # h ahead of the others
LEARNERS, MOVED = 5, 2  # the hosts that learners alternate between
PATIENCE = 60.0  # s until a process is there
TURN = 0.05  # s
# Networks too small to learn much: the run shows which processes live and what is lost.
SMALL = ("--learner.td3.hidden", 32, 32, "--learner.td3.batch", 32, "--learner.td3.warmup", 200)


@dataclass
class Spot:
    """A process and its host."""

    name: str
    host: int
    words: tuple[str, ...]
    popen: subprocess.Popen[bytes] | None = None

    @property
    def alive(self) -> bool:
        return self.popen is not None and self.popen.poll() is None

    @property
    def done(self) -> bool:
        """Whether it ended by itself, without an error."""
        return self.popen is not None and self.popen.poll() == 0


@dataclass
class Fleet(AbstractContextManager["Fleet"]):
    """The processes, with their keys, signed models, logs and checkpoints in a folder.

    Attributes:
        delay: s each way between actors and routers, and up to as much again, at random.
        metrics: what a viewer on the bus hears.
    """

    folder: Path
    hosts: Hosts
    robots: tuple[str, ...] = ("ground",)
    steps: int = 100_000  # of each robot
    seed: int = 0
    recorders: int = 2
    delay: float = 0.0
    learning: tuple[object, ...] = SMALL
    metrics: Metrics = field(default_factory=Metrics)
    spots: dict[str, Spot] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Make the models, and record their data, if they are not there."""
        self._prepare()
        for i in (1, 2):
            link = () if i == 1 else ("--connect", f"tls/{self.hosts.joined(1)}:{PORT}")
            self._add(f"router-{i - 1}", i, "router", "--listen", f"tls/0.0.0.0:{PORT}", *link)
        for i in (1, 2):
            self._add(f"safety-{i - 1}", i, "safety", *self.robots, *self._to(i))
        for i in range(1, self.recorders + 1):
            log = self.log(i - 1)
            self._add(f"recorder-{i - 1}", i, "recorder", log, "--pictures", 0, *self._to(i))
        for i, robot in enumerate(self.robots):
            self._add(
                f"learner-{robot}", LEARNERS, "learner", robot, "--out", self.folder / f"learner-{robot}",
                "--resume-if-any", "--steps", self.steps, "--seed", self.seed,
                "--learner.checkpoint-every", 300, *self.learning, *self._to(1 + i),
            )  # fmt: skip
            to = self._far(3 + i, 1 + i) if self.delay else self._to(1 + i)
            self._add(f"actor-{robot}-0", 3 + i, "actor", robot, "--seed", self.seed, *to)

    def log(self, recorder: int) -> Path:
        return self.folder / f"recorder-{recorder}" / "run.mcap"

    def start(self) -> None:
        """Start every process, and the viewer."""
        for host in range(3, 3 + len(self.robots)) if self.delay else ():
            ports = [f"0.0.0.0:{PORT + i}={self.hosts.address(1 + i)}:{PORT}" for i in (0, 1)]
            delay = str(self.delay)
            words = [*PYTHON, str(CABLE), *ports, "--delay", delay, "--jitter", delay]
            self.hosts.start(host, words, self.folder / f"delay-{host}.out")
        for name in self.spots:
            self.launch(name)
        self._bus = Bus(BusSettings(connect=self._endpoints(1), keys=self.folder / "keys", patience=PATIENCE), "viewer")
        for topic in RECORDED:
            self._bus.subscribe(topic, self._hear)

    def launch(self, name: str, host: int | None = None) -> None:
        """Start a process, on another host if one is given."""
        spot = self.spots[name]
        spot.host = host or spot.host
        self.log(0).parent.mkdir(exist_ok=True)
        data = str(self.folder / "data")
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "BRAKELINE_DATA": data}
        spot.popen = self.hosts.start(spot.host, list(spot.words), self.folder / f"{name}.out", **threads)

    def kill(self, name: str, signal_: signal.Signals = signal.SIGKILL) -> None:
        popen = self.spots[name].popen
        assert popen is not None
        popen.send_signal(signal_)
        popen.wait(PATIENCE)

    def keep(self) -> None:
        """Start processes again that have died, as a container engine does."""
        for spot in self.spots.values():
            if not spot.alive and not spot.done:
                self.launch(spot.name)

    def living(self) -> frozenset[str]:
        """Return the processes that the viewer hears."""
        return self._bus.living()

    def taken(self, robot: str) -> int:
        """Return the number of a robot's steps that the viewer has heard."""
        tallies = self.metrics.actors.copy()
        return sum(tally.steps for name, tally in tallies.items() if name.startswith(f"actor-{robot}"))

    def learned(self, robot: str) -> int:
        """Return the number of steps that a robot's learner has received, by its latest message."""
        known = self.metrics.learners.get(robot)
        return 0 if known is None else int(known.steps)

    def said(self, process: str) -> dict[str, float]:
        """Return the latest figures of a process."""
        known = self.metrics.processes.get(process)
        return {} if known is None else dict(known.figures)

    def end(self) -> None:
        """End the processes: first the others, then the recorders, then the routers."""
        for name in sorted(self.spots, key=lambda name: ("recorder" in name) + 2 * ("router" in name)):
            if self.spots[name].alive:
                self.kill(name, signal.SIGTERM)

    def close(self) -> None:
        if hasattr(self, "_bus"):
            self._bus.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _hear(self, sample: Sample) -> None:
        self.metrics.add(sample.key, sample.message(), sample.received)

    def _prepare(self) -> None:
        keys = self.folder / "keys"
        authority = Authority(keys)
        hosts = [self.hosts.address(i) for i in (1, 2, 3, 4)] + [self.hosts.joined(i) for i in (1, 2)]
        names = [f"{role}-{i}" for role in ("router", "safety", "recorder") for i in (0, 1)]
        names += [name for robot in self.robots for name in (f"learner-{robot}", f"actor-{robot}-0")]
        for name in ("viewer", *names):
            authority.issue(name, hosts)
        write_signer(keys)
        write_key(keys)
        signer = ModelSigner.load(keys)
        for name in self.robots:
            robot = robot_with_task(name)
            method_for(robot, DDPC, ModelConfig())
            path = method_path(robot, DDPC, ModelConfig())
            signer.sign(load(path)).save(self.folder / "data" / robot.name / path.name)

    def _add(self, name: str, host: int, *words: object) -> None:
        common = ("--name", name, "--keys", self.folder / "keys")
        self.spots[name] = Spot(name, host, (*PYTHON, "-m", "brakeline.deploy.cli", *map(str, (*words, *common))))

    def _to(self, first: int) -> tuple[str, ...]:
        """Return the options to connect to both routers, `first` first."""
        return ("--connect", *self._endpoints(first))

    def _far(self, host: int, first: int) -> tuple[str, ...]:
        """Return the same options, through the delays of a host."""
        return ("--connect", *(f"tls/{self.hosts.address(host)}:{PORT + i - 1}" for i in (first, 3 - first)))

    def _endpoints(self, first: int) -> tuple[str, ...]:
        return tuple(f"tls/{self.hosts.address(i)}:{PORT}" for i in (first, 3 - first))
