"""Fly real autopilots among obstacles: a first flight, more flights behind the filter if wanted, and then policies.

Needs `$BRAKELINE_ARDUPILOT` and `$BRAKELINE_PX4`: folders whose `sitl FOLDER INSTANCE` runs one. The benchmark leaves
out what is missing. In real time: twenty minutes or thirty, and `--minutes` for each policy in each arena. It does not
repeat flights that `--folder` has. Collisions and clearances come from the autopilot's own simulator, not from the
estimate.
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
FIRST_MINUTES, SECOND_MINUTES, THIRD_MINUTES = 15.0, 5.0, 10.0  # minutes
PRACTICE = "0.15"  # share of steps at which it practises the planned stop: a model set needs such steps
OVERHEAD = 240.0  # s that a command may take besides its flight: estimator, landing, model set
# A few minutes of flight give a loose bound. The benchmark measures flights behind it all the same.
ACCEPT_ANY = ("--accept-bound", "1")
ACCEPT_ONE_FLIGHT = ("--accept-bound", "0.03")  # of mode one-step
WINDOWS = ("beyond", "beyond_plan", "beyond_widened")  # counts of windows outside (`TubeStats`)
TRUTH_FIGURES = ("true collisions", "true clearance least m", "estimate off truth at most m")


@dataclass(frozen=True)
class Setup:
    """An autopilot as its owner would set it up.

    Attributes:
        kind: of autopilot.
        parameters: of the autopilot.
        words: options of `collect` and `fly`.
        cameras: it flies under motion capture.
        third_flight: its last model set is of a third flight, long enough without `--few`.
        outside: `--outside` of the only model set, of mode one-step and from the first flight. 0 for linear model sets
            of a second or third flight.
    """

    kind: str
    parameters: Mapping[str, float]
    words: tuple[str, ...] = ()
    cameras: bool = False
    third_flight: bool = False
    outside: float = 0.0

    @property
    def accepting(self) -> tuple[str, str]:
        """The options that accept the bound of the setup's model sets."""
        return ACCEPT_ONE_FLIGHT if self.outside else ACCEPT_ANY


# ArduCopter 4.0 moves a target position along with the requested velocity, and flies faster than requested to catch up
# with it. With lower gains it creeps after a stop, with higher ones it overshoots. With position targets (`--lead`) it
# has nothing to catch up with, so the gains can be high.
ARDUPILOT_LOW_GAINS = {"PSC_POSXY_P": 0.5, "PSC_VELXY_I": 0.02, "PSC_POSZ_P": 1.0, "PSC_VELZ_P": 8.0}
ARDUPILOT_HIGHER_GAINS = {**ARDUPILOT_LOW_GAINS, "PSC_VELXY_P": 3.0, "PSC_VELXY_D": 1.0}
ARDUPILOT_POSITION_GAINS = {"PSC_POSXY_P": 2.0, "PSC_POSZ_P": 1.0}
# The sensors of PX4's SIH have other noise than its estimator assumes, and its GPS has no delay.
PX4_SIH_SENSORS = {
    "COM_OF_LOSS_T": 0.5,
    "EKF2_GPS_DELAY": 0.0,
    "EKF2_ACC_NOISE": 1.0,
    "EKF2_GYR_NOISE": 0.1,
    "EKF2_HGT_REF": 0,
    "EKF2_BARO_NOISE": 0.3,
}
# A vehicle that flies so fast must hold its place soon when setpoints stop.
PX4_QUICK_FAILSAFE = {"COM_OF_LOSS_T": 0.2, "COM_OBL_RC_ACT": 5, "MPC_ACC_HOR": 8.0, "MPC_JERK_AUTO": 40.0}
ARDUPILOT, PX4 = "ardupilot", "px4"
# With position targets the vehicle is at rest at the last target before it does anything else.
PX4_POSITION_TARGETS = {**PX4_QUICK_FAILSAFE, "COM_OF_LOSS_T": 5.0, "MPC_XY_P": 2.0, "MPC_Z_P": 1.5}
ARDUPILOT_LED, PX4_CAMERAS = "ardupilot, led to places", "px4 with motion capture"
PX4_CAMERAS_LED = "px4 with motion capture, led to places"
ARDUPILOT_ONCE, PX4_CAMERAS_ONCE = "ardupilot, one flight", "px4 with motion capture, one flight"
SETUPS = {
    ARDUPILOT: Setup("ardupilot", ARDUPILOT_LOW_GAINS, third_flight=True),
    PX4: Setup("px4", PX4_SIH_SENSORS),
    ARDUPILOT_LED: Setup("ardupilot", ARDUPILOT_POSITION_GAINS, ("--lead",)),
    PX4_CAMERAS: Setup("px4", {**PX4_SIH_SENSORS, **motion_capture.PARAMETERS, **PX4_QUICK_FAILSAFE}, cameras=True),
    ARDUPILOT_ONCE: Setup("ardupilot", ARDUPILOT_HIGHER_GAINS, outside=0.005),
    PX4_CAMERAS_ONCE: Setup(
        "px4", {**PX4_SIH_SENSORS, **motion_capture.PARAMETERS, **PX4_QUICK_FAILSAFE}, cameras=True, outside=0.005
    ),
    PX4_CAMERAS_LED: Setup(
        "px4", {**PX4_SIH_SENSORS, **motion_capture.PARAMETERS, **PX4_POSITION_TARGETS}, ("--lead",), cameras=True
    ),
}


class NoFigures(RuntimeError):
    """A command ended without figures."""


def run(minutes: float, folder: Path) -> Words:
    """Return a row for each flight, with its outcome."""
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
    yield "first flight", _first_flight_row(first)
    if "model" not in first:
        return
    if flights.one_flight:
        yield "certified by it", validation_row(flights.certify_first())
    else:
        yield "second flight", flight_row(flights.second)
        yield "certified by it", _certify_row(flights, "second", "--few")
    if flights.third_flight:
        yield "third flight", flight_row(flights.third)
        yield "certified by that", _certify_row(flights, "third")
    for arena in ARENAS:
        for policy in POLICIES:
            yield f"{policy}, {arena}", flight_row(partial(flights.fly, policy, arena, minutes))
    yield from pair_rows(partial(flights.pair, minutes)).items()


def _certify_row(flights: Flights, name: str, *words: str) -> dict[str, float | str]:
    try:
        return validation_row(flights.certify(name, flights.data, *words))
    except NoFigures as error:  # too few windows: the next flights use the model set of before
        return {"failed": str(error)}


@dataclass(frozen=True)
class ParameterChange:
    """Parameters that differ from those of the setup.

    Attributes:
        begins, ends: times after the start of the command, s. The autopilot has `parameters` from `begins` on, and
            `afterwards` from `ends` on. With ends = 0 it has `parameters` from the start.
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    begins: float = 0.0
    ends: float = 0.0
    afterwards: Mapping[str, float] = field(default_factory=dict)


class Flights:
    """Flights in one setup, each with a new start of the autopilot. Data, logs and figures stay in a folder."""

    def __init__(self, setup: str, start: Path, folder: Path) -> None:
        self._name, self._setup, self._start, self._folder = setup, SETUPS[setup], start, folder.absolute()
        self.data, self.third_flight = self._folder / "data", self._setup.third_flight
        self.one_flight = self._setup.outside > 0.0  # the first flight is the only one before the policies

    @classmethod
    def with_own_data(cls, other: Flights, name: str) -> Flights:
        """Return flights of the same autopilot with data of their own, in a folder of the other's."""
        return cls(other._name, other._start, other._folder / f"{name}-own")

    def first(self) -> dict[str, Any]:
        """Record the first data set and make its model set."""
        return self._figures("first", FIRST_MINUTES, "collect", "quadrotor", "--minutes", str(FIRST_MINUTES))

    def second(self) -> dict[str, Any]:
        """Fly behind the model set of the first flight, to make a new one."""
        return self.fly_changed("second", SECOND_MINUTES, ParameterChange(), "--practice", PRACTICE)

    def third(self) -> dict[str, Any]:
        """Fly behind the model set of the second flight, long enough to certify without `--few`."""
        return self.fly_changed("third", THIRD_MINUTES, ParameterChange(), "--practice", PRACTICE)

    def certify(self, name: str, data: Path, *words: str) -> dict[str, Any]:
        """Put the model set of a flight's log to use in a data folder. Returns its validation, or {"refused": …}."""
        path = self._folder / f"{name}-certified.json"
        if not path.exists():
            linear = "--certificates", "residual", "--mode", "direct"
            path.write_text(self._certify(self.run(name), data, *words, *linear))
        figures: dict[str, Any] = json.loads(path.read_text())["residual"]["direct"]
        return figures

    def certify_first(self) -> dict[str, Any]:
        """Put a model set of mode one-step to use, from the first flight. Returns its validation."""
        flown = self.data / "quadrotor" / "flown.safetensors"
        printed = self._certify(flown, self.data, "--outside", str(self._setup.outside))
        figures: dict[str, Any] = json.loads(printed)["residual"]["one-step"]
        return figures

    def _certify(self, source: Path, data: Path, *words: str) -> str:
        command = ["certify", "quadrotor-late", "--data", str(source), *words, "--use", *self._setup.accepting]
        return printed_figures([*command, "--json"], data, OVERHEAD)

    def fly(self, policy: str, arena: str, minutes: float) -> dict[str, Any]:
        """Fly a policy in an arena."""
        return self.fly_changed(f"{policy}-{arena}", minutes, ParameterChange(), "--policy", policy, "--arena", arena)

    def pair(self, minutes: float) -> dict[str, Any]:
        """Fly two vehicles in one run, which share a safety service."""
        return self._figures("pair", minutes, "fly", "--minutes", str(minutes), *self._out("pair"), vehicles=2)

    def fly_changed(self, name: str, minutes: float, change: ParameterChange, *words: str) -> dict[str, Any]:
        """Fly with changed parameters."""
        return self._figures(name, minutes, "fly", "--minutes", str(minutes), *words, *self._out(name), change=change)

    def _out(self, name: str) -> tuple[str, ...]:
        return "--at-start", "--pictures", "0", "--out", str(self.run(name))

    def run(self, name: str) -> Path:
        return self._folder / name

    def _figures(
        self, name: str, minutes: float, *words: str, change: ParameterChange = ParameterChange(), vehicles: int = 1
    ) -> dict[str, Any]:
        """Return the figures of a command, now or of an earlier run. Raises NoFigures, NoAutopilot."""
        path = self._folder / f"{name}.json"
        if not path.exists():
            print(f"{self._name}: {name}, {minutes:g} minutes", file=sys.stderr)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(self._run_command(minutes, words, change, vehicles))
        figures: dict[str, Any] = json.loads(path.read_text())
        return figures

    def _run_command(self, minutes: float, words: tuple[str, ...], change: ParameterChange, vehicles: int) -> str:
        with ExitStack() as stack:
            parameters = {} if change.ends else change.parameters
            places = [Path(stack.enter_context(tempfile.TemporaryDirectory())) for _ in range(vehicles)]
            switched = [started_autopilot(self._setup, self._start, place, parameters) for place in places]
            urls, systems = zip(*map(stack.enter_context, switched), strict=True)
            stack.enter_context(
                self._in_between(change, sitl.beside(self._setup.kind, systems[0], urls[0]), systems[0])
            )
            option = "--system" if vehicles == 1 else "--systems"
            where = ("--url", *urls, option, *map(str, systems), "--raise-limits", "--json")
            command = [*words, *self._setup.accepting, *self._setup.words, *where]
            return printed_figures(command, self.data, 60.0 * minutes + OVERHEAD)

    @contextmanager
    def _in_between(self, change: ParameterChange, url: str, system: int) -> Iterator[None]:
        """Change the parameters at the times of the change, until the end of the block."""
        over = threading.Event()

        def switch() -> None:
            if not over.wait(change.begins):
                sitl.configure(url, system, change.parameters)
            if not over.wait(change.ends - change.begins):
                sitl.configure(url, system, change.afterwards)

        thread = threading.Thread(target=switch, daemon=True)
        if change.ends:
            thread.start()
        try:
            yield
        finally:
            over.set()
            if change.ends:
                thread.join()


@contextmanager
def started_autopilot(
    setup: Setup, start: Path, folder: Path, parameters: Mapping[str, float] = MappingProxyType({})
) -> Iterator[tuple[str, int]]:
    """Start an autopilot of a setup in a folder, with further parameters. Yields its URL and its system id."""
    with ExitStack() as stack:
        lasting = {**setup.parameters, **parameters}
        url, system = stack.enter_context(sitl.flying(setup.kind, start, folder, lasting))
        if setup.cameras:
            stack.enter_context(motion_capture.captured(sitl.hall(system), system))
        yield url, system


def printed_figures(words: list[str], data: Path, seconds: float) -> str:
    """Return the last line that a command of ours prints; data: its folder of data sets. Raises NoFigures."""
    command, environment = [*PYTHON, "-m", "brakeline.deploy.cli", *words], os.environ | {"BRAKELINE_DATA": str(data)}
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True, env=environment, timeout=seconds)
    if not (lines := done.stdout.splitlines()):
        raise NoFigures(f"{' '.join(words)}: no figures, status {done.returncode}")
    return lines[-1]


def _first_flight_row(first: dict[str, Any]) -> dict[str, float | str]:
    row: dict[str, float | str] = {name: first[name] for name in ("minutes", "periods", "level")}
    return row | validation_row(first) | {"missing": "; ".join(first["missing"])}


def validation_row(figures: dict[str, Any]) -> dict[str, float | str]:
    """Return the figures of a validation."""
    wanted = ["windows", "violations", "bound_plan", "bound_step", "half_width_rest", "half_width_full", "refused"]
    return {name: figures[name] for name in wanted if name in figures}


def flight_row(fly: Callable[[], dict[str, Any]]) -> dict[str, float | str]:
    """Return the outcome of a flight, or that it failed: without room to hover it does not take off."""
    try:
        figures = fly()
    except NoFigures as error:
        return {"failed": str(error)}
    flight, contained = figures["flight"], figures["containment"]
    row: dict[str, float | str] = {name: figures[name] for name in ("steps", "episodes", "goals")}
    row |= {"mean speed m/s": figures["mean_speed"] or 0.0}
    row |= {"interventions": f"{figures['interventions'] / max(1, figures['steps']):.1%}"}
    row |= {"outside": f"{contained['violations']} of {contained['steps']}"}
    if plans := figures.get("plans"):
        row |= {"stops outside": f"{plans['outside']} of {plans['flown']}", "widened": plans["widening"]}
        row |= {f"windows {name}": f"{plans[name]} of {plans['scored']}" for name in WINDOWS}
    return row | _vehicle_row(flight)


def _vehicle_row(flight: dict[str, Any]) -> dict[str, float | str]:
    row: dict[str, float | str] = {name: flight[name] for name in TRUTH_FIGURES if name in flight}
    return row | {"in time": f"{flight['answers in time share'] or 0.0:.1%}"}


def pair_rows(fly: Callable[[], dict[str, Any]]) -> Words:
    """Return a row for both vehicles together, and one for each of them."""
    whole = flight_row(fly)
    if "failed" in whole:
        return {"two at once": whole}
    both = {name: value for name, value in whole.items() if name not in (*TRUTH_FIGURES, "in time")}
    return {"two at once": both} | {
        f"two at once, {actor}": _vehicle_row(flight) for actor, flight in fly()["flights"].items()
    }
