"""Check that an interrupted training can go on."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path

from brakeline.deploy.run.processes import CONFIG, process_specs
from brakeline.deploy.run.run_config import BATCH, RunConfig, load
from brakeline.errors import CheckpointError, LaunchError
from brakeline.learner import checkpoint


def check_resumable(config: RunConfig, folder: Path) -> None:
    """Check that each learner of the run has a checkpoint to go on from, and no more steps than are asked for.

    Args:
        config: of the run that goes on. With other steps than in the folder, it replaces the configuration there.

    Raises:
        LaunchError: a learner has no checkpoint and gets no logs, or it has more steps than are asked for. Or it has a
            checkpoint, and gets logs of another run.
        DamagedPart: the checkpoint is lost in part, and there are no logs.
    """
    stored = load(folder / CONFIG) if (folder / CONFIG).exists() else config
    others = [name for name in config.from_logs if name not in stored.from_logs and not _within(folder, Path(name))]
    for root in (
        folder / spec.name / checkpoint.CHECKPOINT for spec in process_specs(config) if spec.kind == "learner"
    ):
        learned = 0
        with suppress(*((CheckpointError,) if config.from_logs else ())):
            if not config.from_logs and not checkpoint.exists(root):
                raise LaunchError(f"{folder}: there is no checkpoint in {root}. {_without_checkpoint(config, folder)}")
            learned = checkpoint.about_latest(root).get("steps", 0)
        if others and learned:
            raise LaunchError(
                f"{folder}: the learner has {learned} steps of its own, and would take steps of {', '.join(others)} "
                "for those of its own actors, which it has already. With --resume, --from-logs replaces a lost "
                "checkpoint by the log of the run. To learn from both, begin a new run: `brakeline train --from-logs "
                f"{shlex.join([str(folder), *others])}`"
            )
        if config.steps < min(stored.steps, learned):
            raise LaunchError(
                f"{folder}: the learner has {learned} steps already, more than --steps {config.steps}. To go on, give "
                "more --steps; to see what came of it, `brakeline analyse`"
            )


def _without_checkpoint(config: RunConfig, folder: Path) -> str:
    """Say how a training without a checkpoint can go on."""
    if config.backend == BATCH or config.deterministic:
        why = "a run with --backend batch or --deterministic does not learn from its log"
        return f"Begin anew in another folder: --out ({why})"
    again = f"`brakeline train --resume {shlex.quote(str(folder))} --from-logs {shlex.quote(str(folder))}`"
    return f"Learn again from the run's log: {again}. Or begin anew in another folder: --out"


def _within(folder: Path, path: Path) -> bool:
    """Return whether a log is in the run's folder, or is the folder."""
    return folder.resolve() in (path.resolve(), *path.resolve().parents)
