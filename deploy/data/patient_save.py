"""Save a recording. While the disk is full, wait: the recording exists only in memory."""

from __future__ import annotations

import errno
import time
from pathlib import Path

from brakeline.deploy.progress import console
from brakeline.safety.model.dataset import Dataset

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
RETRY, PATIENCE = 5.0, 600.0  # s between two attempts, and until the last one


def save_patiently(data: Dataset, path: Path) -> None:
    """Save a data set. If the disk is full, say so, and try again for `PATIENCE`. Raises OSError: in vain."""
    last_at, waiting = time.monotonic() + PATIENCE, False
    while True:
        try:
            data.save(path)
            return
        except OSError as error:
            if error.errno not in FULL or time.monotonic() > last_at:
                raise
            if not waiting:
                console.print(
                    f"{path} is not saved yet: {error.strerror}. Make room: the recording is in memory, and saving it "
                    f"is tried again for {PATIENCE / 60.0:.0f} minutes",
                    markup=False,
                )
            waiting = True
        time.sleep(RETRY)
