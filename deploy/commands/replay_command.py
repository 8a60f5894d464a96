"""`brakeline replay`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from brakeline.deploy.commands.common_options import LATEST, Certificate, Mode, console, say_json
from brakeline.deploy.data.certification import certified
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.progress import under_way
from brakeline.deploy.run.replay_run import ROUNDING, Instead, replay
from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.logs.log_length import count
from brakeline.messaging.robot import Robot
from brakeline.messaging.topics import EXCHANGE
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelConfig, ModelSet

ANY_BOUND = 1.0  # no robot is driven: what would have been decided is asked, however loose the statement
DIFFERENT = 1  # exit status: decisions differ by more than rounding though nothing was asked to be different


@contextmanager
def quiet(name: str) -> Iterator[None]:
    """Nothing but errors from that logger."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@dataclass(frozen=True)
class Replay:
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (LATEST,)
    """Log files, or run folders."""
    certificate: Certificate | None = None
    """What would have been decided with this certificate (of the data set in use, or of --data)?"""
    mode: Mode = "direct"
    """Of --certificate or --data."""
    data: Path | None = None
    """What would have been decided with a model set from this data set (a file that `collect` wrote)?"""
    margin: float | None = None
    """What would have been decided with this clearance margin, m, instead of the model set's own?"""
    json: bool = False

    def run(self) -> int:
        instead = self._instead()
        total = count(list(self.logs), EXCHANGE)
        with (
            under_way("asking every question again", total) as advance,
            quiet("brakeline.safety"),  # its warnings were about the robots of then
        ):
            result = replay(list(self.logs), instead, advance)
        figures = result.figures() | {"log": [str(path) for path in self.logs], "instead": self._words()}
        if self.json:
            say_json(figures)
        else:
            show(figures)
        return DIFFERENT if instead is None and result.different else 0

    def _words(self) -> dict[str, Any]:
        """What was asked to be different."""
        given = {"certificate": self.certificate, "data": self.data and str(self.data), "margin": self.margin}
        chosen = {name: value for name, value in given.items() if value is not None}
        return chosen | ({"mode": self.mode} if self.certificate or self.data else {})

    def _instead(self) -> Instead | None:
        """The filter to be asked in place of the one that was in use, made once for each robot; None: the same."""
        if self.certificate is None and self.data is None and self.margin is None:
            return None
        model_config = ModelConfig(self.certificate or "residual", self.mode)
        filters: dict[str, Filter] = {}
        make: Callable[[Robot], ModelSet]
        if self.data is not None:
            model, _ = certified(Dataset.load(self.data), model_config)
            make = lambda robot: model  # noqa: E731
        else:
            make = lambda robot: model_for(robot, model_config, ANY_BOUND)  # noqa: E731

        def chosen(robot: Robot) -> Filter:
            name = robot.name
            if name not in filters:
                filters[name] = Filter(make(robot), self.margin)
                if filters[name].robot.name != name:
                    raise ValueError(f"{self.data} is of {filters[name].robot.name}, and the log of {name}")
            return filters[name]

        return chosen


def show(figures: dict[str, Any]) -> None:
    """The figures of a replay, on stdout."""
    compared = figures["requests"] - figures["unanswered"]
    asked = ", ".join(f"{name} {value}" for name, value in figures["instead"].items())
    question = f"asked again with {asked}" if asked else "asked again"
    console.print(f"{question}: {compared} requests; {figures['unanswered']} had no answer")
    console.print(f"identical in every bit: {share(figures['identical'], compared)}")
    largest = f"; at most {figures['rounding']:.1g}" if figures["equal"] else ""
    console.print(f"same kind, numbers equal to within {ROUNDING:g}: {share(figures['equal'], compared)}{largest}")
    console.print(f"different: {figures['different']}")
    if not figures["different"]:
        return
    console.print(f"the robot is told the same in {share(figures['same_input'], compared)}")
    kinds = StackingTable("decided", "now", "requests", **PLAIN)
    for logged, row in figures["kinds"].items():
        for now, number in row.items():
            kinds.add_row(logged, now, str(number))
    fields = StackingTable("field", "differs in", "by at most", **PLAIN)
    for name, about in figures["fields"].items():
        fields.add_row(name, str(about["count"]), size(about["largest"]))
    columns = ("largest differences", "decided", "now", "input", "margin")
    examples = StackingTable(*columns, **PLAIN)
    for one in figures["examples"]:
        place = f"{one['actor']} episode {one['episode']} step {one['step']}"
        found = (size(one["differences"].get(name, 0.0)) for name in ("input", "margin"))
        examples.add_row(place, one["logged"], one["now"], *found)
    for table in (kinds, fields, examples):
        console.print(table)


def share(count: int, of: int) -> str:
    return f"{count} ({count / of:.2%})" if of else str(count)


def size(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""
