"""Test that JavaScript decodes every channel of a log as Python does (`test_whole_run.py` for Python's reader)."""

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

JAVASCRIPT = Path(__file__).parent / "javascript"
NODE = shutil.which("node")

needs_node = pytest.mark.skipif(
    NODE is None or not (JAVASCRIPT / "node_modules").is_dir(),
    reason="JavaScript: needs node, and `npm ci` in tests/system/javascript",
)


def total(message: Message) -> float:
    """The sum of all numbers in a message that JavaScript has as numbers: not those of 64 bits, which it has not."""
    figure = 0.0
    for field, value in message.ListFields():
        entry = field.message_type
        if entry is not None and entry.GetOptions().map_entry:
            of = entry.fields_by_name["value"]
            figure += sum(_number(of, one) for one in value.values())
        elif field.is_repeated:
            figure += sum(_number(field, one) for one in value)
        else:
            figure += _number(field, value)
    return figure


def _number(field: Any, value: Any) -> float:
    if field.message_type is not None:
        return total(value)
    wide = (field.TYPE_INT64, field.TYPE_UINT64, field.TYPE_FIXED64, field.TYPE_SFIXED64, field.TYPE_SINT64)
    if isinstance(value, str | bytes) or field.type in wide or not math.isfinite(value):
        return 0.0
    return float(value)


@needs_node
def test_javascript_decodes_every_channel_as_python_does(logged_run: Path) -> None:
    assert NODE is not None
    words = [NODE, JAVASCRIPT / "read.mjs", logged_run / "run.mcap"]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    read = json.loads(done.stdout)
    expected: dict[str, dict[str, Any]] = {}
    with (logged_run / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            topic = expected.setdefault(channel.topic, {"schema": schema.name, "messages": 0, "sum": 0.0})
            topic["messages"] += 1
            topic["sum"] += total(message)
        attachments = [attachment.name for attachment in reader.iter_attachments()]
    assert read["topics"].keys() == expected.keys()
    for name, topic in read["topics"].items():
        assert (topic["schema"], topic["messages"]) == (expected[name]["schema"], expected[name]["messages"]), name
        assert topic["sum"] == pytest.approx(expected[name]["sum"], rel=1e-9), name
    assert read["attachments"] == attachments
    kinds = {topic["schema"] for topic in read["topics"].values()}
    assert {"foxglove.SceneUpdate", "foxglove.FrameTransforms", "foxglove.LaserScan", "foxglove.Log"} < kinds
