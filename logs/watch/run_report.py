"""Render the report of a run on this machine for the live page, when somebody asks for it first."""

from __future__ import annotations

import threading
from pathlib import Path


class RunReport:
    """The report of the run in a folder. Rendering takes seconds, so it happens once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._page = b""

    def page(self) -> bytes:
        """Return the page.

        Raises:
            LogError, OSError: the folder has no log that can be read.
        """
        from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs  # imported only when they are needed
        from brakeline.logs.report_page import render

        with self._lock:
            if not self._page:
                analysis = analyse_runs(self.folder, AnalysisOptions(pictures=True))
                self._page = render(analysis.figures(), analysis.by_label()).encode()
            return self._page
