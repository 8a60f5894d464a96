"""Tensor files: equal content gives equal bytes, and malformed bytes are refused with a reason."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brakeline.errors import BadTensors
from brakeline.safety.model.tensor_file import content, has_entry, pack, unpack

WORDS = st.dictionaries(st.text(max_size=5), st.one_of(st.text(max_size=5), st.integers(), st.booleans()), max_size=5)
ARRAYS = st.dictionaries(st.text("abcx.", min_size=1, max_size=4), arrays(np.float64, (2, 3)), max_size=3)


@given(ARRAYS, WORDS)
def test_a_packed_file_is_unpacked_unchanged_and_equal_content_gives_equal_bytes(tensors, about):
    payload = pack(tensors, "entry", about)
    loaded, loaded_about = unpack(payload, "entry")
    assert loaded_about == about and loaded.keys() == tensors.keys()
    assert all(loaded[name].tobytes() == tensors[name].tobytes() for name in tensors)
    turned = dict(reversed(list(about.items())))
    assert pack(dict(reversed(list(tensors.items()))), "entry", turned) == payload
    assert content(tensors) == content(loaded)


def test_other_bytes_are_refused_with_a_reason():
    whole = pack({"a": np.arange(6.0)[::2]}, "entry", {"x": 1})
    assert has_entry(whole, "entry") and not has_entry(whole, "another")
    with pytest.raises(BadTensors, match="another"):
        unpack(whole, "another")
    for garbage in (b"", b"garbage", whole[:-1], whole[:20], b"\x02" + b"\0" * 7 + b"[]", b"\xff" * 40):
        assert not has_entry(garbage, "another")
        with pytest.raises(BadTensors):
            unpack(garbage, "entry")
    with pytest.raises(BadTensors, match="no object"):
        unpack(pack({}, "entry", [1]), "entry")
