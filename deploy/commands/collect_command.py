"""Implement `brakeline collect`: record the data set that the filter learns a robot from."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.markup import escape

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.certify_command import bounds_in_words, validation_table
from brakeline.deploy.commands.command_output import errors, print_result
from brakeline.deploy.data.simulated_recording import SEED, load_or_record
from brakeline.deploy.run.first_flight_run import FirstFlightSettings
from brakeline.messaging.acceleration_age import OLDEST


@dataclass(frozen=True)
class CollectCommand:
    """The options of `brakeline collect`."""

    robot: options.Robot = "ground"
    trajectories: int | None = None
    """Record this many trajectories of 300 control periods, and half as many of 120. Defaults to as many as the plans
    of the robot need."""
    seed: options.Seed = SEED
    physics: options.Unprefixed[options.PhysicsOptions] = field(default_factory=options.PhysicsOptions)
    out: Path | None = None
    """Write the data set to this file. Defaults to the data set in use, data/ROBOT/record.safetensors."""
    url: str = ""
    """Fly the vehicle behind this link for the first time: udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT. The
    vehicle takes off, flies random targets in a box, slowly at first, and lands. No filter checks this flight: clear
    the box."""
    first_flight: options.Unprefixed[FirstFlightSettings] = field(default_factory=FirstFlightSettings)
    accept_bound: options.AcceptBound = None
    quiet: options.Quiet = False
    json: options.Json = False

    @property
    def extras(self) -> tuple[str, ...]:
        """The optional parts that the command needs."""
        return ("sim", "mavlink", "logs") if self.url else ("sim",)

    def run(self) -> int:
        """Record the data set. Returns the exit status; 1 if a first flight gave no model set to use."""
        from brakeline.deploy.data.data_paths import record_path
        from brakeline.messaging.task import robot_maybe_with_task

        self._check()
        if self.url:
            return self._first_flight()
        robot = robot_maybe_with_task(self.robot)
        path = self.out or record_path(robot)
        data = load_or_record(robot, path, self.trajectories, self.seed, self.physics.conditions(), again=True)
        figures = {"path": str(path), "trajectories": len(data.trajectories), "periods": data.periods}
        figures |= {"digest": data.digest(), "about": data.about}
        counts = f"{data.periods} periods in {len(data.trajectories)} trajectories, {data.digest()}"
        following = shlex.join(["brakeline", "certify", self.robot, "--data", str(path)])
        print_result(self.json, figures, f"{path}: {counts}", f"next: {following}")
        return 0

    def _check(self) -> None:
        """Raise ValueError for a value that makes no sense, and for options that do nothing with or without --url."""
        if self.seed < 0 or (self.trajectories is not None and self.trajectories < 1):
            raise ValueError("--seed is a number from 0 on, and --trajectories a number from 1 on")
        if self.out is not None:
            from brakeline.safety.model.dataset import Dataset

            Dataset.check_out(self.out)
        if self.url and (self.trajectories is not None or self.physics != options.PhysicsOptions()):
            raise ValueError("--url ignores --trajectories and what changes the simulator: leave these options out")
        age = self.first_flight.acceleration_age
        if age is not None and not 0.0 <= age <= OLDEST:
            raise ValueError(f"--acceleration-age is a number of seconds from 0 to {OLDEST:g}, not {age:g}")
        if not self.url and (self.first_flight != FirstFlightSettings() or self.accept_bound is not None):
            raise ValueError("the options of a first flight, such as --minutes and --accept-bound, need --url")

    def _first_flight(self) -> int:
        from brakeline.deploy.data.data_paths import record_path
        from brakeline.deploy.data.model_store import put_to_use
        from brakeline.deploy.run.first_flight_run import fly
        from brakeline.messaging.task import robot_maybe_with_task
        from brakeline.safety.model.stated_bound import accepted_bound, refusal

        robot = robot_maybe_with_task(self.robot)
        if robot.position_dim != 3:
            raise ValueError(f"a {robot.kind} robot does not fly: leave out --url")
        accepted_bound(robot, self.accept_bound)
        path = self.out or record_path(robot).with_name("flown.safetensors")
        flight = fly(robot.in_lockstep().in_real_time(), self.url, self.seed, self.first_flight, path)
        minutes, model, report = flight.seconds / 60.0, flight.model, flight.report
        figures: dict[str, Any] = {"path": str(path), "periods": flight.data.periods, "minutes": minutes}
        figures |= {"level": flight.level, "missing": flight.missing}
        text: list[Any] = [f"{path}: {flight.data.periods} periods in {minutes:.1f} min of flight"]
        if model is not None and report is not None:
            windows = model.model_config.windows
            figures |= {"windows_of": windows} | report.figures()
            text += [validation_table([(report, windows)]), bounds_in_words(report, robot.period)]
            refused = refusal(robot, model.about, self.accept_bound)
            if refused:
                figures["not_used"] = refused
                errors.print(f"[red]not put to use:[/] {escape(refused)}")
                again = shlex.join(["brakeline", "certify", robot.name, "--data", str(path), "--few"])
                errors.print(f"to validate it again: {again}", markup=False)
            else:
                used = put_to_use(model, flight.data, options.default_keys())
                figures["model"] = str(used)
                text.append(f"{used}: in use from now on")
        print_result(self.json, figures, *text, *(f"missing: {line}" for line in flight.missing))
        return 0 if "model" in figures else 1
