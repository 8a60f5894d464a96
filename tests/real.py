"""Real autopilots: `$BRAKELINE_ARDUPILOT`, `$BRAKELINE_PX4`, else `../shared/ardupilot`, `../shared/px4` beside the
checkout; where there is none, the test is skipped by the variable's name."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from benchmarks import sitl
from benchmarks.sitl import KINDS as KINDS

ROOT = Path(__file__).parents[1]


def autopilot(kind: str, folder: Path) -> AbstractContextManager[tuple[str, int]]:
    """One that runs: (the URL for us, its system id)."""
    try:
        start = _program(kind)
    except sitl.NoAutopilot as none:
        pytest.skip(str(none))
    return sitl.flying(kind, start, folder)


def autopilots(folder: Path) -> list[AbstractContextManager[tuple[str, int]]]:
    """One of each kind that there is."""
    vehicles, missing = [], []
    for kind in KINDS:
        try:
            vehicles.append(sitl.flying(kind, _program(kind), folder))
        except sitl.NoAutopilot as none:
            missing.append(str(none))
    if not vehicles:
        pytest.skip("; ".join(missing))
    return vehicles


def _program(kind: str) -> Path:
    return sitl.program(kind, ROOT.parent / "shared" / kind)
