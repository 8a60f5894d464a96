"""What a display needs to know of a run in progress."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path

from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.supervisor import SupervisedProcess
from brakeline.logs.metrics import Metrics


@dataclass
class View:
    """What a display needs to know of a run in progress."""

    config: RunConfig
    folder: Path
    metrics: Metrics
    children: list[SupervisedProcess]
    lines: deque[str]
    ending: bool = False
