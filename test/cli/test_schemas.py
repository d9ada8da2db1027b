# SPDX-License-Identifier: Apache-2.0
"""Every command, as a process of its own: its document follows its schema, well or ill."""

import json
from pathlib import Path

import pytest
from camera_tables import camera_tables
from campaign import ROBOT, measured, table
from command import ROOT, SCHEMAS, conforms, robocal, robocal_json
from drift_tables import fixed_tables
from fixture_driver import fixture_bag
from fixture_tables import fixture_tables
from hand_eye_bag import hand_eye_bag
from hand_eye_tables import TRUE, hand_eye_tables
from joint_errors import with_joint_errors
from recordings import plain_bag, recorded_bag, shift
from tool_runs import run_tables
from tool_tables import tool_tables
from tracker_files import SCAN, tracker_files

from bench.laser_tracker import prp_cell
from bench.live.opc_ua import security_folder
from bench.robot_programs import KUKA_FRAMES, krl, postures
from robocal_ros.cli.commands import COMMANDS
from robocal_ros.ground.frames import transform_document
from robocal_ros.kinematics.robots import load_description, load_robot, save_robot
from robocal_ros.kinematics.tables import joint_texts, write_cells
from robocal_ros.kinematics.urdf import urdf_of

UR_NOMINAL = """[DH]
a = [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
d = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
alpha = [1.570796327, 0, 0, 1.570796327, -1.570796327, 0]
q_home_offset = [0, -1.570796327, 0, -1.570796327, 0, 0]
joint_direction = [1, 1, -1, 1, 1, 1]
"""
UR_DELTAS = """[mounting]
delta_theta = [ 0.0, -0.0005, 0.0007, 0.0002, 0, 0]
delta_a = [ 0.0001, 0.0003, -0.0001, 0.0002, 0, 0]
delta_d = [ 0.0002, 0.0, 0.0, 0.0004, -0.0001, 0]
delta_alpha = [ 0.0003, 0.0005, 0.0008, 0.0002, 0.0018, 0]
"""
TOOL_BAG = str(ROOT / "bags" / "tool_runs.mcap")
PLACE = ["thermal", "calibrate-sensor", "--robot", ROBOT]
DRIFT = ["thermal", "identify", "--robot", ROBOT, "--sensor", "s.yaml", "--cold", "cold.csv"]
SCREEN = ["thermal", "screen", *DRIFT[2:]]
PLAN = ["thermal", "plan-poses", "--robot", ROBOT, "--sensor", "s.yaml"]
PRIOR = ["thermal", "learn-prior", *DRIFT[2:]]
CROSSED = ["tool", "crossed", "--radius-mm", "12", "--period-s", "2", "--start-deg", "45"]
RUN = ["tool", "crossed", "--robot", "ur10", "--laser", "laser.yaml", "--taught-mm", "0,0,150",
       "--sample-period-s", "0.002", "--joints", "joints.csv"]  # fmt: skip
PARALLEL = ["tool", "parallel", "--up-mm", "400", "--down-mm", "360", "--x-mm", "800"]
HEIGHTS = ["--z-grows", "towards"]
SPHERE = [
    "--radius-mm",
    "20",
    *HEIGHTS,
    "--poses",
    "sphere/poses.csv",
    "--profiles",
    "sphere/profiles",
]
FEW_SPHERE = [*SPHERE[:4], "--poses", "sphere/few.csv", *SPHERE[6:]]
STEP = ["--target", "step/target.yaml", "--poses", "step/poses.csv",
        "--profiles", "step/profiles", *HEIGHTS]  # fmt: skip
LINE = ["--poses", "line/poses.csv", "--profiles", "line/profiles", *HEIGHTS]
PLANNED = ["hand-eye", "check-plan", "--target-kind", "sphere", "--radius-mm", "20",
           "--near-mm", "10", "--far-mm", "-10"]  # fmt: skip
CAMERA = ["hand-eye", "camera", "--measured", "board_poses.csv"]
TRACKER = ["hand-eye", "tracker", "--robot", "p1r2p3", "--poses", "scan_poses.csv",
           "--profiles", SCAN, "--points", "tracker.csv"]  # fmt: skip
CORRECT = ["correct-program", "--robot", ROBOT, "--model", "full.yaml"]
POINTS = ["correct-points", "--robot", ROBOT, "--model", "full.yaml", "--data", "data.csv"]
FIXTURE = ["fixture", "--robot", ROBOT, "--fixture", "plate.yaml"]
SHIFT = ["frame-shift", "--robot", ROBOT, "--model", "full.yaml"]
# Schema, arguments that succeed, arguments that fail, and the failure's exit status and code.
CASES = {
    "fk": (
        "fk.json",
        ["fk", "--robot", ROBOT, "--joints-deg", "0,-90,90,0,0,0"],
        ["fk", "--robot", ROBOT, "--joints-deg", "0,-90"],
        (2, "BAD_INPUT"),
    ),
    "info": (
        "info.json",
        ["info", "hand_eye.mcap"],
        ["info", "nowhere.csv"],
        (2, "BAD_INPUT"),
    ),
    "identify": (
        "identify.json",
        ["identify", "--robot", ROBOT, "--data", "data.csv"],
        ["identify", "--robot", ROBOT, "--data", "few.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "identify refuses": (
        "identify.json",
        ["identify", "--robot", ROBOT, "--data", "data.csv", "--fit", "base,tool"],
        ["identify", "--robot", "p1r2p3", "--data", "data.csv"],
        (2, "BAD_INPUT"),
    ),
    "replay": (
        "replay.json",
        ["replay", "plain.mcap", "--robot", ROBOT, "--auto"],
        ["replay", "plain.mcap", "--robot", ROBOT, "--warm", "500:501"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "replay recorded": (
        "replay.json",
        ["replay", "live.mcap"],
        ["replay", "live.mcap", "--robot", "ur10"],
        (2, "WRONG_ROBOT"),
    ),
    "replay tool": (
        "replay.tool.json",
        ["replay", TOOL_BAG],
        ["replay", TOOL_BAG, "--robot", "kr150_r3100"],
        (2, "WRONG_ROBOT"),
    ),
    "replay hand-eye": (
        "replay.hand_eye.json",
        ["replay", "hand_eye.mcap"],
        ["replay", "hand_eye.mcap", "--robot", "kr150_r3100"],
        (2, "WRONG_ROBOT"),
    ),
    "replay fixture": (
        "replay.fixture.json",
        ["replay", "fixture.mcap"],
        ["replay", "fixture.mcap", "--robot", "ur10"],
        (2, "WRONG_ROBOT"),
    ),
    "validate": (
        "validate.json",
        ["validate", "hand_eye.mcap", "--report", "report"],
        ["validate", "nowhere.mcap", "--report", "report"],
        (3, "BAD_INPUT"),
    ),
    "history list": (
        "history.list.json",
        ["history", "list", "--state", "state"],
        ["history", "list", "--state", "nowhere"],
        (2, "BAD_INPUT"),
    ),
    "history show": (
        "history.show.json",
        ["history", "show", "2", "--state", "state"],
        ["history", "show", "99", "--state", "state"],
        (2, "BAD_INPUT"),
    ),
    "history corrections": (
        "history.corrections.json",
        ["history", "corrections", "--state", "state"],
        ["history", "corrections", "--state", "nowhere"],
        (2, "BAD_INPUT"),
    ),
    "history acknowledge": (
        "history.acknowledge.json",
        ["history", "acknowledge", "--state", "state"],
        ["history", "acknowledge", "--state", "nowhere"],
        (2, "BAD_INPUT"),
    ),
    "history accept": (
        "history.decision.json",
        ["history", "rollback", "--to", "nominal", "--state", "state"],
        ["history", "accept", "2", "--state", "state"],
        (3, "CONFLICT"),
    ),
    "thermal calibrate-sensor": (
        "thermal.sensor.json",
        ["thermal", "calibrate-sensor", "--robot", ROBOT, "--data", "sensor.csv"],
        ["thermal", "calibrate-sensor", "--robot", ROBOT, "--data", "few.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "thermal identify": (
        "thermal.identify.json",
        [*DRIFT, "--warm", "warm.csv"],
        [*DRIFT, "--warm", "nowhere.csv"],
        (2, "BAD_INPUT"),
    ),
    "thermal learn-prior": (
        "thermal.prior.json",
        [*PRIOR, "--warm", "history.csv"],
        [*PRIOR, "--warm", "warm.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "thermal screen": (
        "thermal.screen.json",
        [*SCREEN, "--warm", "shift.csv", "--check", "judges.csv"],
        [*SCREEN, "--warm", "warm.csv", "--check", "check.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "thermal plan-poses": (
        "thermal.plan.json",
        [*PLAN, "--own", "sensor.csv", "--output", "planned.csv"],
        [*PLAN, "--field-mm", "500,400,20000,19900,20100"],
        (3, "LIMIT_EXCEEDED"),
    ),
    "tool beams": (
        "tool.beams.json",
        ["tool", "beams", "--data", "beams.csv"],
        ["tool", "beams", "--data", "some_beams.csv"],
        (2, "BAD_INPUT"),
    ),
    "tool crossed": (
        "tool.crossed.json",
        [*CROSSED, "--events", "edges.csv"],
        [*CROSSED, "--events", "lost_edge.csv"],
        (3, "BEAM_EDGES_WRONG"),
    ),
    "tool crossed, whole run": (
        "tool.crossed.json",
        [*RUN, "--events", "run.csv"],
        [*RUN, "--events", "run.csv", "--taught-rpy-deg", "70,0,0"],
        (3, "RANK_DEFICIENT"),
    ),
    "tool parallel": (
        "tool.parallel.json",
        [*PARALLEL, "--data", "sweeps.csv"],
        [*PARALLEL, "--data", "half_sweeps.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "tool export": (
        "tool.export.json",
        ["tool", "export", "--xyz-mm", "1,2,3", "--format", "urdf"],
        ["tool", "export", "--rpy-deg", "1,2,3", "--format", "urdf"],
        (2, "BAD_INPUT"),
    ),
    "tool points": (
        "tool.points.json",
        ["tool", "points", "--data", "touches.csv", "--figures", "drawn"],
        ["tool", "points", "--data", "few_touches.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "hand-eye sphere": (
        "hand-eye.sphere.json",
        ["hand-eye", "sphere", *SPHERE, "--check", "sphere/check.csv", "--figures", "drawn"],
        ["hand-eye", "sphere", *FEW_SPHERE],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "hand-eye step": (
        "hand-eye.step.json",
        ["hand-eye", "step", *STEP, "--method", "classic"],  # of the best one: test_hand_eye
        ["hand-eye", "step", *STEP[2:]],
        (2, "BAD_INPUT"),
    ),
    "hand-eye line": (
        "hand-eye.line.json",
        ["hand-eye", "line", *LINE, "--line-kind", "edge", "--method", "classic"],
        ["hand-eye", "line", *LINE, "--target", "step/target.yaml"],
        (2, "BAD_INPUT"),
    ),
    "hand-eye joint": (
        "hand-eye.joint.json",
        ["hand-eye", "joint", *HEIGHTS, "--sphere", "sphere", "--line", "line"],
        ["hand-eye", "joint", "--sphere", "sphere"],
        (2, "BAD_INPUT"),
    ),
    "hand-eye check-plan": (
        "hand-eye.check-plan.json",
        [*PLANNED, "--poses", "sphere/few.csv", "--mount", "mount.yaml"],
        [*PLANNED, "--poses", "sphere/few.csv", "--mount", "nowhere.yaml"],
        (2, "BAD_INPUT"),
    ),
    "hand-eye verify": (
        "hand-eye.verify.json",
        ["hand-eye", "verify", "--result", "mount.yaml", "--target-kind", "sphere", *SPHERE],
        ["hand-eye", "verify", "--result", "mount.yaml", "--target-kind", "sphere", *FEW_SPHERE],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "hand-eye export": (
        "hand-eye.export.json",
        ["hand-eye", "export", "--result", "mount.yaml", "--format", "static-transform"],
        ["hand-eye", "export", "--result", "sphere/target.yaml", "--format", "urdf"],
        (2, "BAD_INPUT"),
    ),
    "hand-eye camera": (
        "hand-eye.camera.json",
        [*CAMERA, "--poses", "camera_poses.csv", "--check", "camera_check.csv", "--figures", "f"],
        [*CAMERA, "--poses", "few_camera_poses.csv"],
        (3, "TOO_FEW_SAMPLES"),
    ),
    "hand-eye tracker": (
        "hand-eye.tracker.json",
        [*TRACKER, "--target", "tracker_target.yaml"],
        [*TRACKER, "--radius-mm", "19.05"],
        (3, "RANK_DEFICIENT"),
    ),
    "correct-program": (
        "correct-program.json",
        [*CORRECT, "weld.dat", "--frames", "frames.dat", "--output", "weld_corrected.dat"],
        [*CORRECT, "weld.urp"],
        (2, "BAD_INPUT"),
    ),
    "tool station": (
        "tool.station.json",
        [
            "tool",
            "station",
            "--robot",
            "ur10",
            "--robot-serial",
            "laser_frame",
            "--state",
            "stations",
        ],
        ["tool", "station", "--robot", "ur10", "--robot-serial", "K2", "--state", "stations"],
        (2, "BAD_INPUT"),
    ),
    "correct-points": (
        "correct-points.json",
        [*POINTS, "--mount", "mount.yaml", "--output", "in_base.csv"],
        POINTS,
        (2, "BAD_INPUT"),
    ),
    "frame-shift": (
        "frame-shift.json",
        [*SHIFT, "--poses", "work.csv", "--maker", "kuka"],
        [*SHIFT, "--poses", "nowhere.csv", "--maker", "kuka"],
        (2, "BAD_INPUT"),
    ),
    "fixture": (
        "fixture.json",
        [*FIXTURE, "--points", "fixture_now.csv", "--taught", "fixture_taught.csv"],
        [*FIXTURE, "--points", "nowhere.csv"],
        (2, "BAD_INPUT"),
    ),
    "iso9283": (
        "iso9283.json",
        ["iso9283", "--data", str(ROOT / "docs/examples/positions.csv"), "--commanded", "P1=1,2,3"],
        ["iso9283", "--data", "edges.csv"],
        (2, "BAD_INPUT"),
    ),
    "joint-functions": (
        "joint-functions.json",
        ["joint-functions", "--robot", "full.yaml", "--output", "functions.csv"],
        ["joint-functions", "--robot", ROBOT],
        (2, "BAD_INPUT"),
    ),
    "import-ur": (
        "import-ur.json",
        ["import-ur", "--calibration", "c.conf", "--nominal", "n.conf", "--output", "ur.yaml"],
        ["import-ur", "--calibration", "n.conf", "--nominal", "n.conf", "--output", "no.yaml"],
        (2, "BAD_INPUT"),
    ),
    "import-urdf": (
        "import-urdf.json",
        ["import-urdf", "arm.urdf", "--output", "of_urdf.yaml"],
        ["import-urdf", "arm.urdf", "--tip", "nowhere", "--output", "no.yaml"],
        (2, "BAD_INPUT"),
    ),
    "export-urdf": (
        "export-urdf.json",
        ["export-urdf", "--robot", ROBOT, "--into", "arm.urdf", "--output", "out.urdf"],
        ["export-urdf", "--robot", "ur10", "--into", "arm.urdf", "--output", "no.urdf"],
        (2, "BAD_INPUT"),
    ),
    "plc": (
        "plc.json",
        ["plc", "certificates", "plc.yaml", "--host", "127.0.0.1"],
        ["plc", "certificates", "plc.yaml", "--days", "0"],
        (2, "BAD_INPUT"),
    ),
    "plc client": (
        "plc.json",
        ["plc", "certificates", "made.yaml", "--client", "robot"],
        ["plc", "certificates", "made.yaml", "--client", "../evil"],
        (2, "BAD_INPUT"),
    ),
    "plc user": (
        "plc.json",
        ["plc", "user", "made.yaml", "ada", "--remove"],
        ["plc", "user", "made.yaml", "eve", "--remove"],
        (2, "BAD_INPUT"),
    ),
    "data": ("data.json", ["data"], ["data", "ur10_tmak"], (2, "BAD_INPUT")),
    "warm": ("warm.json", ["warm"], ["warm", "ur10"], (2, "BAD_INPUT")),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    save_robot(with_joint_errors(load_robot(ROBOT), 1), folder / "full.yaml")
    (folder / "arm.urdf").write_text(urdf_of(load_robot(ROBOT)))
    (folder / "weld.dat").write_text(krl(postures(3, 5), postures(1, 6)), encoding="latin-1")
    (folder / "frames.dat").write_text(KUKA_FRAMES)
    work = joint_texts(postures(8, 7), load_robot(ROBOT))
    write_cells(folder / "work.csv", work)
    fixture_tables(folder)
    fixture_bag(folder / "fixture.mcap")
    table(folder / "data.csv", measured(60))
    table(folder / "few.csv", measured(3))
    visits = shift()
    plain_bag(folder / "plain.mcap", visits)
    recorded_bag(folder / "live.mcap", folder / "state", visits)
    hand_eye_bag(folder / "hand_eye.mcap")
    fixed_tables(folder)
    tool_tables(folder)
    run_tables(folder)
    bag = str(ROOT / "bags" / "laser_frame.mcap")
    robocal_json("replay.tool.json", "replay", bag, "--state", folder / "stations")
    for kind in ("sphere", "step", "line"):
        hand_eye_tables(folder / kind, kind)
    shots = (folder / "sphere" / "poses.csv").read_text().splitlines()
    (folder / "sphere" / "few.csv").write_text("\n".join(shots[:4]) + "\n")
    (folder / "mount.yaml").write_text(json.dumps({"T_flange_sensor": transform_document(TRUE)}))
    security_folder(folder / "made.yaml")
    camera_tables(folder)
    tracker_files(folder, prp_cell(load_description("p1r2p3").arm))
    placing = ["--data", folder / "sensor.csv", "--output", folder / "s.yaml"]
    robocal_json("thermal.sensor.json", *PLACE, *placing)
    (folder / "n.conf").write_text(UR_NOMINAL)
    (folder / "c.conf").write_text(UR_DELTAS)
    return folder


def test_every_command_and_schema_has_a_case() -> None:
    assert {name.split()[0] for name in CASES} == set(COMMANDS)
    shared = {"common.json", "error.json", "information.json"}
    assert {case[0] for case in CASES.values()} == set(SCHEMAS) - shared


def placed(folder: Path, arguments: list[str]) -> list[str]:
    """Names of files, and of folders after an option for one, become paths in the folder."""
    files = (".csv", ".mcap", ".conf", ".yaml", ".urdf", ".dat", ".urp")
    folders = ("--state", "--report", "--figures", "--profiles", "--sphere", "--step", "--line")
    return [
        str(folder / word) if word.endswith(files) or before in folders else word
        for before, word in zip(["", *arguments], arguments, strict=False)
    ]


@pytest.mark.parametrize("name", list(CASES))
def test_a_command_that_succeeds(folder: Path, name: str) -> None:
    schema, good, _, _ = CASES[name]
    document = robocal_json(schema, *placed(folder, good))
    assert "error" not in document


@pytest.mark.parametrize("name", list(CASES))
def test_a_command_that_fails(folder: Path, name: str) -> None:
    schema, _, bad, (status, code) = CASES[name]
    document = robocal_json("error.json", *placed(folder, bad), status=status)
    assert document["error"]["code"] == document["verdict"]["code"] == code
    if "if" in SCHEMAS[schema]:
        conforms(document, schema)


def test_without_json_a_failure_leaves_stdout_empty(folder: Path) -> None:
    done = robocal(*placed(folder, CASES["identify"][2]))
    assert done.returncode == 3
    assert done.stdout == ""
    assert "[TOO_FEW_SAMPLES]" in done.stderr
