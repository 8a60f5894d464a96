"""For `make docs`: what the site shows from elsewhere in the repository.

- Pictures in results/ are part of the site. Links to the repository's other files become words.
- `<!-- README: TITLE -->` becomes that section of the README, `<!-- README -->` its text above the first section.
- `<!-- HELP -->` becomes the help of each command.
- `<!-- NOTEBOOK: PATH -->` becomes the cells of a notebook with their outputs.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./(?!results/)[^)]*\)")
QUOTED = re.compile(r"<!-- README(?:: (?P<title>.+?))? -->")
NOTEBOOK = re.compile(r"<!-- NOTEBOOK: (.+?) -->")
COLUMNS = "76"  # of the help


def on_files(files: Files, config: Any) -> Files:
    """Add the pictures of results/."""
    for picture in sorted((ROOT / "results").glob("*/*.png")):
        files.append(File(str(picture.relative_to(ROOT)), str(ROOT), config["site_dir"], config["use_directory_urls"]))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the quoted parts, and turn links that are right in the repository into links of the site."""
    markdown = QUOTED.sub(lambda match: readme_section(match["title"]), markdown)
    markdown = NOTEBOOK.sub(lambda match: cells_of(ROOT / match[1]), markdown)
    if "<!-- HELP -->" in markdown:
        markdown = markdown.replace("<!-- HELP -->", help_of_commands())
    return OUTSIDE.sub(r"\1", markdown).replace("](../results/", "](results/")


def readme_section(title: str | None) -> str:
    """Return a section of the README without its heading, with links as a page in docs/ has them."""
    first, *sections = re.split(r"^#+ ", (ROOT / "README.md").read_text(), flags=re.MULTILINE)[1:]
    texts = dict(section.split("\n", 1) for section in sections)
    text = first.split("\n", 1)[1] if title is None else texts[title]
    return re.sub(r"\]\((?!https?:)", "](../", text.strip()).replace("](../docs/", "](")


def cells_of(notebook: Path) -> str:
    """Return the cells of a notebook after its title cell, with links as a page in docs/ has them."""
    parts = []
    for cell in json.loads(notebook.read_text())["cells"][1:]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            if picture := output.get("data", {}).get("image/png"):
                parts.append(f"![output](data:image/png;base64,{picture.strip()})")
            elif "text" in output:
                parts.append(f"```text\n{''.join(output['text']).strip()}\n```")
    return "\n\n".join(parts).replace("](../docs/", "](")


def help_of_commands() -> str:
    """Return a heading for each group and command, and what `brakeline COMMAND --help-all` prints."""
    from brakeline.deploy.cli import GROUPS, main

    os.environ |= {"COLUMNS": COLUMNS, "NO_COLOR": "1"}
    parts = []
    for group, commands in GROUPS.items():
        parts.append(f"## {group}\n")
        for name, entry in commands.items():
            shown = io.StringIO()
            with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
                main([name, "--help-all"])
            parts.append(f"### {name}\n\n{entry.summary}\n\n```text\n{shown.getvalue().strip()}\n```\n")
    return "\n".join(parts)
