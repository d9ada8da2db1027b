"""Names of rejected samples: corners one by one, or a whole shot."""

from robocal_ros.hand_eye.result import by_shot


def test_a_single_corner_keeps_its_name():
    samples = ("a/corner 1", "a/corner 3")
    rejected = {"a/corner 2": "does not fit the others"}
    assert by_shot(rejected, samples) == rejected


def test_a_shot_without_a_corner_left_is_named_once_with_the_commonest_reason():
    swapped = "fits the pose of {}/corner 2, not its own: swapped?"
    rejected = {
        "step/b/corner 1": "does not fit the others",
        "step/b/corner 2": swapped.format("step/c"),
        "step/b/corner 10": swapped.format("step/c"),
        "empty": "profile empty has 0 points",
    }
    found = by_shot(rejected, ("step/a/corner 1",))
    assert found == {
        "step/b": "fits the pose of step/c, not its own: swapped?",
        "empty": "profile empty has 0 points",
    }


def test_folders_in_names_are_no_shots():
    rejected = {"sphere/s1": "too short", "day 1/p2": "dark"}
    assert by_shot(rejected, ()) == rejected
