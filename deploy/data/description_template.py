"""The commented template of a description, filled in with what a log tells."""

from __future__ import annotations

import json
import math
import re

from brakeline.deploy.data.schema_inference import InferredColumn, InferredSchema

BARE = re.compile(r"[A-Za-z0-9_-]+")
ERRORS = {"position": 0.01, "heading": 0.02}  # the template's
ERROR = 0.05
JUMP = 0.8  # of an input's range: who changes it so much in a period keeps no slew
MOST_PERIODS = 64  # of a plan
UNTOLD = "can't be told from the log"


def fill_template(template: str, told: InferredSchema, source: str) -> str:
    """The template's text with its values replaced; what the log can't tell is the template's, and said to be."""
    horizon, brake = periods(told)
    lines = []
    section = ""
    for line in template.splitlines():
        if line.startswith(("[", "# [[")):
            section = line.strip("[]# ")
        if line.startswith("period"):
            lines.append(
                f"period = {told.period:g} # s between decisions; in the log the median between two changes of an input"
            )
        elif line.startswith("sight"):
            lines.append(f"{line}; {UNTOLD}")
        elif section in ("state", "input") and line and not line.startswith(("[", "#")):
            continue  # the template's robot
        elif section == "plan" and line.startswith("horizon"):
            lines.append(f"horizon = {horizon}")
        elif section == "plan" and line.startswith("brake"):
            lines.append(f"brake = {brake} # as strong as the log's strongest braking and quickest inputs; choose")
        elif line.startswith("[[body]]"):
            lines += [f"# The body {UNTOLD}: measure it.", line]
        elif section == "body" and line.startswith("at ="):
            zeros = ", ".join("0.0" for column in told.states if column.role == "position")
            lines.append(line.replace("[0.0, 0.0]", f"[{zeros}]"))
        else:
            lines.append(line)
        if line == "[state]":
            lines.append(f"# error: {UNTOLD}.")
            lines += [text for column in told.states for text in _state(column)]
        elif line == "[input]":
            lines.append("# low, high, slew: what the log has, rounded outwards; the robot may be able to do more.")
            lines += [text for column in told.inputs for text in _input(column)]
            lines += _template_inputs(template) if not told.inputs else []
    about = [f"# Made from {source}. Look at every line: it says what was seen, not what the robot can do."]
    about += [f"# {note}" for note in told.notes]
    return "\n".join((*about, *lines)) + "\n"


def periods(told: InferredSchema) -> tuple[int, int]:
    """(horizon, brake) that the braking and the delays seen ask for: an order of magnitude, no bound."""
    inputs = [(max(-_low(one), _high(one)), most) for one in told.inputs if (most := slew(one)) is not None]
    falls = [(max(abs(c.least), abs(c.most)), c.change) for c in told.states if c.follows and c.change > 0.0]
    brake = max((math.ceil(round(most / change, 6)) for most, change in (*inputs, *falls)), default=1)
    late = math.ceil(max((c.delay or 0.0 for c in told.states), default=0.0) / told.period)
    return min(1 + brake + late + 1, MOST_PERIODS), min(brake, MOST_PERIODS - 2)


def slew(one: InferredColumn) -> float | None:
    """Of an input; None: it was seen to jump."""
    return _outwards(one.change) if 0.0 < one.change < JUMP * (one.most - one.least) else None


def _low(one: InferredColumn) -> float:
    return min(_outwards(one.least), 0.0)


def _high(one: InferredColumn) -> float:
    return max(_outwards(one.most), 0.0)


def _template_inputs(template: str) -> list[str]:
    body = template.split("[input]\n", 1)[1].split("\n\n", 1)[0]
    return [f"# Inputs {UNTOLD}: these are the template's.", *body.splitlines()]


def _state(one: InferredColumn) -> list[str]:
    error = ERRORS.get(one.role, ERROR)
    words = [f"unit = {json.dumps(one.unit or '1')}"]
    words += [f"role = {json.dumps(one.role)}"] if one.role != "other" else []
    words.append(f"error = {error:g}")
    words += [f"follows = {json.dumps(one.follows)}"] if one.follows else []
    seen = [f"{one.least:.3g} to {one.most:.3g} seen"] if one.role != "heading" else []
    seen += [] if one.unit else [f"its unit {UNTOLD}"]
    seen += [f"{1e3 * one.delay:.0f} ms after its input"] if one.delay is not None else []
    seen += [f"brakes by {one.change:.2g} a period"] if one.follows and one.change else []
    return [f"{key(one.name)} = {{ {', '.join(words)} }}" + (f" # {'; '.join(seen)}" if seen else "")]


def _input(one: InferredColumn) -> list[str]:
    words = [f"unit = {json.dumps(one.unit or '1')}", f"low = {_low(one):g}", f"high = {_high(one):g}"]
    most = slew(one)
    words += [f"slew = {most:g}"] if most is not None else []
    steers = one.unit == "rad"
    moves = not steers if one.moves is None else one.moves
    words += [f"moves = {str(moves).lower()}", 'stop = "hold"' if steers else 'stop = "ramp"']
    seen = [] if one.unit else [f"its unit {UNTOLD}"]
    seen += [] if one.moves is not None else [f"moves: {UNTOLD}, it was never driven alone"]
    seen += ["it jumps: no slew"] if most is None else []
    return [f"{key(one.name)} = {{ {', '.join(words)} }}" + (f" # {'; '.join(seen)}" if seen else "")]


def _outwards(value: float) -> float:
    """To three digits, away from zero; what is next to nothing is none."""
    if abs(value) < 1e-9:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    return math.copysign(math.ceil(round(abs(value) / unit, 6)) * unit, value)


def key(name: str) -> str:
    """A name as TOML has it."""
    return name if BARE.fullmatch(name) else json.dumps(name)
