"""A replay in blocks of joint states gives what one message after the other gives."""

from pathlib import Path

import pytest

from robocal_ros.cli.recording import BagOverview
from robocal_ros.cli.replay import ReplayRequest, replay_bag
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot

BAGS = Path(__file__).parents[2] / "bags"


def replayed(bag: Path, robot: str, state: Path, *, blocks: bool):
    """The document, all that the history keeps, and how many messages or blocks were read."""
    taken = []

    def watch(what: str, recording: BagOverview):
        for message in recording.blocks() if blocks else recording.samples():
            taken.append(message)
            yield message

    arm = load_robot(robot)
    request = ReplayRequest(bag, lambda configured: arm, state=state, auto="shift" in bag.name)
    document = replay_bag(request, watch)
    with CalibrationHistory.open(bag.stem, state_dir=state) as history:
        kept = [
            (
                entry,
                history.document(entry.id),
                history.model(entry.id),
                {name: array.tobytes() for name, array in history.inputs(entry.id).items()},
            )
            for entry in history.list(1000)
        ]
    return document, kept, len(taken)


@pytest.mark.parametrize(
    ("name", "robot"),
    [
        ("thermal_shift", "kr150_r3100"),
        ("tool_runs", "ur10"),
        ("hand_eye_sphere", "ur10"),
    ],
)
def test_the_golden_bags(name, robot, tmp_path):
    bag = BAGS / f"{name}.mcap"
    one_by_one, kept, messages = replayed(bag, robot, tmp_path / "a", blocks=False)
    in_blocks, kept_too, blocks = replayed(bag, robot, tmp_path / "b", blocks=True)
    assert in_blocks == one_by_one
    assert kept_too == kept
    assert len(kept) > 0
    assert blocks < messages
