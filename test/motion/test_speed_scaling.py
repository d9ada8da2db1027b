"""How fast a controller's clock runs, by who told it last."""

import math

import pytest

from robocal_ros.motion.robot_watch import TOLD_S, SpeedScaling


def test_what_is_not_told_again_is_forgotten() -> None:
    """Finding: a broadcaster that died at 0 % was believed for ever."""
    scaling = SpeedScaling()
    assert scaling.at(0.0) is None
    scaling.slider(100.0, 10.0)
    scaling.slider(0.0, 10.1)
    assert scaling.at(10.1 + TOLD_S) == 0.0
    assert scaling.at(10.11 + TOLD_S) is None
    scaling.slider(0.0, 20.0)  # it has told another number before
    assert scaling.at(20.0) == 0.0


def test_the_controller_knows_better_than_the_slider_while_it_tells() -> None:
    """Finding: the one that said less won, though the controller ran at full speed."""
    scaling = SpeedScaling()
    scaling.slider(30.0, 10.0)
    assert scaling.at(10.0) == pytest.approx(0.3)
    scaling.controller(1.0, 10.1)
    assert scaling.at(10.2) == 1.0
    scaling.slider(30.0, 11.5)
    assert scaling.at(11.5) == pytest.approx(0.3)  # the controller is silent


def test_a_scaling_that_is_never_filled_tells_nothing() -> None:
    """Finding: a controller without it, which leaves it at 0, was paused for ever."""
    scaling = SpeedScaling()
    scaling.controller(0.0, 10.0)
    assert scaling.at(10.0) is None
    scaling.slider(50.0, 10.1)
    scaling.controller(0.0, 10.2)
    assert scaling.at(10.2) == 0.5
    scaling.controller(0.2, 10.3)
    scaling.controller(0.0, 10.4)
    assert scaling.at(10.4) == 0.0


@pytest.mark.parametrize("strange", [math.nan, math.inf, -math.inf, -0.1])
def test_what_is_no_scaling_tells_nothing(strange: float) -> None:
    scaling = SpeedScaling()
    scaling.controller(0.7, 10.0)
    scaling.controller(strange, 10.1)
    assert scaling.at(10.1) == 0.7
    scaling.controller(5.0, 10.2)
    assert scaling.at(10.2) == 1.0
