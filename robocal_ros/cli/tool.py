"""``robocal tool``: place light beams, measure a tool, hand it to a controller; from tables."""

from robocal_ros.cli.actions import Actions

NAME = "tool"
HELP = "place light beams, measure a tool with them or by touching a point, hand it to a controller"

_actions = Actions(
    {
        "beams": "tool_beams",
        "crossed": "tool_crossed",
        "points": "tool_points",
        "parallel": "tool_parallel",
        "export": "tool_export",
    }
)
add_arguments, run = _actions.add_arguments, _actions.run
