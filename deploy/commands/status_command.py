"""Implement `brakeline status`: show the living processes of a system."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

from rich.text import Text

from brakeline.deploy.commands.command_output import console, print_json
from brakeline.deploy.commands.common_options import BusOptions, Json, Unprefixed
from brakeline.logs.stacking_table import plain_table
from brakeline.messaging.bus import Bus, Sample
from brakeline.messaging.topics import HEALTH, LEARNER


@dataclass(frozen=True)
class StatusCommand:
    """The options of `brakeline status`."""

    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    wait: float = 1.5
    """Listen for this long [s]. Each living process publishes its health once a second."""
    json: Json = False

    least: ClassVar[dict[str, float]] = {"wait": 0}

    def run(self) -> int:
        """Listen, and print the processes. Returns the exit status."""
        from brakeline.logs.metrics import learner  # imports NumPy, which the help does not need
        from brakeline.logs.watch.run_history import NOTE  # the curves of the live page

        processes: dict[str, Any] = {}
        learners: dict[str, Any] = {}

        def receive_health(sample: Sample) -> None:
            health = sample.message()
            notes = {name: text for name, text in health.notes.items() if name != NOTE}
            processes[health.process] = {"pid": health.pid, **dict(health.figures), **notes}

        def receive_learner(sample: Sample) -> None:
            learners[sample.message().robot] = learner(sample.message())

        with Bus(self.endpoints.bus(), f"viewer.status-{time.time_ns() % 10**6}") as bus:
            bus.subscribe(HEALTH, receive_health)
            bus.subscribe(LEARNER, receive_learner)
            time.sleep(self.wait)
            alive = sorted(name for name in bus.living() if name != bus.source)
        if self.json:
            print_json({"alive": alive, "processes": processes, "learners": learners})
            return 0
        rows = [
            (
                name,
                Text("alive", "green") if name in alive else Text("gone", "red"),
                figures_text(processes.get(name, {})),
            )
            for name in sorted({*alive, *processes})
        ]
        console.print(plain_table(("process", "state", "figures"), rows))
        for robot, figures in learners.items():
            console.print(
                f"learning {robot}: {figures['steps']} steps, {figures['updates']} updates, "
                f"{figures['steps_per_s']:.0f} steps/s, {figures['updates_per_s']:.0f} updates/s, "
                f"critic loss {figures['critic_loss']:.3f}, actor loss {figures['actor_loss']:.3f}, "
                f"weights {figures['weights_version']}"
            )
        return 0


def figures_text(values: dict[str, Any]) -> str:
    """Return the figures and notes of a process that are not zero or empty, without the counts of each channel."""
    shown = {name: value for name, value in values.items() if value and "/" not in name}
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items())
