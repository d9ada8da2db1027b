# SPDX-License-Identifier: Apache-2.0
"""The commands of ``robocal``, and the file of each: loaded when it is named, none before."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class CliCommand:
    """A command: ``place`` is ``module:name``, where ``add_name`` and ``run_name`` are.

    The first declares options at a parser, the second takes what was given and returns a
    `CliResult`, or raises `RobocalError` for what a user can mend. ``example``: arguments for the
    help, in one line, which can be copied; None: the command's own epilog has some.
    """

    place: str
    help: str
    example: str | None = None


@dataclass(frozen=True)
class CliGroup:
    """A command that has actions of its own, such as ``robocal tool beams``."""

    help: str
    actions: Mapping[str, CliCommand]


COMMANDS: Mapping[str, CliCommand | CliGroup] = {
    "fk": CliCommand(
        "cli.robot:fk",
        "pose of the flange, and of the tool, at given joint values",
        "--robot ur10 --joints-deg 90,0,0,0,0,0",
    ),
    "info": CliCommand(
        "cli.info:info",
        "what a bag, table or file holds, and what can be done with it",
        "docs/examples/measured.csv",
    ),
    "data": CliCommand(
        "cli.data:data",
        "measurements that others published: how to get them, and to tables",
        "ur10_tmac --out out/ur10 --part B",
    ),
    "identify": CliCommand(
        "cli.identify:identify",
        "identify a robot's model from a table of measurements, and judge it on unseen ones",
        "--robot ur10 --data docs/examples/measured.csv --hold-out 0.5 --output "
        "out/calibrated.yaml",
    ),
    "replay": CliCommand(
        "cli.replay:replay",
        "run a recorded bag (MCAP) through the sessions of the live nodes",
        "bags/demo_shift.mcap --robot kr150_r3100 --auto",
    ),
    "validate": CliCommand(
        "cli.validate:validate",
        "replay any number of bags, in parallel, and write one report: is it good, in mm?",
        "bags/demo_shift.mcap --robot kr150_r3100 --report out/validation",
    ),
    "history": CliCommand(
        "cli.history:history",
        "list the calibrations of a robot; accept, reject or roll back",
        "rollback --to previous --kind thermal --by Ada --reason 'worse'",
    ),
    "thermal": CliGroup(
        "place the sensor, identify a thermal drift, learn what drift to expect, screen, plan"
        " poses",
        {
            "calibrate-sensor": CliCommand(
                "thermal.cli:calibrate_sensor",
                "place a fixed sensor and the sphere on the flange from one cold visit of "
                "five poses or more",
                "--robot kr150_r3100 --data sensor.csv --output sensor.yaml",
            ),
            "identify": CliCommand(
                "thermal.cli:identify",
                "identify a thermal drift, or the geometry of a measuring robot, and judge it",
                "--robot kr150_r3100 --sensor sensor.yaml --cold cold.csv --warm warm.csv --check "
                "check.csv",
            ),
            "learn-prior": CliCommand(
                "thermal.cli:learn_prior",
                "learn what drift to expect of a robot from tables of its measuring cycles",
                "--robot kr150_r3100 --sensor sensor.yaml --cold cold.csv --warm history.csv "
                "--output prior.yaml",
            ),
            "screen": CliCommand(
                "thermal.cli:screen",
                "find which parameters a drift needs, by what is left at check poses",
                "--robot kr150_r3100 --sensor sensor.yaml --cold cold.csv --warm shift.csv "
                "--check check.csv",
            ),
            "plan-poses": CliCommand(
                "thermal.cli:plan_poses",
                "choose the poses of a measuring cycle that say most about the tool, and how "
                "much better",
                "--robot kr150_r3100 --sensor sensor.yaml --own warm.csv --output poses.csv",
            ),
        },
    ),
    "correct-points": CliCommand(
        "thermal.cli:correct_points",
        "carry what a sensor on the flange measured to base, with the model of the robot as it is",
        "--robot kr150_r3100 --model full.yaml --mount mount.json --data measured.csv --output "
        "part.csv",
    ),
    "tool": CliGroup(
        "place light beams, measure a tool with them or by touching a point, hand it to a "
        "controller",
        {
            "beams": CliCommand(
                "tool.cli:beams",
                "place two crossed light beams from the edges A1 to D4 of a cylinder at the flange",
                "--data beams.csv --radius-mm 2.5 --robot ur10 --station cell_1 --output "
                "laser.yaml",
            ),
            "station": CliCommand(
                "tool.cli:station",
                "how a beam station has moved since it was first measured with the mandrel; its "
                "new laser file",
                "--robot ur10 --robot-serial K7 --output laser.yaml",
            ),
            "crossed": CliCommand(
                "tool.cli:crossed",
                "find a tool from the edges of a whole run, or its axis from one circle at "
                "constant speed",
                "--events events.csv --joints joints.csv --robot ur10 --laser laser.yaml",
            ),
            "points": CliCommand(
                "tool.cli:points",
                "find a tool's tip from four touches of one point or more; its orientation "
                "from seven poses",
                "--method four --data touches.csv",
            ),
            "parallel": CliCommand(
                "tool.cli:parallel",
                "find a tool's axis, and its tip, by sweeps through two parallel beams along "
                "the base's y",
                "--data sweeps.csv --up-mm 400 --down-mm 360 --x-mm 800",
            ),
            "export": CliCommand(
                "tool.cli:export",
                "print a tool's frame for a controller, or for URDF",
                "--tool tool.json --format kuka",
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
                "--poses poses.csv --profiles profiles --radius-mm 20 --z-grows towards",
            ),
            "step": CliCommand(
                "hand_eye.cli:step",
                "place a line laser on the flange from profiles of stairs at a taught place",
                "--poses poses.csv --profiles profiles --target stairs.yaml --z-grows towards",
            ),
            "line": CliCommand(
                "hand_eye.cli:line",
                "place a line laser on the flange from profiles across a straight edge or groove",
                "--poses poses.csv --profiles profiles --z-grows towards",
            ),
            "tracker": CliCommand(
                "hand_eye.cli_sensors:tracker",
                "place a profile sensor by a laser tracker that sees the flange, and a cube "
                "with a sphere",
                "--robot p1r2p3 --poses poses.csv --profiles profiles --points tracker.csv "
                "--target target.yaml",
            ),
            "camera": CliCommand(
                "hand_eye.cli_sensors:camera",
                "place a camera from images of a chessboard, or from poses of a board or a "
                "tracked target",
                "--poses poses.csv --images shots --board 9x6 --square-mm 25",
            ),
            "joint": CliCommand(
                "hand_eye.cli:joint",
                "place a line laser on the flange from the shots of two or three targets together",
                "--sphere sphere --line line --z-grows towards",
            ),
            "check-plan": CliCommand(
                "hand_eye.cli_sensors:check_plan",
                "tell before the robot moves what planned poses would give, and which others "
                "would do",
                "--target-kind sphere --radius-mm 20 --center-mm 837,-59,45 --poses planned.csv "
                "--mount mount.json --near-mm 10 --far-mm -10",
            ),
            "verify": CliCommand(
                "hand_eye.cli:verify",
                "judge a line laser's place by shots that did not give it, of the same target"
                " or another",
                "--result mount.json --target-kind line --poses poses.csv --profiles profiles "
                "--z-grows towards",
            ),
            "export": CliCommand(
                "hand_eye.cli_sensors:export",
                "print a sensor's place for URDF, xacro or tf2",
                "--result mount.json --format urdf --parent tool0 --child laser",
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
        "--robot kr150_r3100 --fixture plate.yaml --points now.csv --taught taught.csv --maker "
        "kuka --name BASE_DATA[3]",
    ),
    "iso9283": CliCommand(
        "cli.identify:iso9283",
        "position accuracy and repeatability (AP, RP) of single poses as ISO 9283, 7.2, "
        "defines them; no whole test",
        "--data docs/examples/positions.csv --commanded P1=1200,0,900 --commanded P2=1400,-350,650",
    ),
    "joint-functions": CliCommand(
        "cli.robot:joint_functions",
        "what each joint of a robot file turns besides what is read, as a table",
        "--robot full.yaml --output functions.csv",
    ),
    "import-ur": CliCommand(
        "cli.robot:import_ur",
        "turn the factory calibration of a Universal Robots arm into a robot file",
        "--calibration calibration.conf --nominal urcontrol.conf --output my_ur.yaml",
    ),
    "import-urdf": CliCommand(
        "cli.robot:import_urdf",
        "turn a URDF, or a kinematics.yaml of Universal Robots' description, into a robot file",
        "my_arm.urdf --output my_arm.yaml",
    ),
    "export-urdf": CliCommand(
        "cli.robot:export_urdf",
        "put a robot file's kinematics, as identified, into a URDF or such a kinematics.yaml",
        "--robot full.yaml --into my_arm.urdf --output calibrated.urdf",
    ),
    "plc": CliGroup(
        "who may talk to plc_bridge_node",
        {
            "certificates": CliCommand(
                "plc.cli:certificates",
                "make the folder that plc_bridge_node reads, with its certificate, or one for a "
                "client",
                "/etc/robocal/plc --host 192.168.0.20",
            ),
            "user": CliCommand(
                "plc.cli:user",
                "add a user, give another password or role, or take a user out",
                "/etc/robocal/plc line_1 --role operator",
            ),
        },
    ),
    "warm": CliCommand(
        "cli.warm:warm",
        "compile the kernels, which the first start of a node would wait for",
        "",
    ),
}
"""Each command, in the order of the help."""
