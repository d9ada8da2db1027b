# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import pytest
from correction_robot import Robot, drifted, offer

sys.path.insert(0, str(Path(__file__).parent))  # some tests share helpers of another


@pytest.fixture
def robot() -> Robot:
    """Not enabled, and nothing known yet."""
    return Robot()


@pytest.fixture
def warm() -> Robot:
    """Enabled, with a drifted model, settled."""
    robot = Robot()
    robot.session.offer_model(offer(drifted()))
    robot.session.enable(True)
    robot.settle()
    return robot
