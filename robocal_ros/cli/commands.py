# SPDX-License-Identifier: Apache-2.0
"""The commands of ``robocal``, and the file of each: loaded when it is named, none before."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class CliCommand:
    """A command: ``place`` is ``module:name``, where ``add_name`` and ``run_name`` are.

    The first declares options at a parser, the second takes what was given and returns a
    `CliResult`, or raises `RobocalError` for what a user can mend.
    """

    place: str
    help: str


@dataclass(frozen=True)
class CliGroup:
    """A command that has actions of its own, such as ``robocal tool beams``."""

    help: str
    actions: Mapping[str, CliCommand]


COMMANDS: Mapping[str, CliCommand | CliGroup] = {
    "fk": CliCommand("cli.robot:fk", "pose of the flange, and of the tool, at given joint values"),
    "info": CliCommand(
        "cli.info:info", "what a bag, table or file holds, and what can be done with it"
    ),
    "data": CliCommand(
        "cli.data:data", "measurements that others published: how to get them, and to tables"
    ),
    "identify": CliCommand(
        "cli.identify:identify",
        "identify a robot's model from a table of measurements, and judge it on unseen ones",
    ),
    "replay": CliCommand(
        "cli.replay:replay", "run a recorded bag (MCAP) through the sessions of the live nodes"
    ),
    "validate": CliCommand(
        "cli.validate:validate",
        "replay any number of bags, in parallel, and write one report: is it good, in mm?",
    ),
    "history": CliCommand(
        "cli.history:history", "list the calibrations of a robot; accept, reject or roll back"
    ),
    "thermal": CliGroup(
        "place the sensor, identify a thermal drift, learn what drift to expect, screen, plan"
        " poses",
        {
            "calibrate-sensor": CliCommand(
                "thermal.cli:calibrate_sensor",
                "place a fixed sensor and the sphere on the flange from one cold visit of "
                "five poses or more",
            ),
            "identify": CliCommand(
                "thermal.cli:identify",
                "identify a thermal drift, or the geometry of a measuring robot, and judge it",
            ),
            "learn-prior": CliCommand(
                "thermal.cli:learn_prior",
                "learn what drift to expect of a robot from tables of its measuring cycles",
            ),
            "screen": CliCommand(
                "thermal.cli:screen",
                "find which parameters a drift needs, by what is left at check poses",
            ),
            "plan-poses": CliCommand(
                "thermal.cli:plan_poses",
                "choose the poses of a measuring cycle that say most about the tool, and how "
                "much better",
            ),
        },
    ),
    "correct-points": CliCommand(
        "thermal.cli:correct_points",
        "carry what a sensor on the flange measured to base, with the model of the robot as it is",
    ),
    "tool": CliGroup(
        "place light beams, measure a tool with them or by touching a point, hand it to a "
        "controller",
        {
            "beams": CliCommand(
                "tool.cli:beams",
                "place two crossed light beams from the edges A1 to D4 of a cylinder at the flange",
            ),
            "station": CliCommand(
                "tool.cli:station",
                "how a beam station has moved since it was first measured with the mandrel; its "
                "new laser file",
            ),
            "crossed": CliCommand(
                "tool.cli:crossed",
                "find a tool from the edges of a whole run, or its axis from one circle at "
                "constant speed",
            ),
            "points": CliCommand(
                "tool.cli:points",
                "find a tool's tip from four touches of one point or more; its orientation "
                "from seven poses",
            ),
            "parallel": CliCommand(
                "tool.cli:parallel",
                "find a tool's axis, and its tip, by sweeps through two parallel beams along "
                "the base's y",
            ),
            "export": CliCommand(
                "tool.cli:export", "print a tool's frame for a controller, or for URDF"
            ),
        },
    ),
    "hand-eye": CliGroup(
        "place a sensor on the robot's flange, or beside the robot",
        {
            "sphere": CliCommand(
                "hand_eye.cli:sphere",
                "place a line laser on the flange from profiles across a sphere that stands "
                "anywhere",
            ),
            "step": CliCommand(
                "hand_eye.cli:step",
                "place a line laser on the flange from profiles of stairs at a taught place",
            ),
            "line": CliCommand(
                "hand_eye.cli:line",
                "place a line laser on the flange from profiles across a straight edge or groove",
            ),
            "tracker": CliCommand(
                "hand_eye.cli_sensors:tracker",
                "place a profile sensor by a laser tracker that sees the flange, and a cube "
                "with a sphere",
            ),
            "camera": CliCommand(
                "hand_eye.cli_sensors:camera",
                "place a camera from images of a chessboard, or from poses of a board or a "
                "tracked target",
            ),
            "joint": CliCommand(
                "hand_eye.cli:joint",
                "place a line laser on the flange from the shots of two or three targets together",
            ),
            "check-plan": CliCommand(
                "hand_eye.cli_sensors:check_plan",
                "tell before the robot moves what planned poses would give, and which others "
                "would do",
            ),
            "verify": CliCommand(
                "hand_eye.cli:verify",
                "judge a line laser's place by shots that did not give it, of the same target"
                " or another",
            ),
            "export": CliCommand(
                "hand_eye.cli_sensors:export", "print a sensor's place for URDF, xacro or tf2"
            ),
        },
    ),
    "correct-program": CliCommand(
        "cli.programs:correct_program",
        "correct the points of a program (KRL, RAPID, .ls, URScript, AS) for the robot as it is",
    ),
    "frame-shift": CliCommand(
        "cli.programs:frame_shift",
        "the shift of a controller's base and tool frame that serves the working poses best",
    ),
    "fixture": CliCommand(
        "fixture.cli:fixture",
        "where a fixture stands by its planes, edges, holes and spheres, and what has moved",
    ),
    "iso9283": CliCommand(
        "cli.identify:iso9283",
        "position accuracy and repeatability (AP, RP) of single poses as ISO 9283, 7.2, "
        "defines them; no whole test",
    ),
    "joint-functions": CliCommand(
        "cli.robot:joint_functions",
        "what each joint of a robot file turns besides what is read, as a table",
    ),
    "import-ur": CliCommand(
        "cli.robot:import_ur",
        "turn the factory calibration of a Universal Robots arm into a robot file",
    ),
    "import-urdf": CliCommand(
        "cli.robot:import_urdf",
        "turn a URDF, or a kinematics.yaml of Universal Robots' description, into a robot file",
    ),
    "export-urdf": CliCommand(
        "cli.robot:export_urdf",
        "put a robot file's kinematics, as identified, into a URDF or such a kinematics.yaml",
    ),
    "plc": CliGroup(
        "who may talk to plc_bridge_node",
        {
            "certificates": CliCommand(
                "plc.cli:certificates",
                "make the folder that plc_bridge_node reads, with its certificate, or one for a "
                "client",
            ),
            "user": CliCommand(
                "plc.cli:user", "add a user, give another password or role, or take a user out"
            ),
        },
    ),
    "warm": CliCommand(
        "cli.warm:warm", "compile the kernels, which the first start of a node would wait for"
    ),
}
"""Each command, in the order of the help."""
