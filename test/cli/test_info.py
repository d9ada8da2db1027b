# SPDX-License-Identifier: Apache-2.0
"""``robocal info``: each kind of file is known, and the commands that it names take it."""

import json
import shlex
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path

import pytest
from command import ROOT, robocal, robocal_json, takes
from histories import BY
from history_workers import proposal
from recordings import plain_bag, shift
from tool_runs import run_tables

from robocal_ros.cli import main
from robocal_ros.cli.commands import COMMANDS, CliGroup
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.kinematics.urdf import urdf_of

UR10 = load_description("ur10")
TABLES = ROOT / "docs" / "examples"
FILES = {
    str(ROOT / "bags" / "tool_runs.mcap"): ("bag", "session: tool of UR10"),
    str(ROOT / "bags" / "demo_shift.mcap"): ("bag", "the bag is simulated"),
    str(TABLES / "measured.csv"): ("measurements: joints, and where", "joints: 6"),
    str(TABLES / "positions.csv"): ("no kind that is known", "rows:"),
    str(ROOT / "config" / "robots" / "ur10.yaml"): ("robot file", "model hash"),
    str(ROOT / "config" / "cells" / "kr150_laser.yaml"): ("laser file", "serial: SIM-KR150"),
    str(ROOT / "config" / "thermal_node.yaml"): ("parameter file", "/**/thermal_node"),
}


@pytest.mark.parametrize("file", FILES)
def test_a_file_of_this_repository_is_known(file):
    kind, fact = FILES[file]
    done = robocal("info", file)
    assert done.returncode == 0, done.stderr
    assert kind in done.stdout.splitlines()[0]
    assert fact in done.stdout
    for command in robocal_json("info.json", "info", file)["commands"]:
        takes(command)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Files that commands and nodes write, and what people bring."""
    folder = tmp_path_factory.mktemp("info")
    plain_bag(folder / "plain.mcap", shift())
    run_tables(folder)
    (folder / "robot.urdf").write_text(urdf_of(UR10.arm, UR10.max_velocity))
    (folder / "broken.urdf").write_text("<robot name='x'><link name='a'/></robot>")
    (folder / "kinematics.yaml").write_text("kinematics: {shoulder: {x: 0.0}, hash: calib_1}\n")
    (folder / "prog.src").write_bytes(b"DEF w()\n; N\xe4he\nEND\n")  # not UTF-8
    (folder / "bad.yaml").write_text("convention: dh\njoints: []\n")
    (folder / "result.json").write_text('{"verdict": {"code": "ACCEPT", "reason": "good"}}')
    (folder / "verdict.json").write_text('{"verdict": "good"}')
    good = {"verdict": {"accept": True, "code": "ACCEPT", "reason": "good"}}
    place = {"xyz_mm": [60.0, -40.0, 110.0], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    (folder / "mount.json").write_text(json.dumps(good | {"T_flange_sensor": place}))
    tip = {"tcp_mm": place["xyz_mm"], "quat_xyzw": place["quat_xyzw"]}
    (folder / "tool.json").write_text(json.dumps(good | tip))
    (folder / "empty.yaml").write_text("kinematics:\n")
    (folder / "cell 4.csv").write_bytes((TABLES / "measured.csv").read_bytes())
    nominal = load_robot("ur10")
    for serial in ("R7", "R/9"):
        with CalibrationHistory.open(serial, model_hash=nominal.model_hash, state_dir=folder):
            pass
    warm = {"model_hash": nominal.model_hash, "model": model_document(nominal)}
    with CalibrationHistory.open("R8", model_hash=nominal.model_hash, state_dir=folder) as history:
        history.accept(history.propose(proposal(**warm)), **BY)
    shown = robocal("history", "show", "1", "--state", folder, "--robot-serial", "R8", "--json")
    (folder / "shown.json").write_text(shown.stdout)
    return folder


@pytest.mark.parametrize(
    ("name", "kind", "fact"),
    [
        ("plain.mcap", "bag", "commands of a node were not recorded"),
        ("run.csv", "table of beam edges", "columns: "),
        ("joints.csv", "joint readings over time", "joints: 6"),
        ("robot.urdf", "description of a robot (URDF)", "base to flange, 6 joints"),
        ("broken.urdf", "gives no arm", "fault: "),
        ("kinematics.yaml", "kinematics of a Universal Robots arm", "hash: calib_1"),
        ("prog.src", "program of kuka", "lines: "),
        ("bad.yaml", "robot file that is not valid", "fault: "),
        ("result.json", "result of a robocal command", "ACCEPT: good"),
        ("verdict.json", "result of a robocal command", "verdict: good"),
        ("empty.yaml", "kinematics of a Universal Robots arm", ""),
        ("cell 4.csv", "measurements: joints, and where", "joints: 6"),
        ("R7.sqlite", "history of the robot with serial R7", "calibrations: 0"),
        ("R8.sqlite", "history of the robot with serial R8", "thermal in force: revision 1"),
        ("R%2F9.sqlite", "history of the robot with serial R/9", "calibrations: 0"),
        ("shown.json", "calibration of a history", "verdict: "),
        ("mount.json", "result of a robocal command", "ACCEPT: good"),
        ("tool.json", "result of a robocal command", "ACCEPT: good"),
    ],
)
def test_a_file_that_was_made_is_known(made, name, kind, fact):
    document = robocal_json("info.json", "info", made / name)
    assert kind in document["kind"]
    assert fact in "".join(f"{one['name']}: {one['value']}\n" for one in document["facts"])
    for command in document["commands"]:
        takes(command)


def test_the_help_of_each_command_has_an_example_that_it_takes():
    leaves = {}
    for name, command in COMMANDS.items():
        if isinstance(command, CliGroup):
            leaves |= {f"{name} {action}": one.example for action, one in command.actions.items()}
        else:
            leaves[name] = command.example
    longer = {name for name, example in leaves.items() if example is None}
    assert longer == {"correct-program", "frame-shift"}
    for name, example in leaves.items():
        with redirect_stdout(StringIO()) as printed, suppress(SystemExit):
            main.main([*name.split(), "--help"])
        text = printed.getvalue()
        assert "xample" in text, name
        if name not in longer:
            line = f"robocal {name} {example}".rstrip()
            assert text.endswith(f"\nexample:\n  {line}\n")
            takes(line)


def test_what_it_names_runs_as_printed(made, monkeypatch):
    monkeypatch.chdir(made)
    for file, count in (
        ("robot.urdf", 1), ("R7.sqlite", 2), ("R8.sqlite", 3), ("mount.json", 1), ("tool.json", 1),
    ):  # fmt: skip
        for command in robocal_json("info.json", "info", file)["commands"][:count]:
            done = robocal(*shlex.split(command)[1:])
            assert done.returncode == 0, (command, done.stderr)
    assert "verify" in " ".join(robocal_json("info.json", "info", "mount.json")["commands"])


def test_a_model_of_a_history_is_taken_where_it_is_named(made, monkeypatch):
    monkeypatch.chdir(made)
    Path("PROGRAM.src").write_text(
        "DEF weld()\nLIN {X 900, Y 0, Z 900, A 0, B 90, C 0, S 2, T 2}\nEND\n"
    )
    for file in ("R8.sqlite", "shown.json"):
        (command,) = (
            one for one in robocal_json("info.json", "info", file)["commands"]
            if "correct-program" in one
        )  # fmt: skip
        words = [{"ROBOT": "ur10"}.get(word, word) for word in shlex.split(command)]
        Path("CORRECTED.src").unlink(missing_ok=True)
        done = robocal(*words[1:])
        assert "Traceback" not in done.stderr
        assert done.returncode == 0, (command, done.stdout, done.stderr)


def test_what_is_of_no_kind_is_said(tmp_path: Path):
    file = tmp_path / "notes.odt"
    file.write_text("hello")
    done = robocal("info", file)
    assert done.returncode == 2
    assert "is of no kind that is known" in done.stderr
