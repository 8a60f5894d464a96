"""Implement `brakeline completion`: print the completion of the commands and their options for a shell."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class CompletionCommand:
    """The options of `brakeline completion`."""

    shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional] = "bash"
    """Print the completion for this shell."""

    def run(self) -> int:
        """Print the completion. Returns the exit status."""
        print(completion(self.shell))
        return 0


def completion(shell: str) -> str:
    """Return the text that a shell evaluates to complete `brakeline`, its commands and their options."""
    from brakeline.deploy.cli import COMMANDS, command_class, registry

    commands = {name: command_class(name) for name in COMMANDS}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="brakeline", args=["--tyro-print-completion", shell], registry=registry
        )
    return printed.getvalue()
