"""Render the report: one self-contained HTML page about logs, for the browser or for paper.

The page contains its styles, scripts and data. Its content security policy forbids requests to other hosts and allows
only these scripts and styles, by their hashes. Python writes the tables, so that they need no scripts; the scripts draw
the figures from the data in the page.
"""

from __future__ import annotations

import json
import math
import time
from base64 import b64encode
from collections.abc import Iterable, Mapping
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined

from brakeline.logs.decision_stats import PARTS
from brakeline.logs.episode_stats import ENDS, Figures
from brakeline.logs.json_values import finite
from brakeline.logs.log_analysis import SETUP
from brakeline.logs.tube_stats import stated
from brakeline.logs.viewer import SCRIPTS, STYLES, viewer_file
from brakeline.messaging import stated_share
from brakeline.messaging.atomic_files import whole_or_nothing

OWN_STYLES = ("report.css",)
PAGE = "report.html.j2"
OWN_SCRIPTS = ("save.js", "groups.js", "learning.js", "charts.js", "episodes.js", "main.js")

RATES = (  # name, unit, description
    ("goals", "episodes", "goals reached"),
    ("collisions", "episodes", "collisions with fixed obstacles"),
    ("contacts_moving", "episodes", "contacts with moving obstacles while the robot moves"),
    ("contacts_standing", "episodes", "times that an obstacle ran into the standing robot"),
    ("contacts_robots", "episodes", "contacts with other robots"),
    ("timeouts", "episodes", "timeouts"),
    ("interventions", "steps", "steps with an intervention of the filter"),
    ("violations", "steps compared", "measured states outside the predicted set"),
)


def render(figures: Figures, runs: Mapping[str, tuple[Figures, Figures]]) -> str:
    """Render the HTML page of the runs of a `LogAnalysis`: what they share, their curves, and each run by itself."""
    environment = Environment(
        loader=FunctionLoader(_text), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, percent=percent, moment=moment, pretty=pretty, raw=raw, hashed=hashed)
    environment.filters.update(within=within, stated=stated, bound=stated_share.percent)
    return environment.get_template(PAGE).render(
        f=figures,
        several=len(runs) > 1,
        title=", ".join(figures["runs"]) or "no run",
        missing=missing(figures),
        parts=PARTS,
        runs=[
            {
                "label": label,
                "mark": f"run{place}-" if place else "",  # prefix of the element ids of this run
                "f": own | {"rates": rates(own)},
                "kept": episode_counts(pictures["galleries"].values()),
            }
            for place, (label, (own, pictures)) in enumerate(runs.items())
        ],
        style="\n".join([*map(viewer_file, STYLES), *map(_text, OWN_STYLES)]),
        script="\n".join(['"use strict";', *map(viewer_file, SCRIPTS), *map(_text, OWN_SCRIPTS)]),
        groups=embedded(figures.get("groups", [])),
        data=embedded(
            [
                {"run": label, "setup": {name: own[name] for name in SETUP}, "training": own["training"]} | pictures
                for label, (own, pictures) in runs.items()
            ]
        ),
    )


def write(path: Path, figures: Figures, runs: Mapping[str, tuple[Figures, Figures]]) -> None:
    """Write the page to a file; create its folder if needed. Raises OSError: an earlier page stays."""
    page = render(figures, runs)
    with whole_or_nothing(path) as place:
        place.write_text(page, encoding="utf-8")


def rates(figures: Figures) -> list[Figures]:
    """Return the rows of the table of rates: description, count, number of trials, interval."""
    counts = {name: (figures[name], figures[of], of) for name, of, _ in RATES[:-1]}
    counts["violations"] = figures["containment"]["violations"], figures["containment"]["steps"], "steps compared"
    return [
        dict(zip(("count", "of", "unit"), counts[name], strict=True))
        | {"name": name, "what": what, "interval": figures["intervals"][name]}
        for name, _, what in RATES
        if figures["outcomes_stated"] or name not in ENDS
    ]


def episode_counts(galleries: Iterable[Figures]) -> dict[str, int]:
    """Return how many episodes the page has with every step (`whole`), how many at all, and how many the log has."""
    counts = [(len(gallery["episodes"]), len(gallery["rest"]), gallery["total"]) for gallery in galleries]
    whole, rest, total = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0, 0)
    return {"whole": whole, "all": whole + rest, "total": total}


def missing(figures: Figures) -> list[str]:
    """Describe damage, lost and malformed messages of the logs."""
    lines = list(figures["cuts"])
    lost = {key: topic["missing"] for key, topic in figures["topics"].items() if topic["missing"]}
    lines += [f"{key}: {count} messages were published, but are not in the log" for key, count in lost.items()]
    if figures["malformed"]:
        lines.append(f"{figures['malformed']} messages are malformed")
    return lines


def embedded(data: Any) -> str:
    """Encode JSON for a script element: nothing in it can end the element."""
    text = json.dumps(finite(data), separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def hashed(text: str) -> str:
    """Return the hash by which a content security policy allows a script or a style."""
    return f"sha256-{b64encode(sha256(text.encode()).digest()).decode()}"


def number(value: float | None) -> str:
    """Format a number with 3 significant digits and separated thousands; a dash for None and NaN."""
    if value is None or not math.isfinite(value):
        return "–"
    if isinstance(value, int) or (value == int(value) and abs(value) >= 1000):
        return f"{int(value):,}".replace(",", "\u202f")
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}".replace(",", "\u202f")


def percent(share: float | None) -> str:
    """Format a share as a percentage, or as a dash if it is None or not finite."""
    if share is None or not math.isfinite(share):
        return "–"
    value = 100.0 * share
    return f"{value:.1f} %" if value >= 1.0 or value == 0.0 else f"{value:.2g} %"


def within(interval: tuple[float, float] | None) -> str:
    """Format the confidence interval of a rate."""
    return "" if interval is None else f"[{percent(interval[0])}, {percent(interval[1])}]"


def moment(seconds: float | None) -> str:
    """Format a time since the Unix epoch, in UTC."""
    return "–" if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(seconds))


def pretty(value: Any) -> str:
    """Encode a value as indented JSON."""
    return json.dumps(value, indent=2)


def raw(value: Any) -> str:
    """Encode a value as `--json` does, for programs that read the page."""
    return json.dumps(finite(value))


def _text(name: str) -> str:
    return files(__name__).joinpath(name).read_text(encoding="utf-8")
