"""`brakeline COMMAND ...`: THE table of commands, each with an example.

A command's module is imported when it is called, so that `--help` answers at once.
"""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from dataclasses import MISSING, dataclass, field, fields
from importlib.metadata import version
from typing import Annotated, Any, get_type_hints

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from brakeline.extras import missing_extra


@dataclass(frozen=True)
class Command:
    """Where a command's dataclass stands (module:class; its `run` returns the exit status), and what it is for."""

    place: str
    what: str
    example: str


COMMANDS: dict[str, Command] = {
    "demo": Command("train:Demo", "train the ground robot for some minutes, and look on", "brakeline demo"),
    "train": Command(
        "train:Train",
        "all processes on this machine: actors, safety, learner, recorder",
        "brakeline train ground --steps 90000 --actors 2 --seed 0",
    ),
    "keys": Command(
        "keys:KeysCommand",
        "keys for processes on several machines: who they are, who certifies models, what plans were verified",
        "brakeline keys keys safety learner recorder actor-0 actor-1 --host 10.0.0.1",
    ),
    "robot": Command(
        "robot_command:RobotCommand",
        "a robot is a file: write a new description, check it, look at it",
        "brakeline robot new my.toml",
    ),
    "safety": Command(
        "single_processes:Safety",
        "the safety service alone",
        "brakeline safety ground --listen tls/0.0.0.0:7447 --keys keys",
    ),
    "router": Command(
        "router:Router",
        "where the processes of several machines meet; linked routers are one bus",
        "brakeline router --listen tls/0.0.0.0:7447 --connect tls/10.0.0.2:7447 --keys keys",
    ),
    "learner": Command(
        "single_processes:LearnerProcess",
        "a learner alone",
        "brakeline learner ground --connect tls/10.0.0.1:7447 --keys keys",
    ),
    "actor": Command(
        "single_processes:Actor",
        "one actor process alone, with one or several robots",
        "brakeline actor ground --connect tls/10.0.0.1:7447 --keys keys --name actor-7 --number 7",
    ),
    "fly": Command(
        "fly:Fly",
        "a quadrotor in real time, over MAVLink: autopilot, safety service, actor, recorder",
        "brakeline fly --minutes 10 --policy astar",
    ),
    "autopilot": Command(
        "autopilot:Autopilot",
        "quadrotors behind MAVLink in real time, with PX4's or ArduPilot's rules",
        "brakeline autopilot --rules px4 --url udpout:127.0.0.1:14540 --arena default",
    ),
    "ros2": Command(
        "ros2_command:Ros2",
        "the filter in front of a ROS 2 robot's base: cmd_vel_raw in, cmd_vel out; needs no ROS here",
        "brakeline ros2 ground --router tcp/localhost:7447",
    ),
    "bridge-sim": Command(
        "ros2_command:BridgeSim",
        "a simulated ground robot as a ROS 2 robot: odom, scan, tf, clock, cmd_vel",
        "brakeline bridge-sim --arena dense --seed 3",
    ),
    "recorder": Command(
        "single_processes:Recorder",
        "the recorder alone",
        "brakeline recorder runs/a/run.mcap --connect tls/10.0.0.1:7447 --keys keys",
    ),
    "collect": Command(
        "certify:Collect", "record the data that the filter learns a robot from", "brakeline collect ground --seed 1"
    ),
    "import": Command(
        "import_command:Import",
        "a data set from a log of any robot: CSV, Parquet, ROS 2 bags, ArduPilot, PX4, runs",
        "brakeline import drive.csv --robot my.toml --picture driven.png",
    ),
    "excite": Command(
        "import_command:Excite",
        "print, or drive in its simulator, the inputs that a robot is best driven with to be learned, within a region",
        "brakeline excite my.toml --keep -2 -2 2 2 --minutes 10",
    ),
    "certify": Command(
        "certify:Certify",
        "what held-out data say about each certificate; make and publish model sets",
        "brakeline certify --robot ground",
    ),
    "evaluate": Command(
        "evaluate_command:Evaluate",
        "a policy through the filter, in process, on fresh episodes",
        "brakeline evaluate ground --policy astar --episodes 100 --json",
    ),
    "pretrain": Command(
        "compare_command:Pretrain",
        "what a rival must know of a robot, driven and fitted, with its cost",
        "brakeline pretrain secas ground",
    ),
    "compare": Command(
        "compare_command:Compare",
        "every method from the same seeds, as tables and figures; resumes from results/",
        "brakeline compare ground --quick",
    ),
    "query": Command(
        "query:Query",
        "ask a running safety service about a state and an action",
        "brakeline query ground --action 0.25 0 --obstacle 'cylinder 0.3 0 0.1'",
    ),
    "status": Command("query:Status", "which processes live, and how they fare", "brakeline status"),
    "watch": Command(
        "watch_command:Watch", "a running system, live: on a web page, and in Foxglove", "brakeline watch --port 8787"
    ),
    "replay": Command(
        "replay_command:Replay",
        "ask every logged question again: is the same decided, to within 1e-12? And what with another model set?",
        "brakeline replay runs/latest --certificate set-membership",
    ),
    "export": Command(
        "export:Export",
        "a log as CSV, as a Minari data set, as a .tlog, or with a picture of every step for Foxglove",
        "brakeline export runs/latest --csv steps.csv",
    ),
    "analyse": Command(
        "analyse:Analyse",
        "figures of logs, whole or cut off, one run or many; a report as a page",
        "brakeline analyse runs/latest --html report.html",
    ),
    "recover": Command("analyse:Recover", "make damaged logs whole", "brakeline recover runs/latest"),
}


def overview(console: Console) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for name, command in COMMANDS.items():
        table.add_row(f"[bold]{name}[/]", command.what)
        table.add_row("", f"[dim]{command.example}[/]")
    console.print("[bold]brakeline[/]: robots learn by trial and error without ever hitting anything\n")
    console.print(table)
    console.print("\nOptions of a command: brakeline COMMAND --help. With --json, one JSON object on stdout.")


def find(name: str) -> Any:
    """The dataclass of a command."""
    module, _, kind = COMMANDS[name].place.partition(":")
    return getattr(importlib.import_module(f"brakeline.deploy.commands.{module}"), kind)


def abridged(kind: Any) -> Any:
    """A command's dataclass whose help leaves its expert options out; they are understood all the same."""
    hints = get_type_hints(kind, include_extras=True)
    hidden = {name: Annotated[hints[name], tyro.conf.Suppress] for name in kind.expert}
    known = {item.name: item for item in fields(kind)}
    values = {
        name: field(default_factory=known[name].default_factory)
        if known[name].default is MISSING
        else known[name].default
        for name in kind.expert
    }
    return dataclass(frozen=True)(type(kind.__name__, (kind,), {"__annotations__": hidden, **values}))


def expected() -> tuple[type[Exception], ...]:
    """Errors whose message says enough. Who raised them has imported their modules."""
    from brakeline.logs.reader import LogError
    from brakeline.messaging.bus import BusError

    return BusError, LogError, ValueError, OSError, RuntimeError


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0; 1: it failed, with the reason on stderr; 2: not understood; 130: ^C before it was done."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # two processes with two threads each on two cores are slower
    given = sys.argv[1:] if arguments is None else arguments
    errors = Console(stderr=True, highlight=False)
    if not given or given[0] in ("-h", "--help"):
        overview(Console())
        return 0 if given else 2
    if given[0] == "--version":
        print(f"brakeline {version('brakeline')}")
        return 0
    name = given[0]
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; did you mean `{near[0]}`?" if near else ""
        errors.print(f"brakeline: no command is called {name!r}{hint} (`brakeline --help` lists them)", markup=False)
        return 2
    try:
        kind, told = find(name), f"{COMMANDS[name].what}\n\nExample: {COMMANDS[name].example}"
        words = ["--help" if word == "--help-all" else word for word in given[1:]]
        if hasattr(kind, "expert") and words == given[1:] and {"-h", "--help"} & set(words):
            kind, told = abridged(kind), f"{told}\n\nAll options: brakeline {name} --help-all"
        defaults = {"default": kind.defaults(words)} if hasattr(kind, "defaults") else {}
        command = tyro.cli(
            kind,
            **defaults,
            prog=f"brakeline {name}",
            description=told,
            args=words,
        )
        return int(command.run())
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # who read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        if (missing := missing_extra(error)) is None:
            raise
        errors.print(f"[red]brakeline {name}:[/] {escape(str(missing))}", soft_wrap=True)
        return 1
    except Exception as error:
        if not isinstance(error, expected()):
            raise
        errors.print(f"[red]brakeline {name}:[/] {escape(str(error))}", soft_wrap=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
