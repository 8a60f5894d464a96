"""A disk of a few megabytes, which can be filled up. It takes Linux and root."""

from __future__ import annotations

import os
import subprocess
from contextlib import AbstractContextManager, suppress
from pathlib import Path

BLOCK = 4096  # bytes


class SmallVolume(AbstractContextManager["SmallVolume"]):
    """A file system of its own at a folder, until the end of the block."""

    def __init__(self, folder: Path, mib: int) -> None:
        """Raises CalledProcessError if nothing can be mounted here."""
        self.folder, self._ballast = folder, folder / "ballast"
        folder.mkdir(parents=True, exist_ok=True)
        options = ("-t", "tmpfs", "-o", f"size={mib}m,nr_inodes=10000", "tmpfs")
        subprocess.run(["mount", *options, str(folder)], check=True, capture_output=True)

    def fill(self) -> None:
        """Leave no byte free."""
        with self._ballast.open("ab") as file, suppress(OSError):
            while free := os.statvfs(self.folder).f_bavail:
                os.posix_fallocate(file.fileno(), os.fstat(file.fileno()).st_size, max(free // 2, 1) * BLOCK)

    def free(self) -> None:
        """Give the space back."""
        self._ballast.unlink(missing_ok=True)

    def close(self) -> None:
        subprocess.run(["umount", "--lazy", str(self.folder)], check=False, capture_output=True)

    def __exit__(self, *_: object) -> None:
        self.close()
