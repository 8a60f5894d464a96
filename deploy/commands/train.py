"""`brakeline train` and `brakeline demo`."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, ClassVar, Self

import tyro

from brakeline.actors.actor_settings import PhysicsChange
from brakeline.deploy.commands.common_options import Flags, Meeting, Physics, Serving, console, errors, say_json
from brakeline.deploy.progress import under_way
from brakeline.deploy.run.run_config import EXPERIMENTS, RunConfig, load
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.segment_rotation import Rotation


def launch(config: RunConfig, folder: Path, resume: bool, meeting: Meeting, as_json: bool) -> int:
    """Prepare and run, with a display on stderr (when JSON is asked for) or stdout; returns the exit status."""
    shown = errors if as_json else console
    what = f"{', '.join(config.robots)}, method {config.method}, arena {config.arena}, {config.steps} steps"
    with under_way(f"{folder}: {what}"):  # seconds go into these alone
        from brakeline.deploy.run.display import Display, summary
        from brakeline.deploy.run.launcher import Launcher, prepare

    prepare(config, folder, resume)
    if resume:
        shown.print(f"resuming {folder} from the learner's last checkpoint; the log goes on in a new segment")
    with Display(shown, config.steps * len(config.robots)) as display:
        figures = Launcher(config, folder, meeting.settings(config, folder)).run(display)
    if as_json:
        say_json(figures)
    else:
        summary(console, figures)
    return 0 if figures["finished"] else STOPPED


STOPPED = 130  # exit status: ^C before the last step


def stamped() -> Path:
    return Path("runs") / time.strftime("%Y%m%d-%H%M%S")


@dataclass(frozen=True)
class Train:
    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ("ground",)
    """Robot kinds; each has a learner and actors of its own, all share the safety service."""
    filtering: Flags[Serving] = field(default_factory=Serving)
    physics: Flags[Physics] = field(default_factory=Physics)
    actors: int = 2
    """Actor processes a robot kind."""
    robots_per_actor: int = 1
    """Robots in each of them; their requests share a question."""
    fleet: int = 0
    """So many robots in each actor process, and in one world that they share; 0: each is alone in its own."""
    experiment: str = "default"
    """The configuration that the other options start from: default | demo | debug."""
    steps: int | None = None
    """Steps a robot kind; default: those of the experiment, or of the run that is resumed."""
    seed: int = 0
    arena: str = "default"
    penalty: float = RunConfig.penalty
    """Subtracted from the learned reward for a correction by the whole range of an input."""
    deadline: float = RunConfig.deadline
    """s, for an answer of the safety service; then the robot brakes along its plan."""
    replicas: int = 1
    """Of the safety service."""
    out: Path | None = None
    """The run's folder; default: runs/ and the time."""
    resume: Path | None = None
    """Go on with the run in this folder: its configuration, except for --steps."""
    from_logs: tuple[Path, ...] = ()
    """Learn from the steps in these logs (files or run folders) before any robot starts; with --actors 0 from them
    alone, with a --resume whose checkpoint is lost from the run's own."""
    practice: float = 0.0
    """Share of steps at which a robot follows its committed plan to the stop: the stops that `certify LOG` needs."""
    change: PhysicsChange = field(default_factory=PhysicsChange)
    """Load the robots or change the floor in mid-run, e.g. --change.after 5000 --change.payload-kg 1."""
    deterministic: bool = False
    """One actor, lockstep, no deadlines: the same seed gives the same weights, bit for bit."""
    record: bool = True
    """A log of the run. Without one nothing can be analysed, replayed or watched later."""
    rotation: Rotation = field(default_factory=Rotation)
    pictures: float = RunConfig.pictures
    """A second and robot, drawn for Foxglove in the log besides all interventions; 0: none at all."""
    mavlink: bool = False
    """Log every MAVLink frame of quadrotors too, as bytes and as JSON: about as much again as all the rest."""
    meeting: Flags[Meeting] = field(default_factory=Meeting)
    learner: LearnerConfig = field(default_factory=lambda: RunConfig().learner)
    json: bool = False
    """Print the final figures as one JSON object on stdout; the display goes to stderr."""

    # What `--help` leaves to `--help-all`.
    expert: ClassVar[tuple[str, ...]] = (
        *("physics", "robots_per_actor", "penalty", "deadline", "replicas", "from_logs", "practice", "change"),
        *("deterministic", "record", "rotation", "pictures", "mavlink", "meeting", "learner"),
    )

    @classmethod
    def defaults(cls, arguments: list[str]) -> Self:
        """The options before any is given: those of the experiment that is.

        Raises:
            ValueError: no experiment has that name.
        """
        name = cls.experiment
        for flag, value in zip(arguments, [*arguments[1:], ""], strict=True):
            option, equals, attached = flag.partition("=")
            if option == "--experiment":
                name = attached if equals else value
        if name not in EXPERIMENTS:
            raise ValueError(f"no experiment is called {name!r}; there are: {', '.join(EXPERIMENTS)}")
        chosen = EXPERIMENTS[name]
        shared = {f.name for f in fields(cls)} & {f.name for f in fields(chosen)} - {"steps"}
        return cls(experiment=name, **{name: getattr(chosen, name) for name in shared})

    def config(self) -> RunConfig:
        """The run's configuration; a resumed run's is its own, but for the steps."""
        if self.resume is not None:
            from brakeline.deploy.run.processes import CONFIG

            resumed = load(self.resume / CONFIG)
            from_logs = tuple(map(str, self.from_logs)) or resumed.from_logs
            return replace(resumed, steps=self.steps or resumed.steps, from_logs=from_logs)
        from brakeline.messaging.task import address
        from brakeline.safety.model.model_config import check_reservations

        if self.fleet:
            check_reservations(self.filtering.method)
        return RunConfig(
            robots=tuple(address(name) for name in self.robots),
            method=self.filtering.method,
            model_config=self.filtering.model_config(),
            accept_bound=self.filtering.accept_bound,
            arena=self.arena,
            actors=1 if self.deterministic else self.actors,
            robots_per_actor=self.fleet or self.robots_per_actor,
            fleet=self.fleet,
            steps=self._steps(),
            from_logs=tuple(map(str, self.from_logs)),
            seed=self.seed,
            penalty=self.penalty,
            deadline=self.deadline,
            practice=self.practice,
            change=self.change,
            deterministic=self.deterministic,
            replicas=self.replicas,
            pictures=self.pictures,
            record=self.record,
            rotation=self.rotation,
            mavlink=self.mavlink,
            conditions=self.physics.conditions(),
            learner=self.learner,
        )

    def _steps(self) -> int:
        """As given; offline the logs have an end; else the experiment's."""
        if self.steps is None and self.from_logs and self.actors == 0:
            from brakeline.deploy.run.log_feed import count
            from brakeline.messaging.task import robot_with_task

            logs = [str(path) for path in self.from_logs]
            with under_way("counting the logs' steps"):
                return max(count(logs, robot_with_task(name)) for name in self.robots)
        return EXPERIMENTS[self.experiment].steps if self.steps is None else self.steps

    def run(self) -> int:
        folder = self.resume or self.out or stamped()
        return launch(self.config(), folder, self.resume is not None, self.meeting, self.json)


@dataclass(frozen=True)
class Demo:
    steps: int = EXPERIMENTS["demo"].steps
    seed: int = 0
    out: Path | None = None
    """The run's folder; default: runs/ and the time."""
    json: bool = False
    """Print the final figures as one JSON object on stdout; the display goes to stderr."""

    def run(self) -> int:
        config = replace(EXPERIMENTS["demo"], steps=self.steps, seed=self.seed)
        return launch(config, self.out or stamped(), False, Meeting(), self.json)
