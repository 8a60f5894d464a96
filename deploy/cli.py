"""Implement `brakeline COMMAND ...`. TABLE is THE table of commands, each with an example.

Each command is a module `deploy/commands/NAME_command.py` with a dataclass `NameCommand`: its fields are the options,
and its method `run` returns the exit status. `extras` names the optional parts that it needs. The module is imported
when the command runs, so that `--help` answers at once. `least` and `above` state by the names of options which numbers
make sense (`check_option_numbers`). A command imports what an extra brings in `run`, so that `--help` and
`completion` need no extra.
"""

from __future__ import annotations

import codecs
import difflib
import errno
import importlib
import os
import signal
import sys
from contextlib import nullcontext
from copy import copy
from dataclasses import fields, is_dataclass, make_dataclass, replace
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import docstring_parser
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from brakeline.deploy import progress
from brakeline.deploy.option_numbers import check_option_numbers
from brakeline.extras import missing_extra
from brakeline.messaging.stop_signals import interrupt_on_signals

LEAST_COLUMNS = 8  # of a terminal: with fewer, rich prints nothing, and tyro's help does not end

# tyro shows `X | None` as `{None}|X`, takes the word None, and names Python's NoneType if it can't parse a value. An
# option that is left out is None already, so that only X is shown and parsed.
registry = ConstructorRegistry()


@registry.primitive_rule
def _optional_value(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    kinds = get_args(info.type)
    if NoneType not in kinds or len(kinds) != 2:
        return None
    (kind,) = (kind for kind in kinds if kind is not NoneType)
    spec = registry.get_primitive_spec(PrimitiveTypeInfo.make(kind, parent_markers=info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["none"] if value is None else spec.str_from_instance(value),
    )


class CommandEntry(NamedTuple):
    """What a command does, and how to call it."""

    summary: str
    example: str


# For each command what it does, and the arguments of an example.
TABLE: dict[str, dict[str, tuple[str, str]]] = {
    "See it and train": {
        "demo": ("Drive a policy without and with the filter, then train one for some minutes.", ""),
        "train": (
            "Run all processes of a training on this machine: actors, safety service, learner, recorder.",
            "ground --steps 90000 --actors 2 --seed 0",
        ),
        "evaluate": (
            "Evaluate a policy behind the filter on fresh episodes.",
            "ground --policy astar --episodes 100 --json",
        ),
        "compare": (
            "Train and evaluate each method from the same seeds, and write tables and figures. Reuse stored results.",
            "ground --quick",
        ),
        "campaign": (
            "Drive many episodes of many kinds behind the filter, and search for the worst case. You can resume it.",
            "ground --episodes 10000 --search 1000",
        ),
        "pretrain": ("Drive a robot, and fit the networks of a rival method to the data.", "secas ground"),
    },
    "Your own robot": {
        "robot": ("Write, check or show the description of a robot (a .toml file).", "new my.toml"),
        "import": (
            "Make a data set from a log of any robot: CSV, Parquet, ROS bags, ArduPilot, PX4 or Brakeline runs.",
            "drive.csv --robot my.toml --picture driven.png",
        ),
        "collect": ("Record the data set from which the filter learns how a robot moves.", "ground --seed 1"),
        "excite": (
            "Print the inputs that excite a robot best within a region, or drive them in its simulator.",
            "my.toml --keep -2 -2 2 2 --minutes 10",
        ),
        "certify": ("Fit model sets to recorded data, validate them, and put them to use or publish them.", "ground"),
    },
    "Ask the filter, fly and drive": {
        "query": (
            "Ask a running safety service for a decision about a state and an action.",
            "ground --action 0.25 0 --obstacle 'cylinder 0.3 0 0.1'",
        ),
        "fly": (
            "Fly a quadrotor in real time over MAVLink, with autopilot, safety service, actor and recorder.",
            "--minutes 10 --policy astar",
        ),
        "ros2": (
            "Filter the commands of a ROS 2 robot: cmd_vel_raw in, cmd_vel out. You need no ROS installation.",
            "ground --router tcp/localhost:7447",
        ),
        "autopilot": (
            "Simulate quadrotors behind MAVLink in real time, with the rules of PX4 or ArduPilot.",
            "--rules px4 --url udpout:127.0.0.1:14540 --arena default",
        ),
        "bridge-sim": (
            "Simulate a ground robot as a ROS 2 robot: odom, scan, tf, clock and cmd_vel.",
            "--arena dense --seed 3",
        ),
    },
    "Look at runs": {
        "watch": ("Watch a running system on a web page and in Foxglove.", "--port 8787"),
        "status": ("Show the running processes and their figures.", ""),
        "analyse": (
            "Compute the figures of one or many logs, also of incomplete ones, and write a report page.",
            "runs/latest --html report.html",
        ),
        "replay": (
            "Decide each logged request again, with the same model set or another, and compare the decisions.",
            "runs/latest --certificate set-membership",
        ),
        "export": (
            "Export a log as CSV, Minari data set, .tlog, or MCAP with a picture of each step for Foxglove.",
            "runs/latest --csv steps.csv",
        ),
        "recover": ("Repair damaged logs.", "runs/latest"),
    },
    "Processes on several machines": {
        "keys": (
            "Make keys for processes on several machines, for signers of model sets, and for plan tokens.",
            "keys safety learner recorder actor-0 actor-1 --host 10.0.0.1",
        ),
        "router": (
            "Run a router at which the processes of several machines meet. Linked routers form one bus.",
            "--listen tls/0.0.0.0:7447 --connect tls/10.0.0.2:7447 --keys keys",
        ),
        "safety": ("Run a safety service alone.", "ground --listen tls/0.0.0.0:7447 --keys keys"),
        "actor": (
            "Run one actor process alone, with one or several robots.",
            "ground --connect tls/10.0.0.1:7447 --keys keys --name actor-7 --number 7",
        ),
        "learner": ("Run a learner alone.", "ground --connect tls/10.0.0.1:7447 --keys keys"),
        "recorder": ("Run a recorder alone.", "runs/a/run.mcap --connect tls/10.0.0.1:7447 --keys keys"),
    },
    "The command line": {
        "completion": ("Print the script with which a shell completes commands and options at the Tab key.", "bash"),
    },
}
GROUPS: dict[str, dict[str, CommandEntry]] = {
    title: {name: CommandEntry(what, f"brakeline {name} {words}".rstrip()) for name, (what, words) in group.items()}
    for title, group in TABLE.items()
}
COMMANDS: dict[str, CommandEntry] = {name: entry for group in GROUPS.values() for name, entry in group.items()}


def print_overview(console: Console) -> None:
    """Print each command with its example."""
    console.print(
        "[bold]brakeline[/]: robots learn by trial and error and avoid collisions; so far, all robots were simulated\n"
    )
    for title, group in GROUPS.items():
        table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
        for name, (summary, example) in group.items():
            table.add_row(f"[bold]{name:<10}[/]", summary)
            table.add_row("", f"[dim]{example}[/]")
        console.print(f"[bold]{title}[/]")
        console.print(table)
        console.print()
    console.print(
        "`brakeline COMMAND --help` lists the options of a command. With --json, a command prints one JSON object."
    )


def command_class(name: str) -> Any:
    """Return the dataclass of a command: for bridge-sim, BridgeSimCommand of bridge_sim_command.py."""
    words = [*name.split("-"), "command"]
    module = importlib.import_module(f"brakeline.deploy.commands.{'_'.join(words)}")
    return getattr(module, "".join(map(str.capitalize, words)))


def abridged(command: Any) -> Any:
    """Return a command's dataclass whose help leaves out the expert options. tyro still parses them."""
    hints = get_type_hints(command, include_extras=True)
    expert = [item for item in fields(command) if item.name in command.expert]
    hidden = [(item.name, Annotated[hints[item.name], tyro.conf.Suppress], copy(item)) for item in expert]
    return make_dataclass(command.__name__, hidden, bases=(command,), frozen=True)


def unwrap_help(options: Any) -> None:
    """Remove the line breaks of the source from the help of a dataclass and of the dataclasses in its fields.

    tyro prints the line breaks of a field's docstring, but none of an attribute in the docstring of the class. This
    changes the docstrings of this process, so call it only where the process prints help and ends.
    """
    for parent in options.__mro__[:-1]:
        attributes = docstring_parser.parse_from_object(parent).params
        texts = [f"    {text.arg_name}: {' '.join((text.description or '').split())}" for text in attributes]
        if texts and "\nAttributes:\n" not in (parent.__doc__ or ""):
            parent.__doc__ = "\n".join([(parent.__doc__ or "").rstrip(), "", "Attributes:", *texts])
    for hint in get_type_hints(options).values():
        if is_dataclass(hint):
            unwrap_help(hint)


def parse(name: str, arguments: list[str]) -> Any:
    """Return the command object for its arguments. Exits with status 0 after --help, with 2 if tyro can't parse."""
    command, (summary, example) = command_class(name), COMMANDS[name]
    description = f"{summary}\n\nExample: {example}"
    words = ["--help" if word == "--help-all" else word for word in arguments]
    if {"-h", "--help"} & set(words):
        unwrap_help(command)
        if hasattr(command, "expert") and words == arguments:
            command, description = abridged(command), f"{description}\n\nAll options: brakeline {name} --help-all"
        read = ["--help"]  # tyro's help leaves out the positional arguments that come before
    else:
        read = words
    defaults = {"default": command.defaults(words)} if hasattr(command, "defaults") else {}
    return tyro.cli(
        command, **defaults, prog=f"brakeline {name}", description=description, args=read, registry=registry
    )


def reason(error: Exception) -> str:
    """Return the message of an error; for a place that cannot be written to or does not exist, also what to do."""
    places = "BRAKELINE_DATA for data sets and model sets, --out for a run or a file"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{error}. Free some space, or name a place on another disk: {places}, --runs and --results for a study"
    if isinstance(error, OSError) and error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        reading = "" if error.errno == errno.EROFS else "To read it, you need the permission to read. To write: "
        return f"{error}. {reading}Run the command in a folder in which you may write, or name one: {places}"
    if isinstance(error, FileNotFoundError) and isinstance(error.filename, str):
        folder = Path(error.filename).absolute().parent
        if not folder.is_dir():
            return f"{error}: make the folder {folder} first, or correct the path"
    return str(error)


def main(arguments: list[str] | None = None) -> int:
    """Run a command. Returns the exit status.

    0: done. 1: the command failed; stderr has the reason. 2: the command line can't be parsed. 130: the user
    interrupted the command; 143 and 129: SIGTERM or SIGHUP did. A command may have further ones.
    """
    if isinstance(sys.stdout, TextIOWrapper) and codecs.lookup(sys.stdout.encoding).name != "utf-8":
        sys.stdout.reconfigure(errors="replace")  # a locale without a letter such as ≤ must not end a command
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"]) < LEAST_COLUMNS:
        del os.environ["COLUMNS"]  # such as 0, which some programs set in a shell without a terminal
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # two processes with two threads each on two cores are slower
    words = sys.argv[1:] if arguments is None else arguments
    errors = Console(stderr=True, highlight=False)
    if not words or words[0] in ("-h", "--help"):
        print_overview(Console())
        return 0 if words else 2
    name = words[0]
    if name == "--version":
        print(f"brakeline {version('brakeline')}")
        return 0
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; did you mean `{near[0]}`?" if near else ""
        errors.print(f"brakeline: no command is called {name!r}{hint} (`brakeline --help` lists them)", markup=False)
        return 2
    command: Any = None
    try:
        with interrupt_on_signals():
            command = parse(name, words[1:])
            check_option_numbers(command)
            with progress.silenced() if getattr(command, "quiet", False) else nullcontext():
                return int(command.run())
    except KeyboardInterrupt as interrupted:
        return 128 + next(iter(interrupted.args), signal.SIGINT)
    except BrokenPipeError:  # the reader of the output, such as `head`, has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        if (missing := missing_extra(error, getattr(command, "extras", ()))) is None:
            raise
        errors.print(f"[red]brakeline {name}:[/] {escape(str(missing))}", soft_wrap=True)
        return 1
    except Exception as error:
        from brakeline.errors import BusError, LogError, MissingExtra

        if not isinstance(error, BusError | LogError | MissingExtra | ValueError | OSError | RuntimeError):
            raise  # the message of another exception does not tell the user enough
        errors.print(f"[red]brakeline {name}:[/] {escape(reason(error))}", soft_wrap=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
