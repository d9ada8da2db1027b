"""``robocal thermal``: place a sensor, and identify a robot's thermal drift from tables."""

from robocal_ros.cli.actions import Actions

NAME = "thermal"
HELP = "place the sensor, identify a thermal drift, learn what drift to expect, screen, plan poses"

_actions = Actions(
    {
        "calibrate-sensor": "thermal_sensor",
        "identify": "thermal_identify",
        "learn-prior": "thermal_prior",
        "screen": "thermal_screen",
        "plan-poses": "thermal_plan",
    }
)
add_arguments, run = _actions.add_arguments, _actions.run
