# SPDX-License-Identifier: Apache-2.0
"""``robocal tool`` on whole simulated runs: from the beams' edges to a controller's text."""

import json
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import yaml
from command import conforms, robocal_json
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tool_runs import (
    DOWN_MM,
    LATENCY_S,
    LEANING,
    RADIUS_MM,
    SAMPLE_S,
    SWEEP_COLUMNS,
    TAUGHT_MM,
    TRUTH,
    UP_MM,
    X_MM,
    RunTables,
    simulated_run,
    sweep_rows,
)
from tool_tables import POINT_COLUMNS, touch_rows, write

from robocal_ros.cell_sim.beams import CYLINDER_M
from robocal_ros.cli.main import main

CYLINDER_MM = 1e3 * CYLINDER_M
TAUGHT = ("--taught-mm", ",".join(map(str, TAUGHT_MM)))
INPUT = ("--sample-period-s", SAMPLE_S)
FOUR_SIGMA = chi2.ppf(1.0 - 6.3e-5, 5)  # of five unknowns together, at a normal's four sigma


@pytest.fixture(scope="module")
def tables() -> RunTables:
    return simulated_run()


@pytest.fixture(scope="module")
def laser(tables, tmp_path_factory) -> Path:
    """The laser file, written by the command from the robot's own sweeps."""
    folder = tmp_path_factory.mktemp("laser")
    beams = write(folder / "beams.csv", POINT_COLUMNS, tables.beams)
    found = robocal_json(
        "tool.beams.json", "tool", "beams", "--data", beams, "--radius-mm", CYLINDER_MM,
        "--robot", "ur10", "--station", "cell_1", "--sigma-mm", 1e3 * tables.laser.sigma_m,
        "--output", folder / "laser.yaml",
    )  # fmt: skip
    assert found["output"] == str(folder / "laser.yaml")
    return folder / "laser.yaml"


@pytest.fixture
def answer(capsys):
    """Run ``robocal`` in this process: its document, after a look at exit status and schema."""

    def ask(*words: object, status: int = 0):
        assert main([*map(str, words), "--json"]) == status
        document = json.loads(capsys.readouterr().out)
        action = words[1]
        conforms(document, "error.json" if status else f"tool.{action}.json")
        return document

    return ask


@pytest.fixture
def crossed(answer, tables, laser, tmp_path):
    """``tool crossed`` on the run, changed."""

    def ask(*more, events=None, joints=None, laser=laser, robot="ur10", taught=TAUGHT, status=0):
        files = tables.written(tmp_path, events, joints)
        words = ("tool", "crossed", *files, "--robot", robot, "--laser", laser, *INPUT)
        return answer(*words, *taught, *more, status=status)

    return ask


def deviation(found) -> np.ndarray:
    """Of tip and axis from the truth, in the units of the covariance."""
    R = Rotation.from_quat(found["quat_xyzw"]).as_matrix()
    tip = 1e-3 * np.array(found["tcp_mm"]) - TRUTH[:3, 3]
    return np.append(tip, R[:, :2].T @ (R[:, 2] - TRUTH[:3, 2]))


def test_a_run_recovers_the_bent_tool(crossed):
    found = crossed()
    away, covariance = deviation(found), np.array(found["covariance"])
    assert away @ np.linalg.solve(covariance, away) < FOUR_SIGMA
    assert found["covariance_units"] == ["m", "m", "m", "rad", "rad"]
    sigma = np.sqrt(np.diag(covariance))
    assert found["sigma_mm"] == pytest.approx(1e3 * sigma[:3])
    assert found["sigma_deg"] == pytest.approx(np.degrees(sigma[3:]))
    assert found["axis"] == pytest.approx(Rotation.from_quat(found["quat_xyzw"]).apply([0, 0, 1]))
    assert [radius["circle"] for radius in found["tool_radius_mm"]] == ["low", "high", "upright"]
    assert found["verdict"]["accept"]
    late = LATENCY_S + 0.5 * SAMPLE_S  # an edge waits for the next sample, half a period on average
    assert found["latency_s"] == pytest.approx(late, abs=4.0 * found["latency_sigma_s"])
    assert max(found["sigma_mm"]) < 0.2


def test_joints_that_err_are_said(crossed, tmp_path):
    """No healthy tool's run takes them away; a robot file with joint functions holds them."""
    found = crossed()
    factor = found["joint_errors"]["factor"]
    assert found["joint_errors"]["size_urad"] == 300.0
    assert factor > 2.0
    assert found["verdict"]["reason"].endswith(f"to the tip's sigma: count {factor:.1f} of it")
    less = crossed("--joint-error-urad", 50)["joint_errors"]
    assert less["sigma_mm"] == pytest.approx(np.array(found["joint_errors"]["sigma_mm"]) / 6.0)
    assert 1.0 < less["factor"] < factor
    silent = crossed("--joint-error-urad", 0)
    assert silent["joint_errors"] is None
    assert "joints that err" not in silent["verdict"]["reason"]
    assert crossed("--method", "classic")["joint_errors"] is None


def test_the_radii_are_those_of_the_tilted_cylinder(crossed):
    """Upright both beams see the radius; each edge is known to about 0.03 mm."""
    upright = crossed()["tool_radius_mm"][2]
    assert [upright["x"], upright["y"]] == pytest.approx([RADIUS_MM] * 2, abs=4.0 * 0.03)


def test_classic_is_near_and_says_what_it_does_not_know(crossed):
    found = crossed("--method", "classic")
    away = deviation(found)
    assert np.linalg.norm(away[:3]) < 1e-3
    assert np.linalg.norm(away[3:]) < np.radians(0.5)
    assert found["covariance"] is found["sigma_mm"] is found["latency_s"] is None


def test_a_found_tool_is_taught_again_and_exported(crossed, answer, tmp_path):
    first = crossed()
    file = tmp_path / "tool.json"
    file.write_text(json.dumps(first))
    again = crossed(taught=("--tool", file))
    assert again["tcp_mm"] == pytest.approx(first["tcp_mm"], abs=1e-4)
    text = answer("tool", "export", "--tool", file, "--format", "kuka")["text"]
    numbers = [float(n) for n in re.findall(r"[XYZABC] ([-\d.]+)", text)]
    assert numbers[:3] == pytest.approx(first["tcp_mm"], abs=1e-3)
    turn = Rotation.from_euler("ZYX", numbers[3:], degrees=True)
    assert (turn * Rotation.from_quat(first["quat_xyzw"]).inv()).magnitude() < np.radians(2e-5)


def test_the_robot_files_tool_is_the_taught_one(crossed, tmp_path):
    """Without options: a robot whose file carries the tool finds the same one."""
    from robocal_ros.kinematics.robots import find_robot

    text = find_robot("ur10").read_text()
    assert "\ntool:" not in text
    robot = tmp_path / "with_tool.yaml"
    robot.write_text(f"{text}\ntool: {{xyz_mm: {list(TAUGHT_MM)}, rpy_deg: [0, 0, 0]}}\n")
    own = yaml.safe_load(robot.read_text())["tool"]["xyz_mm"]
    assert own == list(TAUGHT_MM)
    assert crossed(robot=robot, taught=())["tcp_mm"] == crossed()["tcp_mm"]


def lost(rows: list, index: int) -> list:
    return rows[:index] + rows[index + 1 :]


def of_step(rows: list, step: str, beam: str) -> list[int]:
    return [i for i, row in enumerate(rows) if row[3] == step and row[1] == beam]


def later(stamp: str, by_s: float) -> str:
    return str(Decimal(stamp) + Decimal(str(by_s)))


def seven(rows: list) -> list:
    return lost(rows, of_step(rows, "high", "y")[3])


def chattering(rows: list) -> list:
    t, beam, blocked, step = rows[of_step(rows, "upright", "x")[0]]
    return [*rows, (later(t, 1e-4), beam, 1 - blocked, step)]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (seven, r"high: beam y (has 3 edges|is \w+ twice)"),
        (chattering, "beam x chatters: 2 edges"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_wrong_edges_of_a_run_are_refused(crossed, tables, change, words):
    refused = crossed(events=change(tables.events), status=3)["error"]
    assert refused["code"] == "BEAM_EDGES_WRONG"
    assert re.search(words, refused["message"])


def test_people_get_a_run_in_words(tables, laser, tmp_path, capsys):
    words = ["tool", "crossed", *tables.written(tmp_path), "--robot", "ur10", "--laser", laser]
    for method, tip in (
        ("best", r"Tip .*mm: 3\.\d{3} ± 0\.0\d\d, -[12]\.\d{3} ± 0\.0"),
        ("classic", r"Tip .*mm: [23]\.\d{3}, -[12]\.\d{3}, 15[01]\.\d{3}\n"),
    ):
        assert main([*map(str, [*words, *INPUT, *TAUGHT]), "--method", method]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith("ACCEPT: ")
        assert re.search(tip, printed)
    assert main(["tool", "export", "--xyz-mm", "1,2,3", "--format", "ur"]) == 0
    assert capsys.readouterr().out.startswith("set_tcp(p[0.0010000,0.0020000,0.0030000,0.0000000")


def test_a_laser_frame_of_another_robot_is_refused(crossed):
    refused = crossed(robot="kr150_r3100", status=2)["error"]
    assert refused["code"] == "WRONG_ROBOT"
    assert "was made for" in refused["message"]


def test_names_that_say_nothing_are_refused(crossed, tables):
    dip = [(*row[:3], "dip") for row in tables.events]
    refused = crossed(events=dip, status=2)["error"]
    assert (refused["row"], refused["column"]) == (2, "step")
    assert "'dip' is no step; circles are called low, high, upright" in refused["message"]
    again = [*tables.events[:-1], (*tables.events[-1][:3], "low")]
    assert "step 'low' comes again" in crossed(events=again, status=2)["error"]["message"]


def test_a_run_without_steps_and_a_circle_with_many(answer, tables, laser, tmp_path):
    bare = write(tmp_path / "bare.csv", "stamp_s,beam,blocked", [r[:3] for r in tables.events])
    files = tables.written(tmp_path)
    words = ("--robot", "ur10", "--laser", laser, "--joints", files[3])
    refused = answer("tool", "crossed", "--events", bare, *words, status=2)["error"]
    assert "column step is missing: it names the motion of each edge" in refused["message"]
    one = ("tool", "crossed", *files[:2], "--radius-mm", 12, "--period-s", 1.5)
    assert "give --joints, --robot and --laser" in answer(*one, status=2)["error"]["message"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--radius-mm", 12), "--joints belongs to a whole run, --radius-mm to one circle"),
        (("--latency-s", 0.1), "--latency-s to one circle"),
        (("--taught-mm", "0,0,1", "--tool", "t.json"), "the tool is given twice"),
        (("--taught-rpy-deg", "0,0,1"), "alone are no tool"),
    ],
)
def test_options_of_both_forms_do_not_mix(crossed, more, words):
    assert words in crossed(*more, taught=(), status=2)["error"]["message"]


def test_a_run_needs_all_three(answer, tables, tmp_path):
    files = tables.written(tmp_path)
    refused = answer("tool", "crossed", *files, "--robot", "ur10", status=2)["error"]
    assert refused["message"].endswith("--laser is missing")
    refused = answer("tool", "crossed", *files[:2], status=2)["error"]
    assert "--radius-mm and --period-s for one circle" in refused["message"]


def test_a_laser_file_needs_its_owner(answer, tables, tmp_path):
    beams = write(tmp_path / "beams.csv", POINT_COLUMNS, tables.beams)
    words = ("tool", "beams", "--data", beams)
    refused = answer(*words, "--output", tmp_path / "l.yaml", "--robot", "ur10", status=2)
    assert "--output needs --station" in refused["error"]["message"]
    refused = answer(*words, "--station", "cell", status=2)
    assert "give --output too" in refused["error"]["message"]
    assert not (tmp_path / "l.yaml").exists()


@pytest.mark.parametrize("whole", [False, True])
def test_parallel_beams(answer, tmp_path, whole):
    """Exact but for the bisection of the simulated edges."""
    data = write(tmp_path / "sweeps.csv", SWEEP_COLUMNS, sweep_rows(whole))
    words = ["tool", "parallel", "--data", data, "--up-mm", UP_MM, "--down-mm", DOWN_MM]
    found = answer(*words, "--x-mm", X_MM)
    assert found["axis"] == pytest.approx(LEANING[:3, 2], abs=1e-9)
    assert Rotation.from_quat(found["quat_xyzw"]).apply([0, 0, 1]) == pytest.approx(found["axis"])
    if not whole:
        assert found["tcp_mm"] is None
        return
    assert found["tcp_mm"] == pytest.approx(1e3 * LEANING[:3, 3], abs=1e-5)
    assert "place along the base's x" in answer(*words, status=2)["error"]["message"]


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        (lambda rows: [r for r in rows if r[:2] != ["turned", "down"]], 3, "turned has no edges"),
        (lambda rows: rows[1:], 2, "sweep straight, beam up: 1 edges"),
        (lambda rows: rows[:-1], 3, "there is no plunge"),
        (lambda rows: [["dip", *r[1:]] for r in rows], 2, "'dip' is not one of straight"),
        (lambda rows: [[r[0].replace("straight", "turned"), *r[1:]] for r in rows], 3, "straight"),
        (lambda rows: [["straight" if r[0] == "turned" else "turned" if r[0] == "straight"
                        else r[0], *r[1:]] for r in rows], 2, "is turned by 90.00 deg"),
    ],
)  # fmt: skip
def test_parallel_beams_refuse(answer, tmp_path, change, status, words):
    data = write(tmp_path / "sweeps.csv", SWEEP_COLUMNS, change(sweep_rows()))
    heights = ("--up-mm", UP_MM, "--down-mm", DOWN_MM, "--x-mm", X_MM)
    refused = answer("tool", "parallel", "--data", data, *heights, status=status)
    assert words in refused["error"]["message"]


def test_poor_touches_are_not_exported(answer, tmp_path):
    header = "x_mm,y_mm,z_mm,qx,qy,qz,qw"
    poor = write(tmp_path / "poor.csv", header, touch_rows(8, noise_mm=3.0))
    file = tmp_path / "tool.json"
    file.write_text(json.dumps(answer("tool", "points", "--data", poor)))
    refused = answer("tool", "export", "--tool", file, "--format", "ur", status=2)
    assert "verdict is RESIDUAL_TOO_LARGE" in refused["error"]["message"]


def test_a_tip_alone_is_exported_with_a_turn(answer, tmp_path):
    file = tmp_path / "tool.json"
    touched = write(tmp_path / "t.csv", "x_mm,y_mm,z_mm,qx,qy,qz,qw", touch_rows(6))
    file.write_text(json.dumps(answer("tool", "points", "--data", touched)))
    words = ("tool", "export", "--tool", file, "--format", "fanuc")
    assert "quat_xyzw" in answer(*words, status=2)["error"]["message"]
    assert "W 180.00000" in answer(*words, "--rpy-deg", "180,0,0")["text"]


def test_loads_are_abbs(answer):
    words = ("tool", "export", "--xyz-mm", "-1,2,150", "--mass-kg", 2.5, "--cog-mm", "0,0,60")
    assert "[2.500,[0.000,0.000,60.000]" in answer(*words, "--format", "abb")["text"]
    assert "for --format abb" in answer(*words, "--format", "ur", status=2)["error"]["message"]
    assert "go together" in answer(*words[:6], "--format", "abb", status=2)["error"]["message"]
    assert "give the tool" in answer(*words[:2], "--format", "ur", status=2)["error"]["message"]
