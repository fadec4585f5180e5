"""The texts of goal ids are those that numpy makes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.node import Node

from rsltrace.adapters.rclpy.boundary.installation import octets_text, quick_id_texts

pytestmark = pytest.mark.ros

octets = st.lists(st.integers(0, 255), min_size=16, max_size=16)


@given(octets)
def test_the_text_is_the_one_of_numpy(values: list[int]) -> None:
    array = np.array(values, np.uint8)
    assert octets_text(array.tobytes()) == str(array)
    assert octets_text((array // 30).tobytes()) == str(array // 30)


@given(octets, st.sampled_from((40, 64, 75, 200)), st.sampled_from((5, 16, 1000)))
def test_other_arrays_and_other_options_are_left_to_numpy(
    values: list[int], linewidth: int, threshold: int
) -> None:
    wide = np.array(values, np.uint16)
    arrays = [wide.astype(np.uint8), wide, wide[:3].astype(np.uint8), wide.reshape(4, 4)]
    with np.printoptions(linewidth=linewidth, threshold=threshold):
        expected = [(str(array), repr(array), f"{array}") for array in arrays]
        with quick_id_texts():
            assert [(str(array), repr(array), f"{array}") for array in arrays] == expected
    formatted = np.array2string(arrays[0], formatter={"int": hex}, separator=", ")
    with quick_id_texts():
        assert np.array2string(arrays[0], formatter={"int": hex}, separator=", ") == formatted


def test_a_run_makes_them_quickly_and_puts_numpys_own_back(simulate: object) -> None:
    arrayprint = pytest.importorskip("numpy._core.arrayprint")
    if not hasattr(arrayprint, "format_options"):
        pytest.skip("numpy 2.0 makes them itself")
    keywords = arrayprint._default_array_str.keywords
    before = keywords["array2string"]
    during = []

    class Looks(Node):
        def __init__(self) -> None:
            super().__init__("looks")
            during.append(keywords["array2string"])

    simulate(Looks, duration=1)  # type: ignore[operator]
    assert during[0] is not before
    assert keywords["array2string"] is before
