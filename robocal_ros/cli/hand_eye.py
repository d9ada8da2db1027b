"""``robocal hand-eye``: where a sensor sits on the robot; from tables."""

from robocal_ros.cli.actions import Actions

NAME = "hand-eye"
HELP = "place a sensor on the robot's flange, or beside the robot"

_actions = Actions({"camera": "hand_eye_camera", "tracker": "hand_eye_tracker"})
add_arguments, run = _actions.add_arguments, _actions.run
