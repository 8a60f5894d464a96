"""Real autopilots among obstacles: their first flight, then policies behind the filter that came of it.

Needs `$BRAKELINE_ARDUPILOT`, `$BRAKELINE_PX4`: folders whose `sitl FOLDER INSTANCE` runs one; what is not there is left
out. In real time: a quarter of an hour, and `--minutes` for each policy in each arena. What `--folder` has already is
not flown again. Collisions and clearances are the autopilot's own simulator's, not the estimate's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from deploy.bench import sitl
from deploy.bench.timing import Words
from deploy.interpreter import PYTHON

POLICIES, ARENAS = ("astar", "trained", "adversary"), ("default", "dense")
FIRST = 15.0  # minutes
BEYOND = 240.0  # s that a command may take beyond its flight: the estimator, the landing, the model set
TRUE = ("true collisions", "true clearance least m", "estimate off truth at most m")

# What their owner would set. ArduCopter 4.0 leads a position along with the velocity that it was given, and catches up
# with it by flying faster than asked. PX4's SIH has an accelerometer, a gyro and a barometer of other noise than its
# estimator takes them for, and a GPS without delay.
SET: dict[str, dict[str, float]] = {
    "ardupilot": {"PSC_POSXY_P": 0.5, "PSC_VELXY_I": 0.02, "PSC_POSZ_P": 0.5},
    "px4": {
        "EKF2_GPS_DELAY": 0.0,
        "EKF2_ACC_NOISE": 1.0,
        "EKF2_GYR_NOISE": 0.1,
        "EKF2_HGT_REF": 0,
        "EKF2_BARO_NOISE": 0.3,
    },
}


class Failed(RuntimeError):
    """A command ended without figures."""


def run(minutes: float, folder: Path) -> Words:
    """Rows: flights; columns: what they came to."""
    rows: Words = {}
    for kind in sitl.KINDS:
        try:
            start = sitl.program(kind)
        except sitl.NoAutopilot as none:
            print(none, file=sys.stderr)
            continue
        flights = Flights(kind, start, folder / kind)
        first = flights.first()
        rows[f"{kind}: first flight"] = _learned(first)
        if "model" not in first:
            continue
        for arena in ARENAS:
            for policy in POLICIES:
                rows[f"{kind}: {policy}, {arena}"] = _flown(flights.fly(policy, arena, minutes))
    return rows


class Flights:
    """Of one kind of autopilot, each from switching on; its data, logs and figures are kept in a folder."""

    def __init__(self, kind: str, start: Path, folder: Path) -> None:
        self._kind, self._start, self._folder = kind, start, folder.absolute()

    def first(self) -> dict[str, Any]:
        return self._figures("first", FIRST, "collect", "quadrotor", "--minutes", str(FIRST))

    def fly(self, policy: str, arena: str, minutes: float) -> dict[str, Any]:
        name = f"{policy}-{arena}"
        words = ("fly", "--policy", policy, "--arena", arena, "--minutes", str(minutes), "--at-start")
        return self._figures(name, minutes, *words, "--pictures", "0", "--out", str(self._folder / name))

    def _figures(self, name: str, minutes: float, *words: str) -> dict[str, Any]:
        """Of a command, or of the time when it was run. Raises Failed, NoAutopilot."""
        kept = self._folder / f"{name}.json"
        if not kept.exists():
            print(f"{self._kind}: {name}, {minutes:g} minutes", file=sys.stderr)
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(self._flown(minutes, *words))
        figures: dict[str, Any] = json.loads(kept.read_text())
        return figures

    def _flown(self, minutes: float, *words: str) -> str:
        with (
            tempfile.TemporaryDirectory() as folder,
            sitl.flying(self._kind, self._start, Path(folder), SET[self._kind]) as (url, system),
        ):
            command = [*PYTHON, "-m", "deploy.cli", *words, "--url", url, "--system", str(system), "--raise-limits"]
            done = subprocess.run(
                [*command, "--json"],
                check=False,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"BRAKELINE_DATA": str(self._folder / "data")},
                timeout=60.0 * minutes + BEYOND,
            )
        lines = done.stdout.splitlines()
        if not lines:
            raise Failed(f"{' '.join(words)}: no figures, status {done.returncode}")
        return lines[-1]


def _learned(first: dict[str, Any]) -> dict[str, float | str]:
    wanted = ("minutes", "periods", "level", "windows", "violations", "bound_plan")
    found: dict[str, float | str] = {name: first[name] for name in wanted if name in first}
    return found | {"missing": "; ".join(first["missing"])}


def _flown(figures: dict[str, Any]) -> dict[str, float | str]:
    flight, contained = figures["flight"], figures["containment"]
    row: dict[str, float | str] = {name: figures[name] for name in ("steps", "episodes", "goals")}
    row |= {"mean speed m/s": figures["mean_speed"] or 0.0}
    row |= {"interventions": f"{figures['interventions'] / max(1, figures['steps']):.1%}"}
    row |= {"outside": f"{contained['violations']} of {contained['steps']}"}
    row |= {name: flight[name] for name in TRUE if name in flight}
    return row | {"in time": f"{flight['answers in time share'] or 0.0:.1%}"}
