"""Real autopilots: `$BRAKELINE_ARDUPILOT`, `$BRAKELINE_PX4`, else `../shared/ardupilot`, `../shared/px4` beside the
checkout; where there is none, the test is skipped by the variable's name."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from deploy.bench import sitl
from deploy.bench.sitl import KINDS as KINDS

ROOT = Path(__file__).parents[1]


def autopilot(kind: str, folder: Path) -> AbstractContextManager[tuple[str, int]]:
    """One that runs: (the URL for us, its system id)."""
    try:
        start = sitl.program(kind, ROOT.parent / "shared" / kind)
    except sitl.NoAutopilot as none:
        pytest.skip(str(none))
    return sitl.flying(kind, start, folder)
