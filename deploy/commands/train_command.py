"""Implement `brakeline train`: start and supervise all processes of a run on this machine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, ClassVar, Self

import tyro

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import console, errors, print_json
from brakeline.deploy.progress import under_way
from brakeline.deploy.run.run_config import BATCH, EXPERIMENTS, Internal, RunConfig, in_batches, load

# Names of the options for fields that have another name, or that the command makes from several options.
RESUMED = {
    **{"robots": "the robots", "model_config": "--certificate or --mode", "conditions": "the simulated conditions"},
    **{"learner": "--learner...", "robots_per_actor": "--robots-per-actor or --fleet", "change": "--change..."},
    "rotation": "--rotation...",
}
MADE = ("method", "model_config", "accept_bound", "conditions")  # fields that the command makes from other options
STOPPED = 130  # exit status: the user stopped the run before its last step


@dataclass(frozen=True)
class TrainCommand(RunConfig):
    """The options of `brakeline train`: the fields of RunConfig, and options that a configuration does not hold."""

    steps: int = 0
    """Train for this many steps of each robot kind. 0 takes the steps of the experiment, of the resumed run, or of the
    logs if there is no actor."""
    filtering: options.Unprefixed[options.ServiceOptions] = field(default_factory=options.ServiceOptions)
    physics: options.Unprefixed[options.SimulationOptions] = field(default_factory=options.SimulationOptions)
    experiment: str = "default"
    """Start from this configuration, which the other options change: default, demo or debug."""
    out: options.RunFolder = None
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Continue the run in this folder, with its own configuration. Only --steps and --from-logs can change."""
    bus: options.Unprefixed[options.RunBusOptions] = field(default_factory=options.RunBusOptions)
    watch: options.Watch = False
    verbose: options.Verbose = False
    quiet: options.Quiet = False
    json: options.Json = False
    continued: Internal[bool] = False  # the options that nobody gives are those of the resumed run

    # Options that `--help` leaves to `--help-all`.
    expert: ClassVar[tuple[str, ...]] = (
        *("physics", "fleet", "robots_per_actor", "penalty", "deadline", "replicas", "from_logs", "practice", "adapt"),
        *("change", "deterministic", "record", "rotation", "pictures", "mavlink", "bus", "learner"),
    )

    def __post_init__(self) -> None:
        """Check nothing yet: `config` builds a RunConfig, which checks its values."""

    @classmethod
    def defaults(cls, arguments: list[str]) -> Self:
        """Return the default options: those of the experiment, the backend and the robots that `arguments` name.

        If they resume a run, its configuration gives the defaults, so that it shows which options ask for another one.

        Raises:
            ValueError: there is no such experiment, or a robot's task has a setting that TD3 does not have.
        """
        named = {"--experiment": cls.experiment, "--backend": cls.backend, "--resume": ""}
        for flag, value in zip(arguments, [*arguments[1:], ""], strict=False):
            option, equals, attached = flag.partition("=")
            if option in named:
                named[option] = attached if equals else value
        name = named["--experiment"]
        if name not in EXPERIMENTS:
            raise ValueError(f"no experiment is called {name!r}; there are: {', '.join(EXPERIMENTS)}")
        experiment = EXPERIMENTS[name]
        if named["--resume"] and name == cls.experiment:
            from brakeline.deploy.run.processes import CONFIG

            with suppress(ValueError):  # `config` tells what is wrong
                resumed = load(Path(named["--resume"]) / CONFIG)
                return options.settings_from(cls, resumed, steps=0, continued=True)
        if named["--backend"] == BATCH:
            experiment = in_batches(experiment)
        learner = options.task_learner(experiment.learner, arguments, batch=experiment.backend == BATCH)
        return options.settings_from(cls, experiment, experiment=name, steps=0, learner=learner)

    def config(self) -> RunConfig:
        """Return the run's configuration. Raises ValueError if options contradict each other."""
        if self.resume is not None:
            from brakeline.deploy.run.processes import CONFIG

            resumed = load(self.resume / CONFIG)
            self._check_resumed(resumed)
            from_logs = self.from_logs or resumed.from_logs
            return replace(resumed, steps=self.steps or resumed.steps, from_logs=from_logs)
        if self.penalty is not None and not self.actors:
            raise ValueError(
                "--penalty is for robots that drive, but --actors is 0: each step of a log has the penalty of its own "
                "run. Leave out --penalty; --learner.td3.penalty-growth multiplies the penalties of the logs too"
            )
        return self._config_of_options()

    def _check_resumed(self, resumed: RunConfig) -> None:
        """Raise ValueError if options ask for another configuration than that of the resumed run, which stays."""
        usual = replace(type(self).defaults([*self.robots]), steps=1)._config_of_options()
        asked = replace(self, steps=1, from_logs=() if self.actors else self.from_logs or ("",))._config_of_options()
        names = [item.name for item in fields(RunConfig) if item.name not in ("steps", "from_logs")]
        ignored = [
            RESUMED.get(name, f"--{name.replace('_', '-')}")
            for name in names
            if getattr(asked, name) != getattr(resumed, name)
            # Nobody may have given the usual value.
            and ((self.continued and name not in MADE) or getattr(asked, name) != getattr(usual, name))
        ]
        if self.out is not None and self.out.resolve() != Path(str(self.resume)).resolve():
            ignored.append("--out")
        if ignored:
            raise ValueError(
                f"a resumed run goes on in its folder with its own configuration, but another one is asked for by "
                f"{', '.join(ignored)}: leave that out. Only --steps and --from-logs can change"
            )

    def _config_of_options(self) -> RunConfig:
        """Return the configuration of a new run. Raises ValueError if options contradict each other."""
        from brakeline.messaging.task import address
        from brakeline.safety.model.model_config import check_reservations

        if self.fleet:
            check_reservations(self.filtering.method)
        return options.settings_from(
            RunConfig,
            self,
            robots=tuple(address(name) for name in self.robots),
            **self.filtering.settings(),
            conditions=self.physics.conditions(),
            actors=1 if self.deterministic else self.actors,
            robots_per_actor=self.fleet or self.robots_per_actor,
            steps=self.steps or self._default_steps(),
        )

    def _default_steps(self) -> int:
        """Return the steps in the logs if nothing else teaches the learner, else the experiment's steps."""
        if not self.from_logs or self.actors:
            return EXPERIMENTS[self.experiment].steps
        from brakeline.deploy.run.log_feed import count
        from brakeline.messaging.task import robot_with_task

        with under_way("counting the steps of the logs"):
            return max(count(self.from_logs, robot_with_task(name)) for name in self.robots)

    extras: ClassVar[tuple[str, ...]] = ("sim", "train", "logs")

    def run(self) -> int:
        """Run the training. Returns the exit status."""
        config = self.config()
        if config.from_logs:
            from brakeline.deploy.data.run_dataset import check_logs
            from brakeline.deploy.run.log_feed import SCALES
            from brakeline.messaging.task import robot_with_task

            for name in config.robots:  # a mistyped path ends the command before it starts a process
                check_logs(config.from_logs, robot_with_task(name), SCALES)
        with run_folder(self.resume or self.out) as folder:
            return train(config, folder, self.resume is not None, self.bus, self.json, self.verbose, self.watch)


def train(
    config: RunConfig,
    folder: Path,
    resume: bool,
    bus: options.RunBusOptions,
    as_json: bool,
    verbose: bool = False,
    watch: bool = False,
    browser: bool = True,
) -> int:
    """Run all processes of a configuration, with a display on stdout (with `as_json` on stderr).

    With `verbose` it prints all figures at the end, not only the verdict. With `watch` it serves a live page, which
    `browser` opens.

    Returns the exit status: 0, STOPPED if the run was stopped before its last step, or 1 if a policy was not saved.
    """
    shown = errors if as_json else console
    summary_line = f"{', '.join(config.robots)}, method {config.method}, arena {config.arena}, {config.steps} steps"
    with under_way(f"{folder}: {summary_line}"):  # the imports alone take seconds
        from brakeline.deploy.run.display import Display, summary
        from brakeline.deploy.run.launcher import Launcher, prepare
        from brakeline.deploy.run.live_page import LivePage
        from brakeline.deploy.run.run_lock import only_launcher
        from brakeline.deploy.run.verdict import not_saved

    with ExitStack() as locked:
        if resume:
            locked.enter_context(only_launcher(folder))  # a run that is running stays as it is
        config = prepare(config, folder, resume)
        locked.enter_context(only_launcher(folder))
        if resume:
            shown.print(f"resuming {folder} from the learner's last checkpoint; the log continues in a new file")
        steps = config.steps * len(config.robots)
        with LivePage(folder, browser) if watch else nullcontext() as page:
            with Display(shown, steps, page) as display:
                figures = Launcher(config, folder, bus.settings(config, folder)).run(display)
            locked.close()
            if as_json:
                print_json(figures)
            else:
                summary(console, figures, verbose)
            if page is not None:
                page.stay(shown.print)
    return STOPPED if not figures["finished"] else int(bool(not_saved(figures)))


@contextmanager
def run_folder(given: Path | None) -> Iterator[Path]:
    """Yield the folder of a run: the given one, or a new one with the time as its name.

    Runs that start within the same second have different folders. A new folder that stays empty is removed.
    """
    folder = given or _new_folder(Path("runs") / time.strftime("%Y%m%d-%H%M%S"))
    try:
        yield folder
    finally:
        if given is None:
            from brakeline.deploy.run.run_lock import LOCK

            with suppress(OSError):  # it holds a run
                if [file.name for file in folder.iterdir()] == [LOCK]:
                    (folder / LOCK).unlink()
                folder.rmdir()


def _new_folder(folder: Path) -> Path:
    """Make a folder of this name, or with a number after it if another run has the name, and return it."""
    name, number = folder.name, 1
    folder.parent.mkdir(parents=True, exist_ok=True)
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = folder.with_name(f"{name}_{number}")
