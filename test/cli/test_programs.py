# SPDX-License-Identifier: Apache-2.0
"""``robocal correct-program`` and ``frame-shift`` on files: what is written, whose model it is."""

import json
import re
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import conforms
from history_workers import SERIAL, proposal
from joint_errors import with_joint_errors

from bench.robot_programs import (
    KUKA_FRAMES,
    NOMINAL,
    T_BASE_FRAME,
    T_FLANGE_TOOL,
    drifted,
    krl,
    postures,
)
from robocal_ros.cli.main import main
from robocal_ros.cli.programs import given_models
from robocal_ros.ground.frames import log_rotation, transform_from_quat
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import inverse, model_document
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import save_robot
from robocal_ros.kinematics.tables import joint_texts, write_cells
from robocal_ros.kinematics.universal_robots import (
    factory_arm,
    nominal_arm,
    parse_settings,
    read_panel_poses,
)
from robocal_ros.programs.conventions import pose_of
from robocal_ros.programs.correcting import dialect_of

ACTUAL = drifted(NOMINAL, 1)
SINGULAR = np.radians([10.0, -80.0, 95.0, 40.0, 0.02, -20.0])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    save_robot(ACTUAL, tmp_path / "identified.yaml")
    text = krl(postures(3, 5), postures(1, 6))
    (tmp_path / "weld.dat").write_bytes(text.encode("latin-1"))
    (tmp_path / "$config.dat").write_text(KUKA_FRAMES)
    return tmp_path


def command(capsys, *words: str, name: str = "correct-program") -> tuple[int, dict]:
    robot = ["--robot", "kr150_r3100"]
    status = main([name, *words, *robot, "--json"])
    document = json.loads(capsys.readouterr().out)
    conforms(document, f"{name}.json")
    return status, document


MODEL = ("--model", "identified.yaml")
KNOWN = ("--frames", "$config.dat")


def test_a_program_is_corrected_into_another_file(folder: Path, capsys):
    before = (folder / "weld.dat").read_bytes()
    words = ("weld.dat", *MODEL, *KNOWN, "--output", "new.dat")
    status, document = command(capsys, *words)
    assert status == 0
    assert document["verdict"]["code"] == "ACCEPT"
    assert document["count"] == {
        "corrected": 4, "unchanged": 0, "not_corrected": 0, "of_another_group": 0,
    }  # fmt: skip
    assert max(point["left_mm"] for point in document["points"]) < 1e-3
    after = (folder / "new.dat").read_bytes()
    assert before == (folder / "weld.dat").read_bytes() != after
    assert b"N\xe4he" in after  # Latin-1 stays
    assert after.count(b"\r\n") == before.count(b"\r\n")
    status, document = command(capsys, *words)
    assert status == 2
    assert "is there already" in document["error"]["message"]
    assert (folder / "new.dat").read_bytes() == after
    status, document = command(capsys, "weld.dat", *MODEL, *KNOWN, "--output", "weld.dat")
    assert status == 2
    assert (folder / "weld.dat").read_bytes() == before


def test_a_tool_that_is_reckoned_is_not_that_of_the_same_line_elsewhere(folder: Path, capsys):
    weld = (folder / "weld.dat").read_text("latin-1")
    (place,) = re.findall(r"E6POS XP1=(\{[^}]*\})", weld)
    routine = "DEF part()\n$TOOL={}\n$BASE=$NULLFRAME\nPTP {}\nEND\n"
    (folder / "part.src").write_text(routine.format("reckon(1)", place))
    other = "{X 0.0,Y 0.0,Z 300.0,A 0.0,B 0.0,C 0.0}"
    data = f"TOOL_DATA[1]={other}\n"
    (folder / "other.src").write_text(routine.format(other, place) + data)
    _, document = command(capsys, "part.src", *MODEL, "--frames", "other.src")
    (point,) = document["points"]
    assert point["state"] == "not_corrected"
    assert "unknown tool $TOOL of line 2" in point["reason"]


def test_the_frames_of_home_are_those_of_the_robots_own_data_list(folder: Path, capsys):
    (place,) = re.findall(r"E6POS XP1=(\{[^}]*\})", (folder / "weld.dat").read_text("latin-1"))
    lines = f"FDAT_ACT=FHOME\nBAS(#FRAMES)\nLIN {place}\n"
    (folder / "part.src").write_text(f"DEF part()\n{lines}END\n")
    home = "DECL FDAT FHOME={TOOL_NO 3,BASE_NO 5,IPO_FRAME #BASE}\n"
    (folder / "$config.dat").write_text(KUKA_FRAMES + home)
    _, alone = command(capsys, "part.src", *MODEL)
    assert "$IPO_MODE of line 2" in alone["points"][0]["reason"]
    _, known = command(capsys, "part.src", *MODEL, *KNOWN)
    assert known["points"][0]["state"] == "corrected"


def test_a_data_list_is_read_with_the_program_beside_it(folder: Path, capsys):
    """A way that only the program's LIN_REL tells from a place; the name is in other letters."""
    words = ("weld.dat", *MODEL, *KNOWN)
    _, alone = command(capsys, *words)
    assert alone["module"] is None
    assert ["weld.src" in warning for warning in alone["warnings"]] == [True]
    (folder / "WELD.SRC").write_text("DEF WELD()\nPTP XP1\nLIN_REL XP2\nEND\n")
    _, both = command(capsys, *words)
    assert (both["module"], both["warnings"]) == ("WELD.SRC", [])
    states = {point["name"]: point["state"] for point in both["points"]}
    assert states == {
        "XP1": "corrected", "XP2": "not_corrected", "XP3": "corrected", "XHOME1": "corrected",
    }  # fmt: skip
    assert both["points"][1]["reason"] == "the program reckons with it in line 3 of WELD.SRC"
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    (folder / "WELD.SRC").rename(elsewhere / "weld.src")
    _, given = command(capsys, *words, "--module", "elsewhere/weld.src")
    assert [point["state"] for point in given["points"]] == list(states.values())
    status, document = command(capsys, *words, "--module", "none.src")
    assert (status, document["error"]["file"]) == (2, "none.src")
    (folder / "weld.src").write_text("DEF WELD()\nEND\n")
    for program, wrong, ending in (
        ("weld.dat", "$config.dat", ".src or .sub"),
        ("weld.dat", "weld.dat", ".src or .sub"),
        ("weld.src", "weld.src", ".dat"),
    ):
        status, document = command(capsys, program, *MODEL, "--module", wrong)
        assert (status, document["error"]["file"]) == (2, wrong)
        words = f"to {program} belongs a file with the ending {ending}; give one of tools and bases"
        assert words in document["error"]["message"]
    (folder / "main.as").write_text(".PROGRAM main()\n.END\n")
    status, document = command(capsys, "main.as", *MODEL, "--module", "weld.dat")
    assert status == 2
    assert "is one file" in document["error"]["message"]


def fanuc_point(number: int, q: np.ndarray) -> str:
    joints = ",\n".join(f"\tJ{i} = {x:.3f} deg" for i, x in enumerate(np.degrees(q), start=1))
    return f"P[{number}]{{\n   GP1:\n\tUF : 0, UT : 0,\n{joints}\n}};\n"


def test_points_of_another_group_are_told_by_name_and_hold_nothing_up(folder: Path, capsys):
    """As of a positioner that turns alone: no model of this robot says where it should be."""
    own = fanuc_point(1, postures(1, 6)[0])
    others = 'P[2:"turn"]{\n   GP2:\n\tUF : 0, UT : 1,\n\tJ1 = 90.000 deg\n};\n'
    (folder / "part.ls").write_text(f"/PROG  PART\n/MN\n/POS\n{own}{others}/END\n")
    _, document = command(capsys, "part.ls", *MODEL, "--output", "new.ls")
    assert document["verdict"]["code"] == "ACCEPT"
    assert document["verdict"]["reason"] == (
        "all of 1 points are as they should be; of another group alone, not corrected: P[2] turn"
    )
    assert document["count"] == {
        "corrected": 1, "unchanged": 0, "not_corrected": 0, "of_another_group": 1,
    }  # fmt: skip
    assert document["points"][1]["reason"] == "is of group 2 alone: group 1 alone is corrected"
    assert document["points"][1]["state"] == "of_another_group"
    assert others in (folder / "new.ls").read_text()
    left = fanuc_point(3, SINGULAR)
    (folder / "part.ls").write_text(f"/PROG  PART\n/MN\n/POS\n{own}{others}{left}/END\n")
    _, document = command(capsys, "part.ls", *MODEL, "--largest-mm", "0.001")
    assert document["verdict"]["reason"] == (
        "2 of 2 points are left as they were; --partial writes the others all the same; "
        "of another group alone, not corrected: P[2] turn"
    )
    assert main(["correct-program", "part.ls", *MODEL, "--robot", "kr150_r3100"]) == 0
    assert "not corrected, 1 of another group" in " ".join(capsys.readouterr().out.split())
    (folder / "turn.ls").write_text(f"/PROG  TURN\n/MN\n/POS\n{others}/END\n")
    status, document = command(capsys, "turn.ls", *MODEL)
    assert status == 2
    assert "no point of this robot: P[2] turn is of group 2 alone" in document["error"]["message"]


def test_joint_targets_of_kawasaki_are_corrected(folder: Path, capsys):
    rows = "\n".join(
        f"#p{i} " + " ".join(f"{x:.4f}" for x in np.degrees(q))
        for i, q in enumerate(postures(2, 5))
    )
    moves = "  JMOVE #p0\n  JMOVE #p1\n"
    text = f".PROGRAM main()\n{moves}.END\n.JOINTS\n{rows}\n.END\n"
    (folder / "cell.as").write_text(text)
    status, document = command(capsys, "cell.as", *MODEL, "--output", "new.as")
    assert (status, document["maker"]) == (0, "kawasaki")
    assert document["count"]["corrected"] == 2
    assert (folder / "new.as").read_text() != text


def test_a_program_that_is_corrected_in_part_is_written_when_asked(folder: Path, capsys):
    text = krl(postures(2, 5), SINGULAR[None])
    (folder / "part.dat").write_bytes(text.encode("latin-1"))
    words = ("part.dat", *MODEL, *KNOWN, "--output", "new.dat")
    status, document = command(capsys, *words)
    assert status == 0
    assert document["verdict"]["code"] == "LIMIT_EXCEEDED"
    assert document["output"] is None
    assert not (folder / "new.dat").exists()
    assert document["points"][2]["reason"].startswith("singular")
    _, document = command(capsys, *words, "--partial")
    assert document["output"] == "new.dat"
    assert document["verdict"]["accept"] is False
    last = (folder / "new.dat").read_text("latin-1").splitlines()[-2]
    assert last == text.splitlines()[-2]


def test_frames_and_bounds_come_from_the_command_line(folder: Path, capsys):
    given = ["--frame", "TOOL_DATA[3]=120.5,-14.25,262,30,40,-15"]
    given += ["--frame", "BASE_DATA[5]=900,-250.5,410.75,12,-3,5"]
    _, one = command(capsys, "weld.dat", *MODEL, *given)
    _, other = command(capsys, "weld.dat", *MODEL, *KNOWN)
    assert one["points"] == other["points"]
    assert one["output"] is None
    _, tight = command(capsys, "weld.dat", *MODEL, *KNOWN, "--largest-mm", "0.001")
    assert tight["count"]["not_corrected"] == 4
    status, document = command(capsys, "weld.dat", *MODEL, "--frame", "TOOL_DATA[3]=1,2,3")
    assert status == 2
    assert "NAME=X,Y,Z" in document["error"]["message"]


def test_a_frame_of_two_values_is_refused_until_it_is_named(folder: Path, capsys):
    other = KUKA_FRAMES.replace("X 900.0", "X 901.0")
    (folder / "other.dat").write_text(other)
    weld = (folder / "weld.dat").read_text("latin-1")
    (folder / "own.dat").write_text(weld.replace("ENDDAT", f"{other}ENDDAT"), "latin-1")
    two = (*KNOWN, "--frames", "other.dat")
    for program, given, file in (("weld.dat", two, "other.dat"), ("own.dat", KNOWN, "$config.dat")):
        status, document = command(capsys, program, *MODEL, *given)
        assert (status, document["error"]["file"]) == (2, file)
        assert "BASE_DATA[5] is another one than" in document["error"]["message"]
    named = ("--frame", "BASE_DATA[5]=900,-250.5,410.75,12,-3,5")
    _, expected = command(capsys, "weld.dat", *MODEL, *KNOWN)
    for program, given in (("weld.dat", two), ("own.dat", KNOWN)):
        _, document = command(capsys, program, *MODEL, *given, *named)
        assert document["points"] == expected["points"]
    unused = "BASE_DATA[9]={X 1,Y 0,Z 0,A 0,B 0,C 0}\n"
    (folder / "$config.dat").write_text(KUKA_FRAMES + unused)
    rounded = KUKA_FRAMES.replace("X 900.0", "X 900.0004") + unused.replace("X 1", "X 2")
    (folder / "other.dat").write_text(rounded)
    _, document = command(capsys, "weld.dat", *MODEL, *two)
    assert document["points"] == expected["points"]


def test_a_file_without_frames_is_refused_where_frames_are_wanted(folder: Path, capsys):
    (folder / "none.dat").write_text("DEFDAT A\nENDDAT\n")
    (folder / "sysframe.ls").write_text("UFRAME[1]: X 1.0 Y 2.0 Z 3.0\n")
    for program, none in (("weld.dat", "none.dat"), ("sysframe.ls", "sysframe.ls")):
        status, document = command(capsys, program, *MODEL, "--frames", none)
        assert (status, document["error"]["file"]) == (2, none)
        assert "no tool or base" in document["error"]["message"]


def test_a_track_is_told_by_its_direction(folder: Path, capsys):
    text = (folder / "weld.dat").read_bytes().replace(b"E1 0.0", b"E1 812.5")
    (folder / "track.dat").write_bytes(text)
    _, unknown = command(capsys, "track.dat", *MODEL, *KNOWN)
    reasons = {p["reason"] for p in unknown["points"] if p["by"] == "pose"}
    assert reasons == {"external axis 1 is at 812.5: it may carry robot or part; say which by "
                       "--external"}  # fmt: skip
    _, still = command(capsys, "track.dat", *MODEL, *KNOWN, "--external", "1=still")
    _, before = command(capsys, "weld.dat", *MODEL, *KNOWN)
    assert [p["shift_mm"] for p in still["points"]] == [p["shift_mm"] for p in before["points"]]
    for wrong in ("1=1,1,0", "1=0,1", "7=still", "a=still", "1"):
        status, document = command(capsys, "track.dat", *MODEL, *KNOWN, "--external", wrong)
        assert status == 2
        assert "'still' or a direction of length 1" in document["error"]["message"]


def test_the_model_is_a_robot_file_a_shown_calibration_or_the_one_in_force(folder: Path, capsys):
    _, of_file = command(capsys, "weld.dat", *MODEL, *KNOWN)
    shown = {"model": model_document(ACTUAL), "document": {}}
    (folder / "shown.json").write_text(json.dumps(shown))
    _, of_json = command(capsys, "weld.dat", "--model", "shown.json", *KNOWN)
    (folder / "undone.json").write_text(
        json.dumps(shown | {"calibration": {"id": 3, "state": "rolled_back"}})
    )
    status, undone = command(capsys, "weld.dat", "--model", "undone.json", *KNOWN)
    assert status == 2
    assert "the calibration was rolled back" in undone["error"]["message"]
    same = dict(model_hash=NOMINAL.model_hash, model=model_document(ACTUAL), based_on=0)
    in_force = ("weld.dat", "--robot-serial", SERIAL, "--state", "state", *KNOWN)
    with CalibrationHistory.open(
        SERIAL, model_hash=NOMINAL.model_hash, state_dir=folder / "state"
    ) as history:
        number = history.propose(proposal(**same))
        status, document = command(capsys, *in_force)
        assert status == 2
        assert "accept one first" in document["error"]["message"]
        history.accept(number, by="Ada", reason="", wall_ns=1)
    _, of_history = command(capsys, *in_force)
    for other in (of_json, of_history):
        for one, two in zip(of_file["points"], other["points"], strict=True):
            assert one["shift_mm"] == pytest.approx(two["shift_mm"], abs=1e-6)


def test_a_payload_that_a_model_without_masses_does_not_follow_is_told(folder: Path):
    cold = with_joint_errors(ACTUAL, 1)
    save_robot(replace(cold, load=ArmLoad.unknown(6)), folder / "found.yaml")
    save_robot(replace(NOMINAL, load=cold.load), folder / "weighed.yaml")
    for robot, said in (("kr150_r3100", False), ("weighed.yaml", True)):
        args = Namespace(robot=robot, model=folder / "found.yaml", reference=None)
        models, warnings = given_models(args)
        assert models.actual.masses == "found"
        assert any("without masses the model cannot follow" in w for w in warnings) == said


def test_a_model_carries_what_the_robot_file_states_and_what_that_costs_is_told(folder: Path):
    cold = with_joint_errors(ACTUAL, 1)
    save_robot(cold, folder / "cold.yaml")
    (folder / "cold.json").write_text(json.dumps({"model": model_document(cold)}))
    save_robot(replace(NOMINAL, load=replace(cold.load, payload_mass=60.0)), folder / "heavy.yaml")
    save_robot(replace(NOMINAL, load=cold.load), folder / "same.yaml")
    loaded = replace(cold, load=replace(cold.load, payload_mass=60.0))
    q = postures(3, 5)
    for model in (folder / "cold.yaml", folder / "cold.json"):
        for robot, truth in (("heavy.yaml", loaded), ("same.yaml", cold), ("kr150_r3100", cold)):
            args = Namespace(robot=robot, model=model, reference=model)
            models, warnings = given_models(args)
            for arm in (models.actual, models.reference):
                np.testing.assert_allclose(arm.fk(q), truth.fk(q), rtol=0.0, atol=1e-8)
            words = r"payload of 10 kg .* says 60 kg .* up to [0-9.]+ mm at the flange"
            assert any(re.search(words, w) for w in warnings) == (truth is loaded)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("wide.dat", b"D\0E\0F\0", "one byte a character"),
        ("empty.dat", b"DEFDAT A\r\nENDDAT\r\n", "no point"),
        ("part.urp", b"\x1f\x8b", "no ending of a program"),
    ],
)
def test_what_is_no_program_is_refused(folder: Path, capsys, name, content, why):
    (folder / name).write_bytes(content)
    status, document = command(capsys, name, *MODEL)
    assert status == 2
    assert why in document["error"]["message"]


def test_a_model_of_another_robot_is_refused(folder: Path, capsys):
    status, document = command(capsys, "weld.dat", "--model", "ur10")
    assert (status, document["error"]["code"]) == (2, "WRONG_ROBOT")
    (folder / "none.json").write_text("[1, 2]")
    status, document = command(capsys, "weld.dat", "--model", "none.json")
    assert (status, document["error"]["code"]) == (2, "BAD_INPUT")


def test_people_get_a_table(folder: Path, capsys):
    assert main(["correct-program", "weld.dat", *MODEL, "--robot", "kr150_r3100"]) == 0
    said = capsys.readouterr().out
    assert "3 not corrected" in said
    assert "another group" not in said
    assert "unknown frame BASE_DATA[5]" in said
    assert "--partial writes the others" in said


def shifted(capsys, *words: str) -> tuple[int, dict]:
    return command(capsys, "--poses", "work.csv", *MODEL, *words, name="frame-shift")


@pytest.fixture
def work(folder: Path) -> Path:
    columns = {"sample": [f"w{i}" for i in range(12)]} | joint_texts(postures(12, 8), NOMINAL)
    write_cells(folder / "work.csv", columns)
    return folder


def test_frames_come_out_as_shifted(work: Path, capsys):
    tool, base = "TOOL_DATA[3]=120.5,-14.25,262,30,40,-15", "BASE_DATA[5]=900,-250.5,410.75,12,-3,5"
    frames = ("--tool", tool, "--base", base, "--base", "BASE_DATA[6]=0,0,0,0,0,0")
    frames += ("--tool", "TOOL_DATA[4]=0,0,0,0,0,0")
    status, document = shifted(capsys, "--maker", "kuka", *frames, "--output", "frames.src")
    assert status == 0
    assert document["verdict"]["code"] == "ACCEPT"
    assert document["after"]["rms_mm"] < 0.9 * document["before"]["rms_mm"]
    assert [pose["name"] for pose in document["poses"]] == [f"w{i}" for i in range(12)]
    text = document["text"]
    assert (work / "frames.src").read_text() == text + "\n"
    found = dialect_of(".src").read(text).frames
    T_base, T_tool = (frames_of(document[name]) for name in ("T_base_shift", "T_tool_shift"))
    for name, expected in (
        ("TOOL_DATA[3]", T_FLANGE_TOOL @ T_tool),
        ("TOOL_DATA[4]", T_FLANGE_TOOL @ T_tool @ np.linalg.inv(T_FLANGE_TOOL)),
        ("BASE_DATA[5]", T_base @ T_BASE_FRAME),
        ("BASE_DATA[6]", T_base),
    ):
        np.testing.assert_allclose(found[name], expected, atol=3e-7)
    status, document = shifted(capsys, "--maker", "kuka", "--output", "frames.src")
    assert status == 2
    assert "is there already" in document["error"]["message"]


def frames_of(document: dict) -> np.ndarray:
    return transform_from_quat(1e-3 * np.array(document["xyz_mm"]), document["quat_xyzw"])


@pytest.mark.parametrize(
    ("maker", "lines"),
    [
        ("kuka", ["$TOOL={X ", "$BASE={X "]),
        ("abb", ["! mass", "PERS tooldata tcp:=[TRUE,[[", "PERS wobjdata wobj:=[FALSE,TRUE,"]),
        ("fanuc", ["UTOOL:", "X ", "W ", "UFRAME:", "X ", "W "]),
        ("ur", ["set_tcp(p[", "# no base", "base=p["]),
        ("kawasaki", ["TOOL TRANS(", "BASE TRANS("]),
    ],
)
def test_each_maker_has_its_own_text(work: Path, capsys, maker, lines):
    _, document = shifted(capsys, "--maker", maker)
    told = document["text"].splitlines()
    assert [line[: len(start)] for line, start in zip(told, lines, strict=True)] == lines
    _, alone = shifted(capsys, "--maker", maker, "--parts", "tool")
    assert len(alone["text"].splitlines()) < len(told)
    assert alone["T_base_shift"]["xyz_mm"] == [0.0, 0.0, 0.0]
    warned = any("factory calibration" in words for words in document["warnings"])
    assert warned == (maker == "ur")  # the robot file is a nominal one


@pytest.mark.parametrize(
    ("maker", "pattern"),
    [
        ("fanuc", r"UT3:\nX [^:]*\nUT4:\nX [^:]*\nUF5:\nX [^:]*"),
        ("ur", r"set_tcp\(.*\)  # UT3\nset_tcp\(.*\)  # UT4\n# no base .*\nUF5=p.*"),
        ("kawasaki", r"TOOL TRANS\(.*\) ; UT3\nTOOL TRANS\(.*\) ; UT4\nBASE TRANS\(.*\) ; UF5"),
    ],
)
def test_each_frame_is_told_by_its_name(work: Path, capsys, maker, pattern):
    tools = ("--tool", "UT3=0,0,0,0,0,0", "--tool", "UT4=0,0,0,0,0,0")
    _, document = shifted(capsys, "--maker", maker, *tools, "--base", "UF5=0,0,0,0,0,0")
    assert re.fullmatch(pattern, document["text"])


def test_weights_are_taken_from_the_table(work: Path, capsys):
    cells = joint_texts(postures(12, 8), NOMINAL) | {"weight": ["1000", *["1"] * 11]}
    _, plain = shifted(capsys, "--maker", "kuka")
    write_cells(work / "work.csv", cells)
    _, weighed = shifted(capsys, "--maker", "kuka")
    assert weighed["poses"][0]["after"]["mm"] < plain["poses"][0]["after"]["mm"]
    write_cells(work / "work.csv", cells | {"weight": ["0"] * 12})
    status, document = shifted(capsys, "--maker", "kuka")
    assert (status, document["error"]["column"]) == (2, "weight")


def test_people_get_the_shift_as_a_table(work: Path, capsys):
    words = ["frame-shift", "--poses", "work.csv", *MODEL, "--robot", "kr150_r3100"]
    assert main([*words, "--maker", "ur"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "error of the tool at the working poses" in said
    assert "within the limit" in said
    assert "set_tcp(p[" in said


@pytest.fixture
def cell(work: Path, capsys) -> tuple:
    """A robot whose thermal model is in force, and how to give it another one."""
    where = ("--robot-serial", SERIAL, "--state", str(work / "state"))

    def in_force(arm, revision):
        with CalibrationHistory.open(
            SERIAL, model_hash=NOMINAL.model_hash, state_dir=work / "state"
        ) as history:
            made = proposal(
                model_hash=NOMINAL.model_hash, model=model_document(arm), based_on=revision
            )
            history.accept(history.propose(made), by="Ada", reason="", wall_ns=1)

    def shift(*words, given=("--poses", "work.csv", "--maker", "kuka")):
        ask = ["frame-shift", "--robot", "kr150_r3100", *given]
        status = main([*ask, *where, *words, "--json"])
        return status, json.loads(capsys.readouterr().out)

    def history(*words):
        status = main(["history", *words, *where, "--json"])
        return status, json.loads(capsys.readouterr().out)

    in_force(ACTUAL, 0)
    return in_force, shift, history


def test_a_shift_is_kept_verified_and_rolled_back(cell):
    in_force, shift, history = cell
    _, first = shift("--keep")
    assert first["in_force"] is None
    assert history("accept", str(first["calibration_id"]))[0] == 0
    # the same robot: what is in force serves, and is printed as it was found
    _, again = shift()
    assert again["verdict"]["code"] == "NO_SIGNIFICANT_GAIN"
    assert again["in_force"]["rms_mm"] == pytest.approx(first["after"]["rms_mm"], rel=1e-9)
    # what serves no better is not printed: the frames in force are
    _, tool = shift("--parts", "tool")
    assert tool["verdict"]["code"] == "NO_SIGNIFICANT_GAIN"
    assert tool["text"] == first["text"].splitlines()[0]
    _, printed = shift("--in-force")
    assert printed["text"] == first["text"]
    assert printed["verdict"]["accept"]
    # it has drifted: the shift in force leaves more, a new one less, absolute from the frames given
    in_force(drifted(NOMINAL, 7), 1)
    _, drift = shift("--keep")
    assert drift["verdict"]["code"] == "ACCEPT"
    assert drift["in_force"]["rms_mm"] > drift["after"]["rms_mm"]
    assert history("accept", str(drift["calibration_id"]))[0] == 0
    _, printed = shift("--in-force")
    assert printed["text"] == drift["text"] != first["text"]
    # and back, to the one before and to the frames as they were
    assert history("rollback", "--kind", "frame_shift")[0] == 0
    assert shift("--in-force")[1]["text"] == first["text"]
    _, document = history("rollback", "--kind", "frame_shift", "--to", "nominal")
    assert "what the frames were before any shift" in document["verdict"]["reason"]
    assert shift("--in-force")[1]["text"] == (
        "$TOOL={X 0.0000,Y 0.0000,Z 0.0000,A 0.00000,B 0.00000,C 0.00000}\n"
        "$BASE={X 0.0000,Y 0.0000,Z 0.0000,A 0.00000,B 0.00000,C 0.00000}"
    )


def test_what_is_in_force_is_told_without_poses_and_maker(cell, capsys):
    _, shift, history = cell
    status, none = shift("--in-force", given=())
    assert (status, none["text"], none["before"], none["poses"]) == (0, None, None, [])
    assert none["verdict"]["reason"] == "no shift is in force: the frames are as they were"
    assert none["T_base_shift"]["xyz_mm"] == [0.0, 0.0, 0.0]
    _, kept = shift("--keep", "--tool", "TOOL_DATA[3]=120.5,-14.25,262,30,40,-15")
    assert history("accept", str(kept["calibration_id"]))[0] == 0
    # at the poses that it was found for, and with their tool
    _, told = shift("--in-force", given=())
    for name in ("T_base_shift", "T_tool_shift", "before", "after", "poses"):
        assert told[name] == kept[name]
    assert (told["maker"], told["text"], told["in_force"]["revision"]) == (None, None, 1)
    _, of_maker = shift("--in-force", given=("--maker", "kuka"))
    assert of_maker["text"] == kept["text"].replace("TOOL_DATA[3]", "$TOOL")
    for words, missing in (((), "--poses and --maker"), (("--maker", "kuka"), "--poses")):
        status, document = shift(given=words)
        assert status == 2
        assert f"give {missing}: only --in-force" in document["error"]["message"]
    status, document = shift("--in-force", "--output", "frames.src", given=())
    assert (status, "give --maker" in document["error"]["message"]) == (2, True)


def test_people_get_the_six_numbers_of_each_frame_in_force(cell, capsys):
    _, shift, history = cell
    _, kept = shift("--keep")
    history("accept", str(kept["calibration_id"]))
    words = ["--robot", "kr150_r3100", "--robot-serial", SERIAL, "--state", "state"]
    assert main(["frame-shift", *words, "--in-force"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for part in ("base", "tool"):
        (row,) = (line.split()[1:] for line in lines if line.split()[:1] == [part])
        numbers = np.array(row, dtype=float)
        T = frames_of(kept[f"T_{part}_shift"])
        np.testing.assert_allclose(numbers[:3], 1e3 * T[:3, 3], atol=5e-5)
        np.testing.assert_allclose(numbers[3:], np.degrees(log_rotation(T[:3, :3])), atol=5e-6)


def test_a_shift_for_a_model_that_is_gone_is_stale(cell):
    in_force, shift, history = cell
    _, first = shift("--keep")
    in_force(drifted(NOMINAL, 7), 1)
    status, document = history("accept", str(first["calibration_id"]))
    assert (status, document["error"]["code"]) == (3, "STALE")
    assert shift("--keep", "--in-force")[0] == 2


@pytest.mark.data
def test_a_nominal_arm_in_place_of_a_calibrated_controller_is_told(
    tmp_path: Path, data_dir: Path, capsys
):
    """Of the real UR5e the nominal model is 1.1 mm off what its controller shows."""
    folder = data_dir / "ur5e_factory"
    nominal, delta = (
        parse_settings((folder / name).read_text(), name)
        for name in ("urcontrol.conf.UR5", "calibration.conf")
    )
    factory = factory_arm(nominal, delta, "ur5e")
    save_robot(nominal_arm(nominal, "ur5e"), tmp_path / "nominal.yaml")
    save_robot(factory, tmp_path / "factory.yaml")
    actual = drifted(factory, 3, 1e-4, 5e-5)
    save_robot(actual, tmp_path / "actual.yaml")
    shown = read_panel_poses(folder / "joint-eef-data.csv")
    rows = []
    for q, place, R in zip(shown.q, shown.position, shown.rotation, strict=True):
        pose = ", ".join(f"{v:.12f}" for v in (*place, *log_rotation(R)))
        rows.append(f"movej(get_inverse_kin(p[{pose}], qnear={q.tolist()}))")
    text = "\n".join(["set_tcp(p[0, 0, 0, 0, 0, 0])", *rows, ""])
    (tmp_path / "part.script").write_text(text)
    largest_mm = {}
    for name in ("nominal", "factory"):
        robot, model = (str(tmp_path / f"{one}.yaml") for one in (name, "actual"))
        output = tmp_path / f"{name}.script"
        words = ["correct-program", str(tmp_path / "part.script"), "--robot", robot, "--json"]
        main([*words, "--model", model, "--output", str(output)])
        told = json.loads(capsys.readouterr().out)
        assert told["verdict"]["accept"]
        assert any("factory calibration" in w for w in told["warnings"]) == (name == "nominal")
        corrected = re.findall(r"p\[([^]]*)\], qnear", output.read_text())
        poses = [pose_of("ur", [float(v) for v in one.split(",")]) for one in corrected]
        pairs = zip(poses, shown.q, strict=True)
        moved = np.array([inverse(factory, T[None], q)[0] for T, q in pairs])  # by the controller
        off = actual.fk(moved)[:, :3, 3] - shown.position
        largest_mm[name] = 1e3 * float(np.max(np.linalg.norm(off, axis=1)))
    assert largest_mm["factory"] < 1e-3 < 1.0 < largest_mm["nominal"]


def test_what_is_kept_needs_a_history(work: Path, capsys):
    for word in ("--keep", "--in-force"):
        status, document = shifted(capsys, "--maker", "kuka", word)
        assert status == 2
        assert "give --robot-serial" in document["error"]["message"]
