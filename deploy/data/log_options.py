"""The choices of a user about a log: `--map`, `--unit` and `--topics`."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from brakeline.deploy.data.sources.isolated_reader import USUAL_LIMITS, ReadLimits
from brakeline.deploy.data.sources.source_table import Table
from brakeline.deploy.data.stamps import TIME
from brakeline.deploy.data.unit_table import chosen_units, si_of
from brakeline.errors import NoSource

CHOSEN_RANK = -1000  # of a table that the user names: before all others


@dataclass(frozen=True)
class LogOptions:
    """Where quantities are in a log, and in which units. `fields`: {name: TABLE/FIELD}; `units`: {name: unit}.

    `limits` are those of reading a foreign log.
    """

    fields: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    limits: ReadLimits = USUAL_LIMITS

    @classmethod
    def parse(
        cls,
        places: Iterable[str] = (),
        units: Iterable[str] = (),
        topics: Iterable[str] = (),
        limits: ReadLimits = USUAL_LIMITS,
    ) -> LogOptions:
        """Parse the words of `--map` and `--unit`. Raises NoSource if one is malformed."""
        fields: dict[str, str] = {}
        for word in places:
            name, _, place = word.partition("=")
            if not (name and place):
                raise NoSource(f"--map {word!r} must be NAME=TABLE/FIELD, or NAME=COLUMN for a file of columns")
            if fields.setdefault(name, place) != place:
                raise NoSource(f"--map names {name!r} twice: {fields[name]} and {place}")
        return cls(fields, chosen_units(units), tuple(topics), limits)

    def check_names(self, names: Sequence[str]) -> None:
        """Raise NoSource if an option names something else than `names` or the time."""
        for option, given in (("--map", self.fields), ("--unit", self.units)):
            if unknown := [name for name in given if name not in (*names, TIME)]:
                raise NoSource(f"{option} {unknown[0]!r}: the name must be one of {', '.join(names)} or {TIME}")

    def ranked(self, tables: Sequence[Table]) -> list[Table]:
        """Return the tables; those that `--topics` names come first. Raises NoSource if one does not exist."""
        names = [table.name for table in tables]
        if unknown := [topic for topic in self.topics if topic not in names]:
            raise NoSource(f"--topics {unknown[0]}: the source has only {', '.join(filter(None, names)) or 'columns'}")
        return [replace(t, rank=CHOSEN_RANK) if t.name in self.topics else t for t in tables]

    def conversion_notes(self) -> list[str]:
        """Return a note for each converted column: its name may still state the unit of the log."""
        converted = {name: (unit, si_of(unit)) for name, unit in self.units.items() if name != TIME}
        return [
            f"{name}: --unit converts the log from {unit} to {si}. Requests and decisions have {name} in {si}, "
            "whatever its name says"
            for name, (unit, si) in converted.items()
            if si not in ("", unit)
        ]

    def words(self) -> str:
        """Return the options as words of a command line, as a shell takes them."""
        places, units = ([f"{name}={value}" for name, value in of.items()] for of in (self.fields, self.units))
        given = {"--map": places, "--unit": units, "--topics": self.topics}
        return " ".join(shlex.join([option, *words]) for option, words in given.items() if words)


PLAIN = LogOptions()
