"""`brakeline collect` and `brakeline certify`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape

from brakeline.deploy.commands.common_options import (
    Endpoints,
    Flags,
    Mode,
    Physics,
    Robot,
    conditions,
    console,
    default_keys,
    errors,
    say_json,
)
from brakeline.deploy.data.build_lock import alone
from brakeline.deploy.data.coverage import more_to_drive
from brakeline.deploy.data.data_paths import model_path, record_path
from brakeline.deploy.data.run_dataset import Recorded, from_log
from brakeline.deploy.data.simulated_recording import SEED, data_for, recorded
from brakeline.deploy.data.supported_modes import Unsupported, supported
from brakeline.deploy.progress import under_way
from brakeline.logs.console_tables import StackingTable
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.messaging.topics import MODEL
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.error_bounds import KINDS, RESIDUAL
from brakeline.safety.model.model_set import MODES, ModelConfig, ModelSet
from brakeline.safety.model.stated_bound import accepted_bound, refusal
from brakeline.safety.model.validation import CONFIDENCE, EPISODE, HOUR, ValidationReport
from brakeline.safety.service.signature import KEY, ModelSigner, seal_of

DIVERGES = 100.0  # m, of a stop's half-width: wider than any arena


@dataclass(frozen=True)
class First:
    """The first flight of a vehicle."""

    minutes: float = 15.0
    """Of flight, without takeoff and landing."""
    height: float = 30.0
    """m that it climbs to; it stays between a third of it and five thirds."""
    room: float = 80.0
    """m, the side of the square that it stays in."""
    system: int = 1
    """MAVLink system id of the vehicle."""
    raise_limits: bool = False
    """Set those of its parameters that hold it below what its description says: speeds, accelerations, tilt."""
    lead: bool = False
    """Tell it places to go to in place of velocities: when setpoints stop it stays at the last one, where an ArduCopter
    without GUID_TIMEOUT flies on for 3 s. It flies otherwise then: `collect` and `fly` both with it."""


@dataclass(frozen=True)
class Collect:
    robot: Robot = "ground"
    trajectories: int | None = None
    """Of 300 periods each; default: as many as this robot's plans need."""
    seed: int = SEED
    physics: Flags[Physics] = field(default_factory=Physics)
    out: Path | None = None
    """File; default: the data set in use (data/ROBOT/record.safetensors), replaced."""
    url: str = ""
    """The first flight of a vehicle behind udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT. It takes off, is excited
    in a box, slow first, and lands; nothing is filtered: nothing may be there."""
    first: Flags[First] = field(default_factory=First)
    accept_bound: float | None = None
    """With --url: put a model set to use that states at most this share of plans outside their tubes (0.26: 26 %).
    Without it the limit of the robot's description counts: `accept_bound`, 0.01 unless it has one."""
    json: bool = False

    def run(self) -> int:
        if self.url:
            return self._first_flight()
        robot = robot_maybe_with_task(self.robot)
        path = self.out or record_path(robot)
        data = recorded(robot, path, self.trajectories, self.seed, self.physics.conditions(), again=True)
        figures = {"path": str(path), "trajectories": len(data.trajectories), "periods": data.periods}
        if self.json:
            say_json(figures | {"digest": data.digest(), "about": data.about})
        else:
            console.print(f"{path}: {data.periods} periods in {len(data.trajectories)} trajectories, {data.digest()}")
            console.print("next: " + f"brakeline certify {path}")
        return 0

    def _first_flight(self) -> int:
        """Raises ValueError for a robot that does not fly."""
        from brakeline.deploy.run.first_flight_run import MaidenSettings, fly

        robot = robot_maybe_with_task(self.robot)
        if robot.position_dim != 3:
            raise ValueError(f"a {robot.kind} robot does not fly")
        accepted_bound(robot, self.accept_bound)
        first = self.first
        path = self.out or record_path(robot).with_name("flown.safetensors")
        found = fly(
            robot.in_lockstep().in_real_time(),
            MaidenSettings(
                self.url,
                first.system,
                first.minutes,
                first.height,
                first.room,
                self.seed,
                first.raise_limits,
                first.lead,
            ),
        )
        with alone(path.parent):
            found.data.save(path)
        figures: dict[str, Any] = {"path": str(path), "periods": found.data.periods, "minutes": found.seconds / 60.0}
        figures |= {"level": found.level, "missing": found.missing}
        loose = ""
        if found.model is not None and found.statement is not None:
            figures |= {"windows_of": found.model.model_config.windows} | found.statement.figures()
            loose = refusal(robot, found.model.about, self.accept_bound)
            if not loose:
                model = model_path(found.model.robot, found.model.model_config)
                found.model.save(model)
                figures["model"] = str(model)
        if loose:
            figures["not_used"] = loose
            errors.print(f"[red]not put to use:[/] {escape(loose)}")
            errors.print(f"to look at it again: brakeline certify {path} --robot {robot.name} --few", markup=False)
        if self.json:
            say_json(figures)
            return 0 if "model" in figures else 1
        console.print(f"{path}: {found.data.periods} periods in {found.seconds / 60.0:.1f} min of flight", markup=False)
        if found.statement is not None and found.model is not None:
            console.print(table([(found.statement, found.model.model_config.windows)]))
            console.print(in_words(found.statement, robot.period), markup=False)
            if not loose:
                console.print(f"{figures['model']}: in use from now on", markup=False)
        for line in found.missing:
            console.print(f"missing: {line}", markup=False)
        return 0 if "model" in figures else 1


@dataclass(frozen=True)
class Certify:
    data: Annotated[Path | None, tyro.conf.Positional] = None
    """A data set, or a log (file or run folder): then of its last steps; default: the data set in use of --robot."""
    certificates: tuple[str, ...] = KINDS
    mode: Mode | None = None
    """Only this one; default: both."""
    windows: Literal["plan", "free", "auto"] = "auto"
    """From which driving: plans as the filter makes them, any, or any where there are too few plans."""
    few: bool = False
    """Of minutes of driving instead of hours: 60 windows of each length will do, and every envelope is half as wide
    again, as after `collect --url`."""
    until_held: bool = False
    """Widen every envelope until no held-out plan leaves its set, and by no more: what few plans support."""
    robot: str = "ground"
    """Whose data set in use; of a log: whose steps are taken."""
    last: int = 20_000
    """Of a log: so many of the last steps."""
    use: bool = False
    """Write the model sets to where the other commands look for them."""
    accept_bound: float | None = None
    """With --use and --publish: put model sets to use that state at most this share of plans outside their tubes
    (0.26: 26 %). Without it the limit of the robot's description counts: `accept_bound`, 0.01 unless it has one."""
    publish: bool = False
    """Replace the model set of running safety services by the first of `certificates` (mode direct unless given)."""
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    verbose: bool = False
    """Say also how the data were recorded: sensors' errors, wind, load."""
    json: bool = False

    def run(self) -> int:
        path, source = self._load()
        results: dict[str, Any] = {}
        rows: list[tuple[ValidationReport, str]] = []
        passed: list[str] = []
        chosen: ModelSet | None = None
        loose: list[str] = []
        robot = source.data.robot
        accepted_bound(robot, self.accept_bound)
        modes = (self.mode,) if self.mode else MODES
        with under_way("certifying", len(self.certificates) * len(modes)) as advance:
            for kind, mode in product(self.certificates, modes):
                advance(0, f"certifying {kind}, {mode}")
                model_config = ModelConfig(kind, mode)
                try:
                    model_config = model_config.of_minutes() if self.few else model_config
                    model, statement, not_of = supported(source.data, model_config, self.windows, self.until_held)
                except Unsupported as error:
                    results.setdefault(kind, {})[mode] = {"refused": str(error)}
                    errors.print(f"[red]{kind}, {mode}: refused:[/] {escape(str(error))}")
                    if not self.few:
                        errors.print("a few minutes of driving are judged with --few", markup=False)
                    continue
                finally:
                    advance()
                chosen = chosen or model
                rows.append((statement, model.model_config.windows))
                passed += [f"{other} windows: {reason}" for other, reason in not_of.items()]
                told = {"windows_of": model.model_config.windows, "not_of": not_of}
                why = refusal(robot, model.about, self.accept_bound) if self.use or self.publish else ""
                if why:
                    told["not_used"] = why
                    loose.append(f"{kind}, {mode}")
                    errors.print(f"[red]{kind}, {mode}: not put to use:[/] {escape(why)}")
                elif self.use:
                    self._keep(model, source.data)
                results.setdefault(kind, {})[mode] = statement.figures() | told
        if self.json:
            # The figures of a certificate are those of the direct mode; the recursion's stand beside them.
            flat = {k: modes.get("direct", next(iter(modes.values()))) | modes for k, modes in results.items()}
            say_json(flat | {"source": str(path), "periods": source.data.periods, "note": source.note})
        else:
            console.print(table(rows))
            if rows:
                console.print(in_words(rows[0][0], source.data.robot.period), markup=False)
            for text in dict.fromkeys(passed):
                console.print(f"not supported: {text}", markup=False)
            for text in dict.fromkeys(widened(statement) for statement, _ in rows):
                if text:
                    console.print(text, markup=False)
            for text in more_to_drive(rows[0][0], source.data) if rows else ():
                console.print(f"missing: {text}", markup=False)
            console.print(f"{path}: {source.note}", markup=False)
            if self.verbose:
                console.print(conditions(source.data.about))
        if chosen is None:
            return 1
        if self.publish and not refusal(robot, chosen.about, self.accept_bound):
            self._publish(chosen, source.data)
        return 1 if loose else 0

    def _keep(self, model: ModelSet, data: Dataset) -> None:
        """Where the other commands look for it; with a key to sign with, signed."""
        path, keys = model_path(model.robot, model.model_config), self.endpoints.keys or default_keys()
        seal_of(path).unlink(missing_ok=True)
        if keys is not None and (keys / KEY).exists():
            ModelSigner.load(keys).sign(model, data).save(path)
        else:
            model.save(path)

    def _load(self) -> tuple[Path, Recorded]:
        """Raises ValueError when there is no such file: what was mistyped is not recorded anew."""
        if self.data is None:
            robot = robot_maybe_with_task(self.robot)
            path, data = record_path(robot.in_lockstep()), data_for(robot)
        elif self.data.suffix == ".safetensors":
            if not self.data.exists():
                raise ValueError(f"no data set at {self.data}: `brakeline collect {self.robot} --out FILE` records one")
            named = robot_maybe_with_task(self.robot)
            path, data = self.data, Dataset.load(self.data)
            if named.kind == data.robot.kind:  # the limit is that of the description today, not of when it was recorded
                data = replace(data, robot=replace(data.robot, accept_bound=named.accept_bound))
        else:
            return self.data, from_log(self.data, robot_maybe_with_task(self.robot), self.last)
        return path, Recorded(data, f"{data.periods} recorded periods of {data.robot.name}")

    def _publish(self, model: ModelSet, data: Dataset) -> None:
        settings = self.endpoints.bus()
        with Bus(settings, "certify") as bus:
            message = pb.Model(robot=model.robot.name, version=model.version, file=model.encode())
            if settings.keys is not None:
                signed = ModelSigner.load(settings.keys).sign(model, data)
                message.file, message.claim, message.signature = signed.file, signed.claim, signed.signature
            bus.publisher(MODEL, robot=model.robot.name).put(message)
        errors.print(f"published {model.model_config.certificate} {model.version} for {model.robot.name}")


def widened(statement: ValidationReport) -> str:
    """That envelopes were widened, and what for; empty: they are as wide as they always are."""
    usual = ModelConfig().inflation
    if statement.inflation <= usual * 1.001 or statement.inflation == ModelConfig().of_minutes().inflation:
        return ""
    return (
        f"{statement.certificate}, {statement.mode}: every envelope is widened by {statement.inflation:.3g}, not by "
        f"{usual:g}, so that no more than {statement.violations} of {statement.windows} held-out plans leave their sets"
    )


def table(rows: list[tuple[ValidationReport, str]]) -> StackingTable:
    shown = StackingTable(title="what held-out plans say (bounds at 99 % confidence)")
    for column in (
        *("certificate", "mode", "driving", "samples", "rank", "condition", "plans", "violations"),
        *(
            "≤ per step",
            "≤ per plan",
            "≤ per episode",
            "outside an hour",
            "stop from rest",
            "from full speed",
            "clearance margin",
        ),
    ):
        shown.add_column(column, justify="left" if column in ("certificate", "mode", "driving") else "right")
    for s, windows in rows:
        shown.add_row(
            s.certificate,
            s.mode + ("" if s.certificate != RESIDUAL or s.mode != "direct" else " *"),
            windows,
            *(str(s.samples), str(s.rank), f"{s.condition:.0f}", str(s.windows), str(s.violations)),
            *(f"{s.bound_step:.3%}", f"{s.bound_plan:.3%}", f"{s.bound_episode:.1%}", f"≤ {s.outside_hour:.0f} steps"),
            *(width(value) for value in (s.half_width_rest, s.half_width_full, s.clearance_margin)),
        )
    shown.caption = "* the default; half-widths: a full stop's set, largest axis"
    return shown


def in_words(s: ValidationReport, period: float) -> str:
    """What a statement says of how far its model set can be trusted; period: s between two steps."""
    episode, hour = f"{EPISODE} steps ({EPISODE * period:.0f} s)", f"{round(HOUR / period):,} steps"
    in_place = (
        f"  a turn on the spot: at most {s.bound_in_place:.2%} of {s.in_place_windows} such plans leave their tube "
        f"({s.in_place_violations} did)",
    )
    lines = (
        f"{s.certificate}, {s.mode}, in words, at {CONFIDENCE:.0%} confidence, from {s.windows} held-out plans:",
        f"  a step: at most {s.bound_step:.2%} of steps leave their predicted set ({s.step_violations} did)",
        f"  a plan, driven to its stop: at most {s.bound_plan:.2%} of plans leave their tube ({s.violations} did)",
        f"  an episode of {episode}: at most {s.outside_episode:.2g} steps outside on average; at least one in up to "
        f"{s.bound_episode:.0%} of episodes, if steps are independent",
        f"  an hour of driving ({hour}): at most {s.outside_hour:.3g} steps outside on average",
        *(in_place if s.in_place_windows else ()),
        "A step outside is no collision by itself, but nothing was verified about where the robot then is.",
        "The bounds hold for driving like the recorded one; more held-out plans make them tighter.",
    )
    return "\n".join(lines)


def width(metres: float) -> str:
    """Of a tube, for people. A recursion whose bounds grow on themselves ends in numbers that mean nothing."""
    if not metres < DIVERGES:
        return "diverges"
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else f"{metres:.1f} m"
