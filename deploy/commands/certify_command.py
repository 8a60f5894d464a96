"""Implement `brakeline certify`: validate model sets on held-out data, and put them to use or publish them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from rich.markup import escape

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import conditions_table, console, errors, print_json
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.progress import PERCENT, by_share, under_way
from brakeline.errors import Unsupported
from brakeline.logs.stacking_table import StackingTable
from brakeline.messaging.stated_share import percent
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.model.model_config import KINDS, MODES, ONE_STEP, RECURSION, RESIDUAL, ModelConfig
from brakeline.safety.model.stated_bound import accepted_bound, refusal

if TYPE_CHECKING:
    from brakeline.deploy.progress import Advance
    from brakeline.messaging.robot import Robot
    from brakeline.safety.model.dataset import Dataset
    from brakeline.safety.model.model_set import ModelSet
    from brakeline.safety.model.validation import ValidationReport

DATA = (".safetensors", ".mcap")  # endings of data sets and logs
DIVERGENT = 100.0  # m, half-width of a stop that is wider than any arena


@dataclass(frozen=True)
class CertifyCommand:
    """The options of `brakeline certify`."""

    robot: options.Robot = "ground"
    data: Path | None = None
    """Certify this data set, or the last steps of this log (file or run folder). Defaults to the
    robot's data set in use."""
    certificates: tuple[str, ...] = ()
    """Validate these error bounds of the linear modes (see docs/certificates.md). Defaults to all of them if you
    give --mode direct or recursion."""
    mode: Literal["one-step", "direct", "recursion"] | None = None
    """Validate this prediction mode: one-step rolls out one learned period, direct and recursion are linear. Defaults
    to one-step, or to direct and recursion if you give --certificates. A robot that stops by feedback has no mode
    one-step."""
    windows: Literal["plan", "free", "auto"] = "auto"
    """In the linear modes, fit and validate on this kind of driving: plan takes the windows that brake as the filter
    does, free takes every window, and auto takes every window if the others are too few."""
    few: bool = False
    """In the linear modes, accept minutes of driving instead of hours: 60 windows of each length suffice instead of
    200, and each error bound is scaled by 1.5 instead of 1.15, as `collect --url` does. In mode one-step, this option
    scales only the bound of the stopping distance."""
    outside: float = ModelConfig.outside
    """Let this share of the recorded plans leave their sets in mode one-step. A larger share makes the sets narrower
    and the stated bound larger."""
    until_held: bool = False
    """Widen each error bound of the linear modes until no held-out plan leaves its set, and no further."""
    last: int = 20_000
    """Take this many steps from the end of a log."""
    use: bool = False
    """Put the model sets to use: write them to the files that the other commands load."""
    accept_bound: options.AcceptBound = None
    publish: bool = False
    """Replace the model set of running safety services by the first one that this command validates."""
    endpoints: options.Unprefixed[options.BusOptions] = field(default_factory=options.BusOptions)
    verbose: options.Verbose = False
    quiet: options.Quiet = False
    json: options.Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "logs")
    least: ClassVar[dict[str, float]] = {"last": 1}

    def run(self) -> int:
        """Validate the model sets. Returns the exit status; 1 if none is supported, or one may not be used."""
        settings = ModelConfig(outside=self.outside)  # before data are recorded: it may be out of range
        path, data, note = self._load()
        accepted_bound(data.robot, self.accept_bound)
        forms = self._forms(data.robot)
        self._refuse_unused(forms)
        if self.until_held and (RESIDUAL, ONE_STEP) in forms:
            raise ValueError(
                "--until-held is for --mode direct and recursion; in mode one-step, a smaller --outside widens the sets"
            )
        with under_way("certifying", PERCENT * len(forms)) as advance:
            models, notes, results = self._certify(forms, settings, data, advance)
        if self.json:
            # The figures of a certificate are those of the direct mode; those of each mode stand beside them.
            flat = {kind: row.get("direct", next(iter(row.values()))) | row for kind, row in results.items()}
            print_json(flat | {"source": str(path), "periods": data.periods, "note": note})
        else:
            self._print(models, notes, data)
            console.print(f"{path}: {note}", markup=False)
            for kind, mode, row in ((k, m, row) for k, modes in results.items() for m, row in modes.items()):
                if "in_use" not in row:
                    continue
                console.print(f"{row['in_use']}: in use from now on{only_with(kind, mode)}", markup=False)
                if refusal(data.robot, {"bound_plan": str(row["bound_plan"])}):
                    console.print(
                        "other commands refuse this model set unless you give them the same --accept-bound",
                        markup=False,
                    )
            if self.verbose:
                console.print(conditions_table(data.about))
        if self.publish and models and not self._refusal(models[0][0], data):
            self._publish(models[0][0], data)
        return int(not models or any("not_used" in row for modes in results.values() for row in modes.values()))

    def _certify(
        self, forms: list[tuple[str, str]], settings: ModelConfig, data: Dataset, advance: Advance
    ) -> tuple[list[tuple[ModelSet, ValidationReport]], list[str], dict[str, Any]]:
        """Return the supported model sets with their reports, notes to print, and the figures of each form."""
        from brakeline.deploy.data.certification import certify_supported

        models: list[tuple[ModelSet, ValidationReport]] = []
        results: dict[str, Any] = {}
        notes: list[str] = []
        for kind, mode in forms:
            advance(0, f"certifying {kind}, {mode}")
            progress = by_share(advance)
            try:
                config = replace(settings, certificate=kind, mode=mode)
                config = config.of_minutes() if self.few else config
                model, report, unsupported = certify_supported(data, config, self.windows, self.until_held, progress)
            except Unsupported as error:
                figures = {"refused": str(error)}
                errors.print(f"[red]{kind}, {mode}: refused:[/] {escape(str(error))}")
                if not self.few and mode != ONE_STEP:  # which needs no number of windows
                    errors.print("give --few to certify minutes of driving", markup=False)
            else:
                models.append((model, report))
                notes += [f"not supported: {windows} windows: {reason}" for windows, reason in unsupported.items()]
                figures = report.figures() | {"windows_of": model.model_config.windows, "not_of": unsupported}
                figures |= self._put_to_use(model, data)
            results.setdefault(kind, {})[mode] = figures
            progress(1.0)
        return models, notes, results

    def _forms(self, robot: Robot) -> list[tuple[str, str]]:
        """Return the forms to validate: pairs of an error bound and a mode."""
        mode = self.mode
        if mode is None and not self.certificates:
            mode = "direct" if robot.feedback else "one-step"
            return [(RESIDUAL, mode)]
        if mode == ONE_STEP:
            if others := [name for name in self.certificates if name != RESIDUAL]:
                raise ValueError(
                    f"mode one-step has no error bound {', '.join(others)}: give --mode direct or recursion"
                )
            return [(RESIDUAL, mode)]
        return list(product(self.certificates or KINDS, (mode,) if mode else MODES))

    def _refuse_unused(self, forms: list[tuple[str, str]]) -> None:
        """Raise ValueError for an option that does nothing in these forms, or with these data."""
        one_step, log = (RESIDUAL, ONE_STEP) in forms, self.data is not None and self.data.suffix != DATA[0]
        unused = {
            "--windows is for --mode direct and recursion": one_step and self.windows != CertifyCommand.windows,
            "--outside is for mode one-step": not one_step and self.outside != CertifyCommand.outside,
            "--last is for logs": not log and self.last != CertifyCommand.last,
        }
        if reasons := [reason for reason, is_unused in unused.items() if is_unused]:
            raise ValueError(f"{'; '.join(reasons)}: leave that out")

    def _put_to_use(self, model: ModelSet, data: Dataset) -> dict[str, str]:
        """Save the model set if you give --use, and return its path; or return and print why it may not be used."""
        if not (self.use or self.publish):
            return {}
        if refused := self._refusal(model, data):
            config = model.model_config
            errors.print(f"[red]{config.certificate}, {config.mode}: not put to use:[/] {escape(refused)}")
            return {"not_used": refused}
        if not self.use:
            return {}
        from brakeline.deploy.data.model_store import put_to_use

        return {"in_use": str(put_to_use(model, data, self.endpoints.keys or options.default_keys()))}

    def _refusal(self, model: ModelSet, data: Dataset) -> str:
        return refusal(data.robot, model.about, self.accept_bound)

    def _print(self, models: list[tuple[ModelSet, ValidationReport]], notes: list[str], data: Dataset) -> None:
        from brakeline.deploy.data.coverage import recording_advice
        from brakeline.deploy.data.description_summary import unmeasured_holds

        console.print(validation_table([(report, model.model_config.windows) for model, report in models]))
        for _, report in models:
            if report.groups:
                console.print(group_table(report))
        lines = [bounds_in_words(models[0][1], data.robot.period)] if models else []
        lines += dict.fromkeys((*notes, *filter(None, (widening(report) for _, report in models))))
        lines += dict.fromkeys(filter(None, (unrecorded(model) for model, _ in models)))
        lines += [f"missing: {text}" for text in recording_advice(models[0][1], data)] if models else []
        lines += filter(None, [unmeasured_holds(data.robot)])
        for line in lines:
            console.print(line, markup=False)

    def _load(self) -> tuple[Path, Dataset, str]:
        """Return the source, its data and a note. Raises ValueError if a named data set does not exist."""
        from brakeline.deploy.data.run_dataset import from_log
        from brakeline.deploy.data.simulated_recording import data_for, described_today
        from brakeline.safety.model.dataset import Dataset

        if self.robot.endswith(DATA) or Path(self.robot).is_dir():
            raise ValueError(f"{self.robot} is no robot: `brakeline certify ROBOT --data {quote(self.robot)}`")
        robot = robot_maybe_with_task(self.robot)
        if self.data is None:
            path, data = record_path(robot.in_lockstep()), data_for(robot)
        elif self.data.suffix == ".safetensors":
            if not self.data.exists():  # a mistyped name must not start a recording
                raise ValueError(
                    f"no data set at {self.data}: `brakeline collect {quote(self.robot)} --out FILE` records one"
                )
            path, data = self.data, Dataset.load(self.data)
            if robot.kind == data.robot.kind:
                data = described_today(data, robot, path)
            elif self.robot != CertifyCommand.robot:  # which nobody may have given
                raise ValueError(
                    f"{path} has data of {data.robot.kind}, not of {robot.kind}: certify {data.robot.kind}, or import "
                    f"the log again with --robot {self.robot}"
                )
        else:
            return self.data, *from_log(self.data, robot, self.last)
        return path, data, f"{data.periods} recorded periods of {data.robot.name}"

    def _publish(self, model: ModelSet, data: Dataset) -> None:
        from brakeline.messaging import brakeline_pb2 as pb
        from brakeline.messaging.bus import Bus
        from brakeline.messaging.topics import MODEL
        from brakeline.safety.service.signature import ModelSigner

        settings = self.endpoints.bus()
        with Bus(settings, "certify") as bus:
            message = pb.Model(robot=model.robot.name, version=model.version, file=model.encode())
            if settings.keys is not None:
                signed = ModelSigner.load(settings.keys).sign(model, data)
                message.file, message.claim, message.signature = signed.file, signed.claim, signed.signature
            bus.publisher(MODEL, robot=model.robot.name).put(message)
        errors.print(f"published {model.model_config.certificate} {model.version} for {model.robot.name}")


def only_with(certificate: str, mode: str) -> str:
    """Say which options the commands need that are to load a model set in use; empty if they load it without any."""
    words = [f"--certificate {certificate}"] * (certificate != RESIDUAL) + [f"--mode {mode}"] * (mode == RECURSION)
    return f" by commands with {' '.join(words)}; without that, they load another one" if words else ""


def widening(report: ValidationReport) -> str:
    """Say that error bounds are wider than usual, and why. Empty if they are not."""
    usual = ModelConfig().inflation
    if report.mode == ONE_STEP:
        return ""
    if report.inflation <= usual * 1.001 or report.inflation == ModelConfig().of_minutes().inflation:
        return ""
    return (
        f"{report.certificate}, {report.mode}: every error bound is widened by {report.inflation:.3g}, not by "
        f"{usual:g}, so that no more than {report.violations} of {report.windows} held-out plans leave their sets"
    )


def unrecorded(model: ModelSet) -> str:
    """Say which part of an input's range was recorded, if it is not all of it. Empty if all inputs were recorded."""
    from brakeline.deploy.data.sources.quantity_names import column_names, column_units
    from brakeline.safety.filter.plan_inputs import PlanInputs, recorded_inputs

    robot, units = model.robot, column_units(model.robot)
    inputs = PlanInputs(robot, recorded_inputs(model))
    parts = zip(column_names(robot)[1], inputs.low, inputs.high, robot.low(), robot.high(), strict=True)
    ranges = [
        f"{name} from {low:.3g} to {high:.3g} {units[name]} ({percent((high - low) / (most - least))} of its range)"
        for name, low, high, least, most in parts
        if low > least or high < most
    ]
    return f"the filter verifies recorded inputs alone: {', '.join(ranges)}" if ranges else ""


def validation_table(rows: list[tuple[ValidationReport, str]]) -> StackingTable:
    """Return a table of validation reports, each with the kind of its windows."""
    table = StackingTable(title="validation on held-out plans (bounds at 99 % confidence)")
    for column in ("certificate", "mode", "driving"):
        table.add_column(column)
    for column in (
        *("samples", "rank", "condition", "plans", "violations", "≤ per step", "≤ per plan", "≤ per episode"),
        *("outside, in an hour", "stop from rest", "from full speed", "clearance margin"),
    ):
        table.add_column(column, justify="right")
    for s, windows in rows:
        table.add_row(
            s.certificate,
            s.mode + ("" if s.certificate != RESIDUAL or s.mode != "direct" else " *"),
            windows,
            *(str(s.samples), str(s.rank), f"{s.condition:.0f}", str(s.windows), str(s.violations)),
            *(percent(bound) for bound in (s.bound_step, s.bound_plan, s.bound_episode)),
            f"≤ {math.ceil(s.outside_hour)} steps",
            *(width(value, s.unit) for value in (s.half_width_rest, s.half_width_full)),
            width(s.clearance_margin),
        )
    table.caption = "half-widths of a full stop, largest axis"
    if any(s.certificate == RESIDUAL and s.mode == "direct" for s, _ in rows):
        table.caption = f"* the default of the linear modes; {table.caption}"
    if any(s.unit != "m" for s, _ in rows):
        table.caption += "; in joint space, shares of half the distance between a limit and the opposite one"
    return table


def bounds_in_words(s: ValidationReport, period: float) -> str:
    """Return the bounds of a validation report as sentences. period: control period [s]."""
    from brakeline.safety.model.validation import CONFIDENCE, EPISODE, HOUR

    hourly = f"{s.outside_hour:.3g}" if s.outside_hour < 1000.0 else f"{s.outside_hour:,.0f}"
    lines = [
        f"{s.certificate}, {s.mode}, in words, at {CONFIDENCE:.0%} confidence, from {s.windows} held-out plans:",
        f"  a step: at most {percent(s.bound_step)} of steps leave their predicted set ({s.step_violations} did)",
        f"  a plan, driven to its stop: at most {percent(s.bound_plan)} of plans leave their tube ({s.violations} did)",
        f"  an episode of {EPISODE} steps ({EPISODE * period:.0f} s): at most {s.outside_episode:.2g} steps outside on "
        f"average; at least one in up to {percent(s.bound_episode)} of episodes, if steps are independent",
        f"  an hour of driving ({round(HOUR / period):,} steps): at most {hourly} steps outside on average",
    ]
    if s.chosen is not None and s.marginal is not None:
        lines += [
            f"  a plan like these: about {percent(s.marginal)} or fewer leave their tube on average (more if ground, "
            "load or battery change slowly, because minutes hold few such changes)",
            f"  predictor: {s.chosen.features} features, selected from products of up to {s.chosen.degree} variables, "
            + ("with" if s.chosen.lags else "without")
            + " the earlier input; 99 % of "
            + ("positions" if s.unit == "m" else "the limits' values")
            + f" within {_error(s)}, out of fold",
        ]
    if s.in_place_windows:
        lines.append(
            f"  a turn on the spot: at most {percent(s.bound_in_place)} of {s.in_place_windows} such plans leave their "
            f"tube ({s.in_place_violations} did)"
        )
    lines += [
        "A step outside is no collision by itself, but the filter has verified nothing about where the robot then is.",
        "The bounds hold for driving like the recorded driving; more held-out plans make them tighter.",
    ]
    return "\n".join(lines)


def group_table(report: ValidationReport) -> StackingTable:
    """Return the statement of a validation report by kind of driving (docs/method.md §14)."""
    table = StackingTable(title="by kind of driving")
    table.add_column("driving")
    for column in ("windows", "plans", "violations", "≤ on average", "≤ per plan", "≤ per step", "largest error"):
        table.add_column(column, justify="right")
    for group in report.groups:
        counts = str(group.windows), str(group.plans), str(group.violations)
        shares = percent(group.marginal), percent(group.bound), percent(group.bound_step)
        table.add_row(group.name, *counts, *shares, f"{group.excess:.0%} of its set")
    table.caption = "windows may overlap, plans and steps do not; bounds at 99 % confidence"
    return table


def _error(s: ValidationReport) -> str:
    assert s.chosen is not None
    return f"{1e3 * s.chosen.error:.3g} mm" if s.unit == "m" else f"{s.chosen.error:.2%}"


def width(metres: float, unit: str = "m") -> str:
    """Return the half-width of a tube as text. A recursion that diverges ends in numbers without meaning."""
    if unit != "m":
        return f"{metres:.2%}"
    if not metres < DIVERGENT:
        return "diverges"
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else f"{metres:.1f} m"
