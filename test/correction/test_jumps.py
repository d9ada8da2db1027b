# SPDX-License-Identifier: Apache-2.0
"""A jump that comes now and then is seen: what found it is not run again until it passes."""

import re
from pathlib import Path

import numpy as np
import pytest
from jumps import JumpError, no_jump

MAKEFILE = Path(__file__).parents[2] / "Makefile"


def test_no_rerun_of_the_suite_hides_a_jump() -> None:
    with pytest.raises(JumpError, match="1 times of 2") as found:
        no_jump(np.array([True, False]), "a step")
    no_jump(np.array([True, True]), "a step")
    text = MAKEFILE.read_text()
    (excepted,) = re.findall(r"^AGAIN := --rerun-except '([^']*)'", text, flags=re.MULTILINE)
    assert re.search(excepted, f"{type(found.value).__name__}: {found.value}")  # as pytest does
    assert not re.search(excepted, "Failed: not within 20.0 s: the stream runs")
    reruns = [line for line in text.splitlines() if "--reruns" in line]
    assert reruns
    assert all("$(AGAIN)" in line for line in reruns)
