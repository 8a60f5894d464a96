"""The report: one HTML page about logs that needs nothing but itself, in the browser or on paper.

Styles, scripts and data are in the page; its own policy forbids every request to another host, and every script and
style but these, by their hashes. Tables are written here, so that they can be read without scripts; drawings are made
by the scripts, from the data in the page.
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
from brakeline.logs.episode_stats import Figures
from brakeline.logs.log_analysis import SETUP
from brakeline.logs.tube_stats import stated

STYLES = ("report.css",)
PAGE = "report.html.j2"
PIECES = ("headline.html.j2", "details.html.j2")
SCRIPTS = ("svg.js", "save.js", "learning.js", "charts.js", "arena.js", "episodes.js", "main.js")

RATES = (  # name, of what, in words
    ("goals", "episodes", "goals reached"),
    ("collisions", "episodes", "collisions with what stands still"),
    ("contacts_moving", "episodes", "contacts with what moves, in motion"),
    ("contacts_standing", "episodes", "times that it was run into while it stood"),
    ("contacts_robots", "episodes", "contacts with other robots of its world"),
    ("timeouts", "episodes", "timeouts"),
    ("interventions", "steps", "steps in which the filter stepped in"),
)


def render(figures: Figures, runs: Mapping[str, tuple[Figures, Figures]]) -> str:
    """Render the HTML page of the runs of a `LogAnalysis`: what they share, their curves, and each run by itself."""
    environment = Environment(
        loader=FunctionLoader(_text), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, percent=percent, moment=moment, pretty=pretty, raw=raw, hashed=hashed)
    environment.filters.update(within=within, stated=stated)
    return environment.get_template(PAGE).render(
        f=figures,
        several=len(runs) > 1,
        title=", ".join(figures["runs"]) or "no run",
        missing=missing(figures),
        parts=PARTS,
        runs=[
            {
                "label": label,
                "mark": f"run{place}-" if place else "",  # before names that a page has once
                "f": own | {"rates": rates(own)},
                "kept": sum(len(gallery["episodes"]) for gallery in pictures["galleries"].values()),
            }
            for place, (label, (own, pictures)) in enumerate(runs.items())
        ],
        style="\n".join(map(_text, STYLES)),
        script="\n".join(['"use strict";', *map(_text, SCRIPTS)]),
        data=embedded([_drawn(label, own, pictures) for label, (own, pictures) in runs.items()]),
    )


def _drawn(label: str, figures: Figures, pictures: Figures) -> Figures:
    """What the drawings need of a run; the whole of it is what `analyse --json` is for."""
    setup = {name: figures[name] for name in SETUP}
    return {"run": label, "setup": setup, "training": figures["training"]} | pictures


def write(path: Path, figures: Figures, runs: Mapping[str, tuple[Figures, Figures]]) -> None:
    """Write the page to a file; its folder is made if it is missing."""
    page = render(figures, runs)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")


def rates(figures: Figures) -> list[Figures]:
    """Rows of the table of rates: what, how often, of how many, and the interval."""
    rows = [
        {"name": name, "what": what, "count": figures[name], "of": figures[of], "unit": of}
        | {"interval": figures["intervals"][name]}
        for name, of, what in RATES
    ]
    contained = figures["containment"]
    outside = {"name": "violations", "what": "measured states outside the predicted set", "unit": "steps compared"}
    rows.append(
        outside
        | {"count": contained["violations"], "of": contained["steps"], "interval": figures["intervals"]["violations"]}
    )
    return rows


def missing(figures: Figures) -> list[str]:
    """What the logs lack, in words."""
    said = list(figures["cuts"])
    lost = {key: topic["missing"] for key, topic in figures["topics"].items() if topic["missing"]}
    said += [f"{key}: {count} messages were published and are in no file" for key, count in lost.items()]
    if figures["malformed"]:
        said.append(f"{figures['malformed']} messages are not of their type, or say what can't be handled")
    return said


def embedded(data: Any) -> str:
    """JSON that may stand in a script element: nothing in it can end the element."""
    text = json.dumps(finite(data), separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def hashed(text: str) -> str:
    """As a content security policy names a script or a style."""
    return f"sha256-{b64encode(sha256(text.encode()).digest()).decode()}"


def finite(value: Any) -> Any:
    """The value, with None for each number that is not finite."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def number(value: float | None, digits: int = 3) -> str:
    """For people: thousands apart, no more digits than matter; a dash for None, and for what is no number."""
    if value is None or not math.isfinite(value):
        return "–"
    if isinstance(value, int) or (value == int(value) and abs(value) >= 1000):
        return f"{int(value):,}".replace(",", "\u202f")
    return f"{value:.{digits}g}" if abs(value) < 1000 else f"{value:,.0f}".replace(",", "\u202f")


def percent(share: float | None) -> str:
    if share is None or not math.isfinite(share):
        return "–"
    value = 100.0 * share
    return f"{value:.1f} %" if value >= 1.0 or value == 0.0 else f"{value:.2g} %"


def within(interval: tuple[float, float] | None) -> str:
    """An interval of a share, to stand below it."""
    return "" if interval is None else f"[{percent(interval[0])}, {percent(interval[1])}]"


def moment(seconds: float | None) -> str:
    """A time since the Unix epoch, in UTC."""
    return "–" if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(seconds))


def pretty(value: Any) -> str:
    return json.dumps(value, indent=2)


def raw(value: Any) -> str:
    """The value as `--json` prints it, for programs that read the page."""
    return json.dumps(finite(value))


def _text(name: str) -> str:
    return files(__name__).joinpath(name).read_text(encoding="utf-8")


def names() -> Iterable[str]:
    """The files that a page is made of."""
    return (PAGE, *PIECES, *STYLES, *SCRIPTS)
