"""Say in a few lines how a run went: goals, collisions, interventions, late answers, and what to do next."""

from __future__ import annotations

from collections import defaultdict, deque
from shlex import quote
from typing import Any

from brakeline.learner.checkpoint import NOT_SAVED
from brakeline.messaging import brakeline_pb2 as pb

LATEST = 100  # episodes


class LatestEpisodes:
    """The outcomes of the latest episodes of each robot kind, in the order in which they ended."""

    def __init__(self) -> None:
        self._goals: defaultdict[str, deque[bool]] = defaultdict(lambda: deque(maxlen=LATEST))

    def step(self, step: pb.Step) -> None:
        if step.terminated or step.truncated:
            self._goals[step.robot].append(step.goal)

    def figures(self) -> dict[str, dict[str, int]]:
        """Return by robot kind the number of episodes, and how many of them reached the goal."""
        return {robot: {"episodes": len(goals), "goals": sum(goals)} for robot, goals in sorted(self._goals.items())}


def verdict(figures: dict[str, Any]) -> list[str]:
    """Return the verdict on a run by `Launcher.figures`: three lines, and one more for each thing that went wrong."""
    if not (figures["steps"] or figures.get("from_logs") or figures["learners"]):
        return [f"ended before the first step; nothing was driven, see {figures['folder']}/logs if you did not end it"]
    lines = [_outcome(figures), _answers(figures)] if figures["steps"] else []
    if figures.get("resumed") and figures["finished"] and not (figures["steps"] or figures.get("from_logs")):
        lines.append("nothing was driven: the run had all its steps already. To go on, give more --steps")
    if fed := figures.get("from_logs"):
        lines.append(
            f"steps from logs: {fed.get('published', 0)}, and {fed.get('known', 0)} that the learner had already"
            + (f"; {fed['unusable']} are unusable, see {figures['folder']}/logs" if fed.get("unusable") else "")
        )
    if not figures["log"]:
        lines.append(f"no log was recorded; policies: {', '.join(figures['policies']) or 'none'}")
    else:
        lines.append(f"next: brakeline analyse {quote(figures['folder'])} --html report.html")
    if refused := figures.get("refused"):
        lines.append(f"{refused} steps do not count: repeated, or not permitted by the learner")
    lines += _untrained(figures)
    lines += [
        f"THE POLICY WAS NOT SAVED: {reason}. A file that is there is of earlier weights. Free some space, and learn "
        f"again from the last checkpoint: brakeline train --resume {quote(figures['folder'])}"
        for reason in not_saved(figures)
    ]
    if not figures["finished"] and figures.get("policy") in (None, "learning"):
        lines.append(
            f"stopped before the last step; continue with: brakeline train --resume {quote(figures['folder'])}"
        )
    return lines


def not_saved(figures: dict[str, Any]) -> list[str]:
    """Return for each learner whose last policy was not written the reason, which names the file."""
    return [one["notes"][NOT_SAVED] for one in figures["processes"].values() if one["notes"].get(NOT_SAVED)]


def _untrained(figures: dict[str, Any]) -> list[str]:
    """Return a line for each learner of a finished run that made no update."""
    if not figures["finished"] or figures.get("policy") not in (None, "learning"):
        return []
    return [
        f"the policy of {robot} has learned nothing: the run ended within the warm-up, whose steps are random; give "
        "more --steps, or a smaller --learner.td3.warmup"
        for robot, learner in figures["learners"].items()
        if learner["updates"] == 0
    ]


def _outcome(figures: dict[str, Any]) -> str:
    latest = [
        f"{row['goals']} of the last {row['episodes']} episodes reached the goal"
        + (f" ({robot})" if len(figures["latest"]) > 1 else "")
        for robot, row in figures["latest"].items()
    ]
    corrected = f"{figures['interventions'] / figures['steps']:.1%} of {figures['steps']} steps corrected"
    since = "since the resumption: " if figures.get("resumed") else ""
    return (
        f"{since}{', '.join(latest) or 'no episode ended'}; {_counted(figures['collisions'], 'collision')}; {corrected}"
    )


def _answers(figures: dict[str, Any]) -> str:
    if not (late := figures["fallbacks"]):
        return "every answer came in time"
    return f"{_counted(late, 'answer')} came late or not at all: there the robot braked along its verified plan"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
