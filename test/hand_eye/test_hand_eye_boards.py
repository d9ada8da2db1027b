"""Target files of a camera's board: read, and refused by name."""

from pathlib import Path

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.targets import read_target, target_document

BOARD = "kind: board\ncolumns: 9\nrows: 6\nsquare_mm: 25.5\n"
CAMERA = """\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [603.4, 0, 319.2, 0, 603.7, 234.9, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.035, 0.98, 0.004, 0.002, -3.8]}
"""


def written(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(CAMERA)
    path = folder / "board.yaml"
    path.write_text(text)
    return path


def test_a_board_is_read(tmp_path):
    found = read_target(written(tmp_path, BOARD))
    assert (found.columns, found.rows) == (9, 6)
    assert found.square_m == pytest.approx(0.0255, abs=1e-15)
    assert found.intrinsics is None


def test_the_intrinsics_lie_beside_the_board(tmp_path, monkeypatch):
    path = written(tmp_path, BOARD + "intrinsics: camera.yaml\n")
    monkeypatch.chdir("/")
    camera = read_target(path).intrinsics
    assert camera.size == (640, 480)
    assert np.array_equal(camera.matrix, [[603.4, 0, 319.2], [0, 603.7, 234.9], [0, 0, 1]])
    assert np.array_equal(camera.distortion, [0.035, 0.98, 0.004, 0.002, -3.8])
    assert camera.covariance is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("columns: 9\n", "", "columns is missing"),
        ("columns: 9", "columns: 2", "whole number from 3 to 100"),
        ("rows: 6", "rows: 6.5", "whole number from 3 to 100"),
        ("square_mm: 25.5", "square_mm: 0", "must be above 0"),
        ("square_mm: 25.5", "square_m: 0.0255", "not a known key"),
        ("rows: 6", "rows: 6\nintrinsics: none.yaml", "none.yaml"),
        ("rows: 6", "rows: 6\nintrinsics: 3", "must be a text"),
    ],
)
def test_a_wrong_board_names_its_key(tmp_path, old, new, words):
    with pytest.raises(InputError, match=words):
        read_target(written(tmp_path, BOARD.replace(old, new)))


def test_a_board_is_the_target_of_a_camera_alone(tmp_path):
    target = read_target(written(tmp_path, BOARD))
    assert target_document("camera", target)["kind"] == "camera"
    with pytest.raises(InputError, match="describes a camera, not a sphere"):
        target_document("sphere", target)
