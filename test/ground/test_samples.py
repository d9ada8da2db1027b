"""Samples from messages."""

from types import SimpleNamespace

import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import CORRECTED, TAUGHT, joint_sample


def reading(frame: str) -> SimpleNamespace:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id=frame)
    return SimpleNamespace(header=header, name=["a"], position=[0.5])


@pytest.mark.parametrize("mark", [CORRECTED, TAUGHT])
def test_joint_states_of_a_correction_are_refused(mark):
    """Else the model would be identified against itself and ratchet."""
    with pytest.raises(InputError, match="subscribe to the robot's own"):
        joint_sample(reading(mark))
    assert joint_sample(reading("")).position.tolist() == [0.5]
