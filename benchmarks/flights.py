"""Real autopilots among obstacles: their first flight, one behind the filter that came of it, and then policies.

Needs `$BRAKELINE_ARDUPILOT`, `$BRAKELINE_PX4`: folders whose `sitl FOLDER INSTANCE` runs one; what is not there is left
out. In real time: twenty minutes or thirty, and `--minutes` for each policy in each arena. What `--folder` has already
is not flown again. Collisions and clearances are the autopilot's own simulator's, not the estimate's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks import motion_capture, sitl
from benchmarks.timing import Words
from brakeline.deploy.interpreter import PYTHON

POLICIES, ARENAS = ("astar", "trained", "adversary"), ("default", "dense")
FIRST, SECOND, THIRD = 15.0, 5.0, 10.0  # minutes
PRACTICE = "0.15"  # share of steps at which it brakes as planned: what a model set is made of
BEYOND = 240.0  # s that a command may take beyond its flight: the estimator, the landing, the model set
# Some minutes of flight state little, and what comes of flying behind that is to be measured.
ACCEPTING = ("--accept-bound", "1")
TRUE = ("true collisions", "true clearance least m", "estimate off truth at most m")


@dataclass(frozen=True)
class Setup:
    """kind: of autopilot; parameters: what their owner would set; words: for `collect` and `fly`; cameras: it flies
    under motion capture; further: its last model set is of a third flight, long enough for envelopes as they are."""

    kind: str
    parameters: Mapping[str, float]
    words: tuple[str, ...] = ()
    cameras: bool = False
    further: bool = False


# ArduCopter 4.0 leads a position along with the velocity that it was given, and catches up with it by flying faster
# than asked: with less than this of it, it creeps after a stop, with more it overshoots. Upright it is quicker. Led to
# places, it has nothing to catch up with, and may be as stiff as it can.
CALM = {"PSC_POSXY_P": 0.5, "PSC_VELXY_I": 0.02, "PSC_POSZ_P": 1.0, "PSC_VELZ_P": 8.0}
STIFF = {"PSC_POSXY_P": 2.0, "PSC_POSZ_P": 1.0}
# PX4's SIH has an accelerometer, a gyro and a barometer of other noise than its estimator takes them for, and a GPS
# without delay.
HEARD = {
    "COM_OF_LOSS_T": 0.5,
    "EKF2_GPS_DELAY": 0.0,
    "EKF2_ACC_NOISE": 1.0,
    "EKF2_GYR_NOISE": 0.1,
    "EKF2_HGT_REF": 0,
    "EKF2_BARO_NOISE": 0.3,
}
# Who flies as fast as that must be quick to hold its place when setpoints stop.
ALERT = {"COM_OF_LOSS_T": 0.2, "COM_OBL_RC_ACT": 5, "MPC_ACC_HOR": 8.0, "MPC_JERK_AUTO": 40.0}
OUTDOORS, HEARING = "ardupilot", "px4"
# Who is led is at rest at the last place before it does anything else.
PATIENT = {**ALERT, "COM_OF_LOSS_T": 5.0, "MPC_XY_P": 2.0, "MPC_Z_P": 1.5}
LED, INDOORS = "ardupilot, led to places", "px4 with motion capture"
INDOORS_LED = "px4 with motion capture, led to places"
SETUPS = {
    OUTDOORS: Setup("ardupilot", CALM, further=True),
    HEARING: Setup("px4", HEARD),
    LED: Setup("ardupilot", STIFF, ("--lead",)),
    INDOORS: Setup("px4", {**HEARD, **motion_capture.PARAMETERS, **ALERT}, cameras=True),
    INDOORS_LED: Setup("px4", {**HEARD, **motion_capture.PARAMETERS, **PATIENT}, ("--lead",), cameras=True),
}


class Failed(RuntimeError):
    """A command ended without figures."""


def run(minutes: float, folder: Path) -> Words:
    """Rows: flights; columns: what they came to."""
    rows: Words = {}
    for name, setup in SETUPS.items():
        try:
            start = sitl.program(setup.kind)
        except sitl.NoAutopilot as none:
            print(none, file=sys.stderr)
            continue
        rows |= {f"{name}: {what}": row for what, row in _rows(Flights(name, start, folder / name), minutes)}
    return rows


def _rows(flights: Flights, minutes: float) -> Iterator[tuple[str, dict[str, float | str]]]:
    first = flights.first()
    yield "first flight", _learned(first)
    if "model" not in first:
        return
    yield "second flight", flown(flights.second)
    yield "certified by it", _certified(flights, "second", "--few")
    if flights.further:
        yield "third flight", flown(flights.third)
        yield "certified by that", _certified(flights, "third")
    for arena in ARENAS:
        for policy in POLICIES:
            yield f"{policy}, {arena}", flown(partial(flights.fly, policy, arena, minutes))
    yield from two(partial(flights.pair, minutes)).items()


def _certified(flights: Flights, name: str, *words: str) -> dict[str, float | str]:
    try:
        return certified(flights.certify(name, flights.data, *words))
    except Failed as error:  # too few windows: what follows is behind the model set of before
        return {"failed": str(error)}


@dataclass(frozen=True)
class Upset:
    """Other parameters than its setup's; or from a moment of the command on, s, and others from another one on."""

    parameters: Mapping[str, float] = field(default_factory=dict)
    begins: float = 0.0
    ends: float = 0.0
    afterwards: Mapping[str, float] = field(default_factory=dict)


class Flights:
    """In one setup, each from switching on; its data, logs and figures are kept in a folder."""

    def __init__(self, setup: str, start: Path, folder: Path) -> None:
        self._name, self._setup, self._start, self._folder = setup, SETUPS[setup], start, folder.absolute()
        self.data, self.further = self._folder / "data", self._setup.further

    @classmethod
    def beside(cls, other: Flights, name: str) -> Flights:
        """Of the same autopilot, with data and flights of their own in a folder of the other's."""
        return cls(other._name, other._start, other._folder / f"{name}-own")

    def first(self) -> dict[str, Any]:
        return self._figures("first", FIRST, "collect", "quadrotor", "--minutes", str(FIRST))

    def second(self) -> dict[str, Any]:
        """Behind the model set of the first, which a new one is to be made of."""
        return self.upset("second", SECOND, Upset(), "--practice", PRACTICE)

    def third(self) -> dict[str, Any]:
        """Behind the model set of the second, and as long as it takes to do without `--few`."""
        return self.upset("third", THIRD, Upset(), "--practice", PRACTICE)

    def certify(self, name: str, data: Path, *words: str) -> dict[str, Any]:
        """The model set of a flight's log, from then on in use in that folder; {"refused": …}: there is none."""
        kept = self._folder / f"{name}-certified.json"
        if not kept.exists():
            command = ["certify", str(self.run(name)), "--robot", "quadrotor-late", *words, "--use", *ACCEPTING]
            kept.write_text(told([*command, "--certificates", "residual", "--mode", "direct", "--json"], data, BEYOND))
        figures: dict[str, Any] = json.loads(kept.read_text())["residual"]["direct"]
        return figures

    def fly(self, policy: str, arena: str, minutes: float) -> dict[str, Any]:
        return self.upset(f"{policy}-{arena}", minutes, Upset(), "--policy", policy, "--arena", arena)

    def pair(self, minutes: float) -> dict[str, Any]:
        """Two of them in one run, which ask one service."""
        return self._kept("pair", minutes, partial(self._both, minutes))

    def upset(self, name: str, minutes: float, upset: Upset, *words: str) -> dict[str, Any]:
        out = ("--at-start", "--pictures", "0", "--out", str(self.run(name)))
        return self._figures(name, minutes, "fly", "--minutes", str(minutes), *words, *out, upset=upset)

    def run(self, name: str) -> Path:
        """The folder of a flight."""
        return self._folder / name

    def _figures(self, name: str, minutes: float, *words: str, upset: Upset = Upset()) -> dict[str, Any]:
        """Of a command, or of the time when it was run. Raises Failed, NoAutopilot."""
        return self._kept(name, minutes, partial(self._flown, minutes, words, upset))

    def _kept(self, name: str, minutes: float, fly: Callable[[], str]) -> dict[str, Any]:
        kept = self._folder / f"{name}.json"
        if not kept.exists():
            print(f"{self._name}: {name}, {minutes:g} minutes", file=sys.stderr)
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(fly())
        figures: dict[str, Any] = json.loads(kept.read_text())
        return figures

    def _flown(self, minutes: float, words: tuple[str, ...], upset: Upset) -> str:
        with ExitStack() as stack:
            url, system = self._switched_on(stack, {} if upset.ends else upset.parameters)
            stack.enter_context(self._in_between(upset, sitl.beside(self._setup.kind, system, url), system))
            command = [
                *words,
                *ACCEPTING,
                *self._setup.words,
                "--url",
                url,
                "--system",
                str(system),
                "--raise-limits",
                "--json",
            ]
            return told(command, self.data, 60.0 * minutes + BEYOND)

    def _both(self, minutes: float) -> str:
        with ExitStack() as stack:
            urls, systems = zip(*(self._switched_on(stack, {}) for _ in range(2)), strict=True)
            command = ["fly", "--minutes", str(minutes), "--url", *urls, "--systems", *map(str, systems)]
            command += [
                *ACCEPTING,
                *self._setup.words,
                "--at-start",
                "--pictures",
                "0",
                "--out",
                str(self.run("pair")),
                "--raise-limits",
                "--json",
            ]
            return told(command, self.data, 60.0 * minutes + BEYOND)

    def _switched_on(self, stack: ExitStack, parameters: Mapping[str, float]) -> tuple[str, int]:
        """One more of them until the stack ends: (the URL for us, its system id)."""
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        return stack.enter_context(switched_on(self._setup, self._start, folder, parameters))

    @contextmanager
    def _in_between(self, upset: Upset, url: str, system: int) -> Iterator[None]:
        over = threading.Event()

        def change() -> None:
            if not over.wait(upset.begins):
                sitl.configure(url, system, upset.parameters)
            if not over.wait(upset.ends - upset.begins):
                sitl.configure(url, system, upset.afterwards)

        thread = threading.Thread(target=change, daemon=True)
        if upset.ends:
            thread.start()
        try:
            yield
        finally:
            over.set()
            if upset.ends:
                thread.join()


@contextmanager
def switched_on(
    setup: Setup, start: Path, folder: Path, parameters: Mapping[str, float] = MappingProxyType({})
) -> Iterator[tuple[str, int]]:
    """One of that setup with other parameters besides, which runs in a folder: (the URL for us, its system id)."""
    with ExitStack() as stack:
        lasting = {**setup.parameters, **parameters}
        url, system = stack.enter_context(sitl.flying(setup.kind, start, folder, lasting))
        if setup.cameras:
            stack.enter_context(motion_capture.captured(sitl.hall(system), system))
        yield url, system


def told(words: list[str], data: Path, seconds: float) -> str:
    """The last line of a command of ours, which works in that folder of data sets. Raises Failed."""
    environment = os.environ | {"BRAKELINE_DATA": str(data)}
    done = subprocess.run(
        [*PYTHON, "-m", "brakeline.deploy.cli", *words],
        check=False,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        timeout=seconds,
    )
    if not (lines := done.stdout.splitlines()):
        raise Failed(f"{' '.join(words)}: no figures, status {done.returncode}")
    return lines[-1]


def _learned(first: dict[str, Any]) -> dict[str, float | str]:
    row: dict[str, float | str] = {name: first[name] for name in ("minutes", "periods", "level")}
    return row | certified(first) | {"missing": "; ".join(first["missing"])}


def certified(figures: dict[str, Any]) -> dict[str, float | str]:
    """What a statement says."""
    wanted = ["windows", "violations", "bound_plan", "bound_step", "half_width_rest", "half_width_full", "refused"]
    return {name: figures[name] for name in wanted if name in figures}


def flown(fly: Callable[[], dict[str, Any]]) -> dict[str, float | str]:
    """What a flight came to; it may not have taken off, for want of room to hover."""
    try:
        figures = fly()
    except Failed as error:
        return {"failed": str(error)}
    flight, contained = figures["flight"], figures["containment"]
    row: dict[str, float | str] = {name: figures[name] for name in ("steps", "episodes", "goals")}
    row |= {"mean speed m/s": figures["mean_speed"] or 0.0}
    row |= {"interventions": f"{figures['interventions'] / max(1, figures['steps']):.1%}"}
    row |= {"outside": f"{contained['violations']} of {contained['steps']}"}
    if plans := figures.get("plans"):
        row |= {"stops outside": f"{plans['outside']} of {plans['flown']}"}
    row |= {name: flight[name] for name in TRUE if name in flight}
    return row | {"in time": f"{flight['answers in time share'] or 0.0:.1%}"}


def two(fly: Callable[[], dict[str, Any]]) -> Words:
    """A row for both, and one for what is each one's own."""
    whole = flown(fly)
    if "failed" in whole:
        return {"two at once": whole}
    rows: Words = {"two at once": {name: value for name, value in whole.items() if name not in (*TRUE, "in time")}}
    for actor, flight in fly()["flights"].items():
        row: dict[str, float | str] = {name: flight[name] for name in TRUE if name in flight}
        rows[f"two at once, {actor}"] = row | {"in time": f"{flight['answers in time share'] or 0.0:.1%}"}
    return rows
