"""``robocal hand-eye``: where a sensor sits on the robot; from tables."""

from robocal_ros.cli.actions import Actions

NAME = "hand-eye"
HELP = "find where a sensor sits on the robot"

_actions = Actions({"tracker": "hand_eye_tracker"})
add_arguments, run = _actions.add_arguments, _actions.run
