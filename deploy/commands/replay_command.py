"""Implement `brakeline replay`: decide each logged request again, and compare."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from brakeline.deploy.commands.command_output import console, errors, print_damage, print_json
from brakeline.deploy.commands.common_options import LATEST, Certificate, Json, Logs, Mode, Quiet
from brakeline.deploy.progress import errors_only, under_way
from brakeline.logs.stacking_table import plain_table

if TYPE_CHECKING:
    from brakeline.deploy.run.replay_run import Replacement
    from brakeline.messaging.robot import Robot
    from brakeline.safety.filter.filter import Filter

ANY_BOUND = 1.0  # the replay drives no robot, so it accepts a model set with any stated bound
# Exit status: decisions differ by more than rounding although you replaced nothing, or there is no request.
DIFFERENT = 1


@dataclass(frozen=True)
class ReplayCommand:
    """The options of `brakeline replay`."""

    logs: Logs = (LATEST,)
    certificate: Certificate | None = None
    """Decide with this error bound instead, fitted to the data set in use or to --data."""
    mode: Mode = "direct"
    """With --certificate or --data, predict in this mode."""
    data: Path | None = None
    """Decide with a model set that is fitted to this data set (a file that `brakeline collect` wrote) instead."""
    margin: float | None = None
    """Decide with this clearance margin [m] instead of the model set's own."""
    quiet: Quiet = False
    json: Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "logs")

    def run(self) -> int:
        """Replay the logs and print the comparison. Returns the exit status: 0, or DIFFERENT."""
        from brakeline.deploy.run.replay_run import replay
        from brakeline.logs.reader import count_by_key, find

        other_model = self.certificate is not None or self.data is not None
        if self.mode != ReplayCommand.mode and not other_model:
            raise ValueError("--mode belongs to another model set: give --certificate or --data too")
        values = {"certificate": self.certificate, "data": self.data and str(self.data), "margin": self.margin}
        changes = {name: value for name, value in values.items() if value is not None}
        if other_model:
            changes["mode"] = self.mode
        replacement = self._replacement() if other_model else None
        logged = sum((count_by_key(path) for path in find(self.logs)), Counter[str]())
        total, steps = (sum(logged[key] for key in logged if key.startswith(kind)) for kind in ("exchange/", "step/"))
        # The warnings of the filter were about the robots of that time.
        with under_way("deciding each request again", total) as advance, errors_only("brakeline.safety"):
            result = replay(list(self.logs), replacement, advance, self.margin)
        figures = result.figures() | {"log": [str(path) for path in self.logs], "instead": changes}
        if self.json:
            print_json(figures)
        else:
            print_comparison(figures)
        print_damage(result.damage)
        if not result.requests:
            why = "the log of a batch holds steps, but no requests" if steps else "no request could be read"
            errors.print(f"nothing was compared: {why}")
            return DIFFERENT
        return DIFFERENT if result.different and not changes else 0

    def _replacement(self) -> Replacement:
        """Return the function that gives, for a robot, the filter to ask instead of the one that was in use."""
        from brakeline.deploy.data.certification import certify
        from brakeline.deploy.data.model_store import check_description, model_for
        from brakeline.safety.filter.filter import Filter
        from brakeline.safety.model.dataset import Dataset
        from brakeline.safety.model.model_config import ModelConfig

        config = ModelConfig(self.certificate or "residual", self.mode)
        fitted = None if self.data is None else certify(Dataset.load(self.data), config)[0]

        @cache
        def filter_for(robot: Robot) -> Filter:
            if fitted is None:
                check_description(robot, config)  # the log may be older than the description in use
            replacement = Filter(fitted or model_for(robot, config, ANY_BOUND), self.margin)
            if replacement.robot.name != robot.name:
                raise ValueError(f"{self.data} has data of {replacement.robot.name}, but the log is of {robot.name}")
            return replacement

        return filter_for


def print_comparison(figures: dict[str, Any]) -> None:
    """Print the figures of a replay on stdout."""
    from brakeline.deploy.run.replay_run import ROUNDING
    from brakeline.logs.figure_tables import share

    compared = figures["requests"] - figures["unanswered"]
    changes = ", ".join(f"{name} {value}" for name, value in figures["instead"].items())
    heading = f"decided again with {changes}" if changes else "decided again"
    console.print(f"{heading}: {compared} requests; {figures['unanswered']} had no answer", markup=False)
    console.print(f"identical in every bit: {share(figures['identical'], compared, digits=2)}")
    largest = f"; at most {figures['rounding']:.1g}" if figures["equal"] else ""
    equal = f"{share(figures['equal'], compared, digits=2)}{largest}"
    console.print(f"same kind, numbers equal to within {ROUNDING:g}: {equal}")
    console.print(f"different: {figures['different']}")
    if not figures["different"]:
        return
    console.print(f"the robot gets the same input in {share(figures['same_input'], compared, digits=2)}")
    kinds = [(logged, now, str(count)) for logged, row in figures["kinds"].items() for now, count in row.items()]
    fields = [(name, str(field["count"]), size(field["largest"])) for name, field in figures["fields"].items()]
    examples = []
    for one in figures["examples"]:
        step = f"{one['actor']} episode {one['episode']} step {one['step']}"
        sizes = (size(one["differences"].get(name, 0.0)) for name in ("input", "margin"))
        examples.append((step, one["logged"], one["now"], *sizes))
    console.print(plain_table(("decided", "now", "requests"), kinds))
    console.print(plain_table(("field", "differs in", "by at most"), fields))
    console.print(plain_table(("largest differences", "decided", "now", "input", "margin"), examples))


def size(value: float) -> str:
    """Return a difference as text. Empty if it is not finite: the values are no numbers."""
    return f"{value:.3g}" if math.isfinite(value) else ""
