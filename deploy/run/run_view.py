"""Define what a display shows of a running run."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path

from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.supervisor import SupervisedProcess
from brakeline.logs.metrics import Metrics


@dataclass
class RunView:
    """The state of a running run that a display shows."""

    config: RunConfig
    folder: Path
    metrics: Metrics
    processes: list[SupervisedProcess]
    lines: deque[str]  # latest warnings
    ending: bool = False  # the launcher ends the processes
