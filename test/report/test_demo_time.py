# SPDX-License-Identifier: Apache-2.0
"""The bench judges how long the demo takes, which the demo only tells."""

import pytest

from bench.__main__ import PARTS
from bench.demo import GOAL_S, demo_table


@pytest.mark.parametrize(("over_s", "met"), [(-0.1, True), (0.1, False)])
def test_a_demo_that_takes_longer_misses_its_goal(over_s, met):
    assert demo_table(GOAL_S + over_s).met is met


def test_it_is_a_part_of_the_bench():
    assert PARTS["demo"] == "demo"
