# SPDX-License-Identifier: Apache-2.0
"""What OPC UA shows of a message: as a PLC can take it."""

import pytest

from robocal_ros.plc.model import LONGEST_SHOWN, Item

REASON = Item("Reason", "String", lambda message: message, "In words")
LEFT = Item("Left", "String[]", lambda message: message, "What is left")


@pytest.mark.parametrize("sign", ["a", "\u00e4", "\u6d4b"])
def test_a_text_fits_a_string_of_a_plc_whatever_its_signs(sign):
    text = "x" + sign * 300
    shown = REASON.value(text)
    assert LONGEST_SHOWN - 3 <= len(shown.encode()) <= LONGEST_SHOWN == 254
    assert shown.endswith("...")
    assert text.startswith(shown[:-3])
    assert LEFT.value([text, "short"]) == [shown, "short"]


def test_a_text_that_fits_is_shown_whole():
    assert REASON.value("a" * LONGEST_SHOWN) == "a" * LONGEST_SHOWN
    assert REASON.value("\u00e4" * 127) == "\u00e4" * 127
