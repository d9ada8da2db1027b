# SPDX-License-Identifier: Apache-2.0
"""``robocal hand-eye camera`` from tables and images, and the real measurements' figures."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_tables import CELL, INTRINSICS, OFFSET_S, camera_tables, image_tables, stream_tables
from command import conforms
from scipy.spatial.transform import Rotation

from bench import hand_eye_sets
from bench.hand_eye_cell import TruePose
from bench.hand_eye_joints import NARROW_RAD, camera_cell, camera_pairs, ur10
from robocal_ros.cli.main import main
from robocal_ros.hand_eye.camera import distances
from robocal_ros.hand_eye.camera_data import CLOSED_FORMS
from robocal_ros.hand_eye.camera_fit import fit_pairs
from robocal_ros.hand_eye.files import write_pose_table
from robocal_ros.hand_eye.published import tmac_pairs
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import joint_texts, write_cells

TRUTH_MM = CELL.camera.t[0] * 1e3
FILES = (".csv", ".yaml")
BOARD = ("--board", "9x6", "--square-mm", "25")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("camera")
    camera_tables(folder)
    stream_tables(folder)
    image_tables(folder)
    return folder


@pytest.fixture
def robocal(folder: Path, capsys: pytest.CaptureFixture[str]):
    def run(*arguments: object, status: int = 0) -> dict[str, Any]:
        capsys.readouterr()
        words = [
            str(folder / word) if Path(str(word)).suffix in FILES or word == "images" else str(word)
            for word in arguments
        ]
        assert main(["hand-eye", "camera", *words, "--json"]) == status
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        conforms(document, "hand-eye.camera.json")
        return document

    return run


def near(document: dict[str, Any], key: str = "T_flange_sensor") -> bool:
    """Whether the camera is where it is, within four of its own sigmas."""
    away = np.abs(np.array(document[key]["xyz_mm"]) - TRUTH_MM)
    return bool(np.all(away < 4.0 * np.array(document["sigma"]["xyz_mm"])))


def test_board_poses_give_the_camera(robocal) -> None:
    pairs = ("--poses", "camera_poses.csv", "--measured", "board_poses.csv")
    document = robocal(*pairs, "--check", "camera_check.csv")
    assert document["verdict"]["accept"]
    assert near(document)
    assert document["held_out"]["n"] == 6
    # 0.39 mm by the noise of both sides and its lever, 0.2 mm by the camera's own place: doubled
    assert document["held_out"]["mean_mm"] < 1.0
    assert set(document["rejected_because"]) == set()
    assert len(document["residual_mm"]["per_sample"]) == 14
    alone = robocal(*pairs)
    assert alone["T_flange_sensor"] == document["T_flange_sensor"]
    assert alone["rejected_because"]["s14"].startswith("not in ")
    known = robocal(*pairs, "--robot-sigma-mm", "0.1", "--robot-sigma-deg", "0.0115")
    assert known["noise"]["robot_turn_deg"] == pytest.approx(0.0115)
    assert near(known)


def test_joints_that_err_are_said_where_the_joints_are_known(robocal, tmp_path) -> None:
    rng = np.random.default_rng(4)
    pairs = camera_pairs(camera_cell("in-hand"), ur10(rng), NARROW_RAD, rng)
    arm, q = pairs.joints.arm, pairs.joints.q
    poses, boards = tmp_path / "poses.csv", tmp_path / "boards.csv"
    write_pose_table(poses, pairs.T_base_flange, names=pairs.names, joints=(arm, q))
    write_pose_table(boards, pairs.T_camera_board, names=pairs.names)
    given = ("--poses", poses, "--measured", boards)
    found = robocal(*given, "--robot", "ur10")
    factor = found["joint_errors"]["factor"]
    assert factor > 1.15
    assert found["verdict"]["reason"].endswith(f"to the mount's sigma: count {factor:.1f} of it")
    silent = robocal(*given, "--robot", "ur10", "--joint-error-urad", 0)
    assert silent["joint_errors"] is None
    assert silent["covariance"] == found["covariance"]
    assert robocal(*given)["joint_errors"] is None  # poses alone
    refused = robocal(*given, "--joint-error-urad", 50, status=2)
    assert "needs the joints of each pose" in refused["error"]["message"]
    streams = ("--poses", "stream_poses.csv", "--measured", "stream_boards.csv")
    assert robocal(*streams)["joint_errors"] is None


def test_every_start_gives_the_same_camera(robocal) -> None:
    pairs = ("--poses", "camera_poses.csv", "--measured", "board_poses.csv", "--method")
    best = robocal(*pairs, "best")
    for name in CLOSED_FORMS:
        other = robocal(*pairs, name)
        assert other["start"] == name
        away = np.subtract(other["T_flange_sensor"]["xyz_mm"], best["T_flange_sensor"]["xyz_mm"])
        assert np.all(np.abs(away) < 0.02 * np.array(best["sigma"]["xyz_mm"]))
    classic = robocal(*pairs, "classic")
    assert classic["sigma"] is None
    # five sigmas of 0.25 mm an axis, and half as much again for solving without the sample
    assert 0.0 < classic["leave_one_out_mm"]["mean"] < classic["leave_one_out_mm"]["max"] < 2.0
    assert classic["start"] in CLOSED_FORMS


def test_joints_are_enough_where_the_robot_is_known(robocal, folder: Path) -> None:
    arm = load_robot("ur10")
    rng = np.random.default_rng(4)
    q = np.radians([0.0, -80.0, 90.0, -100.0, -90.0, 0.0]) + rng.uniform(-0.4, 0.4, (15, 6))
    T = arm.fk(q)
    flange = TruePose(Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3])
    names = [f"j{i}" for i in range(15)]
    columns = {"sample": names} | joint_texts(q, arm)
    write_cells(folder / "joints.csv", columns)
    write_pose_table(
        folder / "joint_boards.csv", CELL.read_board(CELL.seen_from(flange), rng), names=names
    )
    pairs = ("--poses", "joints.csv", "--measured", "joint_boards.csv")
    assert near(robocal(*pairs, "--robot", "ur10"))
    assert "name the robot" in robocal(*pairs, status=2)["error"]["message"]


def test_streams_tell_the_offset(robocal) -> None:
    document = robocal("--poses", "stream_poses.csv", "--measured", "stream_boards.csv")
    assert document["time_offset_s"] == pytest.approx(
        OFFSET_S, abs=4.0 * document["time_offset_sigma_s"]
    )
    assert near(document)


def test_images_give_the_camera(robocal) -> None:
    images = ("--poses", "image_poses.csv", "--images", "images", *BOARD)
    document = robocal(*images)
    assert near(document)
    assert "no board" in document["rejected_because"]["shot3.png"]
    assert document["intrinsics"]["from_images"]
    assert document["intrinsics"]["fx_px"] == pytest.approx(610.0, rel=5e-3)
    split = ("--poses", "image_used.csv", *images[2:], "--check", "image_check.csv")
    given = robocal(*split, "--intrinsics", "camera.yaml")
    assert not given["intrinsics"]["from_images"]
    assert given["intrinsics"]["sigma"] is None
    assert near(given)
    assert len(given["residual_mm"]["per_sample"]) == 5  # of the six one is blank
    assert given["held_out"]["n"] == 3
    assert given["held_out"]["rejected"] == []


@pytest.mark.parametrize(
    ("given", "row", "words"),
    [
        (
            ("--poses", "image_poses.csv", "--images", "images", *BOARD,
             "--check", "image_check.csv"), 2, "'shot6.png' is in --poses too",
        ),
        (
            ("--poses", "camera_poses.csv", "--measured", "board_poses.csv",
             "--check", "camera_poses.csv"), 2, "'s0' is in --poses too",
        ),
        (
            ("--poses", "stream_poses.csv", "--measured", "stream_boards.csv",
             "--check", "stream_poses.csv"), None, "other times must judge",
        ),
    ],
    ids=["images", "poses", "streams"],
)  # fmt: skip
def test_what_was_used_does_not_judge(robocal, given, row: int | None, words: str) -> None:
    error = robocal(*given, status=2)["error"]
    assert words in error["message"]
    assert error.get("row") == row


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--measured", "board_poses.csv", "--square-mm", 25], 2, "--square-mm belongs to images"),
        (["--images", "images", "--board", "9x6"], 2, "--square-mm"),
        (["--board", "nine"], 2, "columns and rows such as 9x6"),
        (["--measured", "stream_boards.csv"], 2, "has no sample of"),
        (["--measured", "nowhere.csv"], 2, "no such table"),
        (["--images", "images", *BOARD], 2, "column image is missing"),
        (["--measured", "board_poses.csv", "--mount", "to-hand"], 2, "mounted in-hand"),
        (["--measured", "board_poses.csv", "--check", "stream_poses.csv"], 2, "column sample"),
    ],
)
def test_what_a_user_can_mend_is_said(robocal, arguments, status: int, words: str) -> None:
    document = robocal("--poses", "camera_poses.csv", *arguments, status=status)
    assert words in document["error"]["message"]


def test_tables_of_different_length_are_refused(robocal, folder: Path) -> None:
    for name, count in (("long", 12), ("short", 11)):
        lines = (folder / "stream_poses.csv").read_text().splitlines()[: count + 1]
        rows = [line.split(",", 1)[1] for line in lines]  # without the stamp
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    document = robocal("--poses", "long.csv", "--measured", "short.csv", status=2)
    assert "has 11 rows" in document["error"]["message"]


def test_a_blank_line_in_a_table_shifts_no_pairs(robocal, folder: Path) -> None:
    tables = {"plain": "camera_poses", "boards": "board_poses"}
    for name, of in tables.items():
        lines = (folder / f"{of}.csv").read_text().splitlines()[: 14 + 1]
        rows = [line.split(",", 1)[1] for line in lines]  # without the sample
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
        rows.insert(8, "")
        (folder / f"{name}_parted.csv").write_text("\n".join(rows) + "\n")
    plain = robocal("--poses", "plain.csv", "--measured", "boards.csv")
    assert len(plain["residual_mm"]["per_sample"]) == 14
    for robot, camera in (("plain", "boards_parted"), ("plain_parted", "boards")):
        found = robocal("--poses", f"{robot}.csv", "--measured", f"{camera}.csv")
        assert found["covariance"] == plain["covariance"]
        assert found["rejected"] == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("plumb_bob", "fov", "distortion_model is 'fov'"),
        ("image_width", "width", "'width' is not a known key"),
        ("image_width: 640\n", "", "image_width is missing"),
        ("640", "640.7", "image_width is 640.7; it must be a whole number"),
        ("640", "0", "image_width is 0; it must be a whole number"),
        ("0.0, 1.0]", "0.0, 2.0]", "must be fx 0 cx"),
        ("640", "320", "images show the board"),
        ("cols: 5, data: [", "cols: 5, data: [1, ", "list of 5 numbers"),
    ],
)
def test_wrong_intrinsics_are_named(robocal, folder: Path, old: str, new: str, words: str) -> None:
    (folder / "wrong.yaml").write_text(INTRINSICS.replace(old, new))
    images = ("--poses", "image_poses.csv", "--images", "images", *BOARD)
    document = robocal(*images, "--intrinsics", "wrong.yaml", status=3 if new == "320" else 2)
    assert words in document["error"]["message"]


def test_an_image_that_is_none_is_left_out(robocal, folder: Path) -> None:
    place = folder / "images" / "shot0.png"
    kept = place.read_bytes()
    place.write_bytes(b"not an image")
    try:
        document = robocal("--poses", "image_poses.csv", "--images", "images", *BOARD)
    finally:
        place.write_bytes(kept)
    assert "no image" in document["rejected_because"]["shot0.png"]


def test_where_none_can_be_read_it_is_said_why_no_image_shows_the_board(
    robocal, folder: Path, tmp_path: Path
) -> None:
    for image in (folder / "images").iterdir():
        (tmp_path / image.name).write_bytes(b"not an image")
    document = robocal("--poses", "image_poses.csv", "--images", tmp_path, *BOARD, status=3)
    words = document["error"]["message"]
    assert words.startswith("0 images show the board (at least 5 are needed")
    assert words.endswith("is no image that can be read")
    for image in sorted((folder / "images").iterdir())[1:]:
        (tmp_path / image.name).write_bytes(image.read_bytes())
    other = ("--board", "8x5", "--square-mm", "25")
    document = robocal("--poses", "image_poses.csv", "--images", tmp_path, *other, status=3)
    assert "no board of 8x5" in document["error"]["message"]  # what hides it in all others


def test_people_read_it_too(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = [str(folder / name) for name in ("stream_poses.csv", "stream_boards.csv")]
    assert main(["hand-eye", "camera", "--poses", tables[0], "--measured", tables[1]]) == 0
    text = capsys.readouterr().out
    assert text.startswith("ACCEPT: ")
    assert "Camera in the flange frame, mm: " in text
    assert "Time offset" in text
    assert "Expected error where the boards were: " in text
    assert "daniilidis" in text


@pytest.fixture(scope="module")
def tables(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("real")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROBOCAL_DATA", str(data_dir))
        for name, *parts in (("ur10_tmac", "--part", "B", "D"), ("camera_hand_eye",),
                             ("eth_hand_eye",)):  # fmt: skip
            assert main(["data", name, "--out", str(out / name), *parts]) == 0
    return out


def mean(document: dict[str, Any]) -> float:
    values = document["residual_mm"]["per_sample"].values()
    return sum(values) / len(values)


@pytest.mark.data
@pytest.mark.parametrize("method", ["best", *CLOSED_FORMS])
@pytest.mark.parametrize(("series", "limit_mm"), hand_eye_sets.TMAC_MM.items())
def test_a_tracked_target_from_every_start(
    tables: Path, robocal, series: str, limit_mm: float, method: str
) -> None:
    document = robocal(
        "--poses", tables / f"ur10_tmac/{series}_flange.csv",
        "--measured", tables / f"ur10_tmac/{series}_tmac.csv",
        "--mount", "to-hand", "--method", method,
    )  # fmt: skip
    assert document["rejected"] == []
    assert mean(document) <= limit_mm
    assert document["verdict"]["accept"]


@pytest.mark.data
@pytest.mark.parametrize(("series", "limit_mm"), hand_eye_sets.TMAC_MM.items())
def test_a_start_that_failed_does_not_matter(data_dir: Path, series: str, limit_mm: float) -> None:
    """Tsai's method on series B, with X and Z exchanged, is off by 2.9 mm."""
    pairs = tmac_pairs(series, data_dir / "ur10_tmac")
    start = hand_eye_sets.turned_tsai(pairs)
    assert start is not None
    if series == "B":
        assert distances(pairs, start).mean() > 2.5e-3
    fit = fit_pairs(pairs, None, start)
    assert np.linalg.norm(fit.differences[:, :3], axis=1).mean() * 1e3 <= limit_mm
    assert not np.any(fit.rejected)


@pytest.mark.data
def test_real_images_fit_better_than_any_closed_form(tables: Path, data_dir: Path, robocal) -> None:
    images = (
        "--poses",
        tables / "camera_hand_eye/poses.csv",
        "--images",
        data_dir / "camera_hand_eye",
    )
    document = robocal(*images, *BOARD)
    assert len(document["rejected"]) <= 1
    assert document["residual_mm"]["rms"] <= hand_eye_sets.BOARD_RMS_MM
    forms = document["closed_forms_mean_mm"].values()  # of the same samples
    assert mean(document) <= min(value for value in forms if value is not None)
    assert document["intrinsics"]["noise_px"] < 0.2


@pytest.mark.data
def test_real_streams_and_their_offset(tables: Path, robocal) -> None:
    folder = tables / "eth_hand_eye"
    document = robocal("--poses", folder / "arm.csv", "--measured", folder / "board.csv")
    assert document["residual_mm"]["rms"] <= hand_eye_sets.ARM_RMS_MM
    assert abs(document["time_offset_s"]) < 0.04  # one image
    assert len(document["rejected"]) < 0.05 * 1703
