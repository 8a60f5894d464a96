"""For `make docs`: pictures in results/ are in the site too; links to the repository's other files are words."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./(?!results/)[^)]*\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pictures of results/."""
    for picture in sorted((ROOT / "results").glob("*/*.png")):
        files.append(File(str(picture.relative_to(ROOT)), str(ROOT), config["site_dir"], config["use_directory_urls"]))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Pages are read in the repository too, where those pictures are a folder up."""
    return OUTSIDE.sub(r"\1", markdown).replace("](../results/", "](results/")
