"""Fly real autopilots under changed conditions: wind, weak motors, a load, noise, a GPS that jumps, cameras that fail.

Run it after `flights`, in the same folder. A* flies among obstacles behind the model set from there; `certify` makes a
new model set from that flight's log; A* flies behind the new one. With the model set of a single flight (one-step), a
certifier makes new ones during the flight instead, if it can. In real time: eight minutes for each condition,
eighteen with a certifier.
"""

from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path

from benchmarks import sitl
from benchmarks.flights import HEARING, INDOORS, LED, OUTDOORS, PRACTICE, SETUPS, Flights, Upset, certified, flown
from benchmarks.timing import Words

BEFORE, AFTER, ADAPTING = 5.0, 3.0, 18.0  # minutes
JUMP = 4e-5  # degrees, 4.4 m

LASTING: dict[str, dict[str, Upset]] = {  # by kind of autopilot
    "ardupilot": {
        "wind of 5 m/s, turbulent": Upset({"SIM_WIND_SPD": 5.0, "SIM_WIND_TURB": 1.0}),
        "a motor at 80 %": Upset({"SIM_ENGINE_MUL": 0.8}),
        "GPS noise of 0.5 m": Upset({"SIM_GPS_NOISE": 0.5}),
    },
    "px4": {"20 % heavier": Upset({"SIH_MASS": 1.2}), "motors at 80 %": Upset({"SIH_T_MAX": 4.0})},
}
JUMPS = {"GPS off by 4.4 m for 10 s": Upset({"SIM_GPS_GLITCH_X": JUMP}, 150.0, 160.0, {"SIM_GPS_GLITCH_X": 0.0})}
PASSING: dict[str, dict[str, Upset]] = {  # by setup
    OUTDOORS: JUMPS,
    LED: JUMPS,
    HEARING: {"no GPS for 10 s": Upset({"SIM_GPS_USED": 3}, 150.0, 160.0, {"SIM_GPS_USED": 10})},
    INDOORS: {"no cameras for 3 s": Upset({"EKF2_EV_CTRL": 0}, 150.0, 153.0, {"EKF2_EV_CTRL": 7})},
}


def run(folder: Path) -> Words:
    """Return rows for each change: the flight before, the new model set, and the flight behind it."""
    rows: Words = {}
    for name, setup in SETUPS.items():
        try:
            flights = Flights(name, sitl.program(setup.kind), folder / name)
        except sitl.NoAutopilot as none:
            print(none, file=sys.stderr)
            continue
        rows |= _upsets(flights, name, LASTING[setup.kind], PASSING.get(name, {}))
    return rows


def _upsets(flights: Flights, setup: str, lasting: dict[str, Upset], passing: dict[str, Upset]) -> Words:
    rows: Words = {}
    for what, upset in (lasting | passing).items():
        name = what.replace(" ", "-").replace("/", "").replace("%", "").replace(",", "")
        minutes, words = (ADAPTING, ("--adapt",)) if flights.once else (BEFORE, ("--practice", PRACTICE))
        row = flown(partial(flights.upset, name, minutes, upset, *words))
        rows[f"{setup}: {what}"] = row
        if what in lasting and not flights.once and "failed" not in row:
            rows |= _again(flights, setup, what, name, upset)
    return rows


def _again(flights: Flights, setup: str, what: str, name: str, upset: Upset) -> Words:
    """Certify the flight's log, and fly behind the new model set."""
    renewed = Flights.beside(flights, name)
    shutil.copytree(flights.data, renewed.data, dirs_exist_ok=True)
    figures = flights.certify(name, renewed.data, "--few")
    rows: Words = {f"{setup}: {what}, certified again": certified(figures)}
    if "refused" not in figures:
        rows[f"{setup}: {what}, behind that"] = flown(partial(renewed.upset, f"{name}-again", AFTER, upset))
    return rows
