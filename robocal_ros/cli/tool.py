"""``robocal tool``: place crossed light beams and measure a tool, from tables."""

from robocal_ros.cli.actions import Actions

NAME = "tool"
HELP = "place crossed light beams, measure a tool with them or by touching a point"

_actions = Actions({"beams": "tool_beams", "crossed": "tool_crossed", "points": "tool_points"})
add_arguments, run = _actions.add_arguments, _actions.run
