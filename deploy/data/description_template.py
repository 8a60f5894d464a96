"""Fill in the commented template of a robot description from the schema of a log."""

from __future__ import annotations

import json
import math
import re

from brakeline.deploy.data.schema_inference import InferredColumn, InferredSchema

BARE = re.compile(r"[A-Za-z0-9_-]+")
ERRORS = {"position": 0.01, "heading": 0.02}  # measurement errors of the template
ERROR = 0.05
JUMP = 0.8  # share of an input's range: an input that changes more in one period has no slew limit
MOST_PERIODS = 64  # longest plan
UNKNOWN = "cannot be inferred from the log"


def fill_template(template: str, schema: InferredSchema, source: str) -> str:
    """Return the template with the values that the log shows; comments mark values that it does not show."""
    horizon, brake = periods(schema)
    lines = []
    section = ""
    for line in template.splitlines():
        if line.startswith(("[", "# [[")):
            section = line.strip("[]# ")
        if line.startswith("period"):
            lines.append(
                f"period = {schema.period:g} # s between decisions; the median time between input changes in the log"
            )
        elif line.startswith("sight"):
            lines.append(f"{line}; {UNKNOWN}")
        elif section in ("state", "input") and line and not line.startswith(("[", "#")):
            continue  # the template's robot
        elif section == "plan" and line.startswith("horizon"):
            lines.append(f"horizon = {horizon}")
        elif section == "plan" and line.startswith("brake"):
            lines.append(f"brake = {brake} # from the strongest braking and the fastest inputs in the log; check it")
        elif line.startswith("[[body]]"):
            lines += [f"# The body {UNKNOWN}: measure it.", line]
        elif section == "body" and line.startswith("at ="):
            zeros = ", ".join("0.0" for column in schema.states if column.role == "position")
            lines.append(line.replace("[0.0, 0.0]", f"[{zeros}]"))
        else:
            lines.append(line)
        if line == "[state]":
            lines.append(f"# error: {UNKNOWN}.")
            lines += [text for column in schema.states for text in _state(column)]
        elif line == "[input]":
            lines.append("# low, high, slew: the ranges in the log, rounded outwards. The robot may allow more.")
            lines += [text for column in schema.inputs for text in _input(column)]
            lines += _template_inputs(template) if not schema.inputs else []
    about = [f"# Inferred from {source}. Check every line: the log shows what the robot did, not what it can do."]
    about += [f"# {note}" for note in schema.notes]
    return "\n".join((*about, *lines)) + "\n"


def periods(schema: InferredSchema) -> tuple[int, int]:
    """Return (horizon, brake) in periods from the braking and the delays in the log: an estimate, not a bound."""
    inputs = [(max(-_low(one), _high(one)), most) for one in schema.inputs if (most := slew(one)) is not None]
    falls = [(max(abs(c.least), abs(c.most)), c.change) for c in schema.states if c.follows and c.change > 0.0]
    brake = max((math.ceil(round(most / change, 6)) for most, change in (*inputs, *falls)), default=1)
    late = math.ceil(max((c.delay or 0.0 for c in schema.states), default=0.0) / schema.period)
    return min(1 + brake + late + 1, MOST_PERIODS), min(brake, MOST_PERIODS - 2)


def slew(one: InferredColumn) -> float | None:
    """Return the slew limit of an input per period, or None if the input jumps."""
    return _outwards(one.change) if 0.0 < one.change < JUMP * (one.most - one.least) else None


def _low(one: InferredColumn) -> float:
    return min(_outwards(one.least), 0.0)


def _high(one: InferredColumn) -> float:
    return max(_outwards(one.most), 0.0)


def _template_inputs(template: str) -> list[str]:
    body = template.split("[input]\n", 1)[1].split("\n\n", 1)[0]
    return [f"# Inputs {UNKNOWN}: these come from the template.", *body.splitlines()]


def _state(one: InferredColumn) -> list[str]:
    error = ERRORS.get(one.role, ERROR)
    words = [f"unit = {json.dumps(one.unit or '1')}"]
    words += [f"role = {json.dumps(one.role)}"] if one.role != "other" else []
    words.append(f"error = {error:g}")
    words += [f"follows = {json.dumps(one.follows)}"] if one.follows else []
    remarks = [f"{one.least:.3g} to {one.most:.3g} in the log"] if one.role != "heading" else []
    remarks += [] if one.unit else [f"its unit {UNKNOWN}"]
    remarks += [f"{1e3 * one.delay:.0f} ms after its input"] if one.delay is not None else []
    remarks += [f"brakes by {one.change:.2g} a period"] if one.follows and one.change else []
    return [f"{key(one.name)} = {{ {', '.join(words)} }}" + (f" # {'; '.join(remarks)}" if remarks else "")]


def _input(one: InferredColumn) -> list[str]:
    words = [f"unit = {json.dumps(one.unit or '1')}", f"low = {_low(one):g}", f"high = {_high(one):g}"]
    most = slew(one)
    words += [f"slew = {most:g}"] if most is not None else []
    steers = one.unit == "rad"
    moves = not steers if one.moves is None else one.moves
    words += [f"moves = {str(moves).lower()}", 'stop = "hold"' if steers else 'stop = "ramp"']
    remarks = [] if one.unit else [f"its unit {UNKNOWN}"]
    remarks += [] if one.moves is not None else [f"moves: {UNKNOWN}, the log never changes it alone"]
    remarks += ["it jumps, so that it has no slew limit"] if most is None else []
    return [f"{key(one.name)} = {{ {', '.join(words)} }}" + (f" # {'; '.join(remarks)}" if remarks else "")]


def _outwards(value: float) -> float:
    """Round to three digits away from zero; values below 1e-9 become 0."""
    if abs(value) < 1e-9:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    return math.copysign(math.ceil(round(abs(value) / unit, 6)) * unit, value)


def key(name: str) -> str:
    """Return a name as a TOML key."""
    return name if BARE.fullmatch(name) else json.dumps(name)
