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
from benchmarks.flights import (
    ARDUPILOT,
    ARDUPILOT_LED,
    PRACTICE,
    PX4,
    PX4_CAMERAS,
    SETUPS,
    Flights,
    ParameterChange,
    flight_row,
    validation_row,
)
from benchmarks.timing import Words

BEFORE, AFTER, ADAPTING = 5.0, 3.0, 18.0  # minutes
JUMP = 4e-5  # degrees, 4.4 m

LASTING: dict[str, dict[str, ParameterChange]] = {  # by kind of autopilot
    "ardupilot": {
        "wind of 5 m/s, turbulent": ParameterChange({"SIM_WIND_SPD": 5.0, "SIM_WIND_TURB": 1.0}),
        "a motor at 80 %": ParameterChange({"SIM_ENGINE_MUL": 0.8}),
        "GPS noise of 0.5 m": ParameterChange({"SIM_GPS_NOISE": 0.5}),
    },
    "px4": {"20 % heavier": ParameterChange({"SIH_MASS": 1.2}), "motors at 80 %": ParameterChange({"SIH_T_MAX": 4.0})},
}
JUMPS = {
    "GPS off by 4.4 m for 10 s": ParameterChange({"SIM_GPS_GLITCH_X": JUMP}, 150.0, 160.0, {"SIM_GPS_GLITCH_X": 0.0})
}
PASSING: dict[str, dict[str, ParameterChange]] = {  # by setup
    ARDUPILOT: JUMPS,
    ARDUPILOT_LED: JUMPS,
    PX4: {"no GPS for 10 s": ParameterChange({"SIM_GPS_USED": 3}, 150.0, 160.0, {"SIM_GPS_USED": 10})},
    PX4_CAMERAS: {"no cameras for 3 s": ParameterChange({"EKF2_EV_CTRL": 0}, 150.0, 153.0, {"EKF2_EV_CTRL": 7})},
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
        rows |= _changed_flights(flights, name, LASTING[setup.kind], PASSING.get(name, {}))
    return rows


def _changed_flights(
    flights: Flights, setup: str, lasting: dict[str, ParameterChange], passing: dict[str, ParameterChange]
) -> Words:
    rows: Words = {}
    for what, change in (lasting | passing).items():
        name = what.replace(" ", "-").replace("/", "").replace("%", "").replace(",", "")
        minutes, words = (ADAPTING, ("--adapt",)) if flights.one_flight else (BEFORE, ("--practice", PRACTICE))
        row = flight_row(partial(flights.fly_changed, name, minutes, change, *words))
        rows[f"{setup}: {what}"] = row
        if what in lasting and not flights.one_flight and "failed" not in row:
            rows |= _again(flights, setup, what, name, change)
    return rows


def _again(flights: Flights, setup: str, what: str, name: str, change: ParameterChange) -> Words:
    """Certify the flight's log, and fly behind the new model set."""
    renewed = Flights.with_own_data(flights, name)
    shutil.copytree(flights.data, renewed.data, dirs_exist_ok=True)
    figures = flights.certify(name, renewed.data, "--few")
    rows: Words = {f"{setup}: {what}, certified again": validation_row(figures)}
    if "refused" not in figures:
        rows[f"{setup}: {what}, behind that"] = flight_row(partial(renewed.fly_changed, f"{name}-again", AFTER, change))
    return rows
