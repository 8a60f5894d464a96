"""Fill in the commented template of a robot description from the schema of a log."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from brakeline.deploy.data.schema_inference import InferredColumn, InferredSchema, brake_periods

BARE = re.compile(r"[A-Za-z0-9_-]+")
ERRORS = {"position": 0.01, "heading": 0.02}  # measurement errors of the template
ERROR = 0.05
MOST_PERIODS = 64  # longest plan
LATE = 1.5  # periods: a longer delay is not that of a lag alone, which the measured speeds show
UNKNOWN = "cannot be inferred from the log"


def fill_template(template: str, schema: InferredSchema, source: str) -> str:
    """Return the template with the values that the log shows; comments mark values that it does not show."""
    brake, late = brake_periods(schema.period, schema.states, schema.inputs)
    horizon, brake = min(1 + brake + late + 1, MOST_PERIODS), min(brake, MOST_PERIODS - 2)
    states = [f"# error: {UNKNOWN}.", *(_state(one, schema.period) for one in schema.states)]
    inputs = ["# low, high, slew: the ranges in the log, rounded outwards. The robot may allow more."]
    inputs += [*map(_input, schema.inputs)] if schema.inputs else [f"# Inputs {UNKNOWN}: these come from the template."]
    zeros = ", ".join("0.0" for column in schema.states if column.role == "position")
    period = f"period = {schema.period:g} # s between decisions; {schema.why}"
    plan = (
        (r"^horizon = .*", f"horizon = {horizon} # with the delays in the log, without lags; check it"),
        (r"^brake = .*", f"brake = {brake} # from the strongest braking and the fastest inputs in the log; check it"),
    )
    replacements = (
        (r"^period = .*", period),
        (r"^sight = .*", rf"\g<0>; {UNKNOWN}"),
        (r"^\[state\]\n(.+\n)+", _verbatim("[state]", *states)),
        (r"^\[input\]\n" + ("(.+\n)+" if schema.inputs else ""), _verbatim("[input]", *inputs)),
        *(plan if schema.inputs else ()),  # without inputs, the plan of the template fits the inputs of the template
        (r"^\[\[body\]\]", rf"# The body {UNKNOWN}: measure it.\n\g<0>"),
        (r"^at = \[0.0, 0.0\]", f"at = [{zeros}]"),
    )
    for pattern, text in replacements:
        template = re.sub(pattern, text, template, flags=re.MULTILINE)
    about = [f"# Inferred from {source}. Check every line: the log shows what the robot did, not what it can do."]
    return "\n".join((*about, *(f"# {note}" for note in schema.notes), template))


def delay_notes(schema: InferredSchema) -> tuple[str, ...]:
    """Return a note if a coordinate responds so late that the predictions, which use one earlier input, miss inputs."""
    late = [(one.delay, one.name) for one in schema.states if one.delay is not None]
    delay, name = max(late, default=(0.0, ""))
    if delay <= LATE * schema.period:
        return ()
    longer = math.ceil(round(delay / schema.period, 3)) * schema.period
    return (
        f"{name} responds about {1e3 * delay:.0f} ms after its input, but predictions use one earlier input only, so "
        f"with `period = {schema.period:g}` the sets will be wide. If you can, let your controller hold each input for "
        f"{longer:.3g} s, and record again. The file then has `period = {longer:.3g}`",
    )


def _verbatim(*lines: str) -> str:
    """Return lines as a replacement for `re.sub`, which must not read the escapes in quoted names."""
    return "".join(f"{line}\n" for line in lines).replace("\\", r"\\")


def _state(one: InferredColumn, period: float) -> str:
    values: dict[str, Any] = {"unit": one.unit or "1"}
    values |= {"role": one.role} if one.role != "other" else {}
    values |= {"error": ERRORS.get(one.role, ERROR)} | ({"follows": one.follows} if one.follows else {})
    remarks = [f"{one.least:.3g} to {one.most:.3g} in the log"] if one.role != "heading" else []
    remarks += [] if one.unit else [f"its unit {UNKNOWN}"]
    if one.delay is not None:
        remarks.append(f"{1e3 * one.delay:.0f} ms after its input: {one.delay / period:.1f} periods")
    remarks += [f"brakes by {one.change:.2g} a period"] if one.follows and one.change else []
    return _line(one.name, values, remarks)


def _input(one: InferredColumn) -> str:
    most = None if one.jumps else _outwards(one.change)
    values: dict[str, Any] = {"unit": one.unit or "1"}
    values |= {"low": min(_outwards(one.least), 0.0), "high": max(_outwards(one.most), 0.0)}
    values |= {} if most is None else {"slew": most}
    values |= {"moves": not one.steers if one.moves is None else one.moves, "stop": "hold" if one.steers else "ramp"}
    remarks = [] if one.unit else [f'its unit {UNKNOWN}; a steering angle has unit = "rad" and stop = "hold"']
    remarks += [] if one.moves is not None else [f"moves: {UNKNOWN}, the log never changes it alone"]
    remarks += ["it jumps, so that it has no slew limit"] if most is None else []
    return _line(one.name, values, remarks)


def _line(name: str, values: dict[str, Any], remarks: list[str]) -> str:
    return f"{toml_key(name)} = {toml_value(values)}" + (f" # {'; '.join(remarks)}" if remarks else "")


def _outwards(value: float) -> float:
    """Round to three digits away from zero; values below 1e-9 become 0."""
    if abs(value) < 1e-9:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    return float(f"{math.copysign(math.ceil(round(abs(value) / unit, 6)) * unit, value):g}")


def toml_key(name: str) -> str:
    """Return a name as a TOML key."""
    return name if BARE.fullmatch(name) else json.dumps(name)


def toml_value(value: Any) -> str:
    """Return a JSON value as an inline TOML value."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(name)} = {toml_value(one)}" for name, one in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return json.dumps(value)
