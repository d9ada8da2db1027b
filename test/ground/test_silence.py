"""How long something was not heard."""

from robocal_ros.ground.samples import Silence


def test_a_clock_that_stands_is_silent():
    silence = Silence()
    silence.heard_if_new(7, 0.0)
    for tick in range(1, 101):
        silence.heard_if_new(7, tick * 0.01)
        silence.look(tick * 0.01)
    assert abs(silence.lasts_s - 1.0) < 1e-9
    silence.heard_if_new(8, 1.0)
    assert silence.look(1.0) == 0.0
