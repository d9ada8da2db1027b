"""``robocal hand-eye``: where a sensor sits on the robot; from tables."""

from robocal_ros.cli.actions import Actions

NAME = "hand-eye"
HELP = "place a sensor on the robot's flange, or beside the robot"

_actions = Actions(
    {
        "sphere": "hand_eye_sphere",
        "step": "hand_eye_step",
        "line": "hand_eye_line",
        "tracker": "hand_eye_tracker",
        "camera": "hand_eye_camera",
        "joint": "hand_eye_joint",
        "check-plan": "hand_eye_check_plan",
        "verify": "hand_eye_verify",
        "export": "hand_eye_export",
    }
)
add_arguments, run = _actions.add_arguments, _actions.run
