# SPDX-License-Identifier: Apache-2.0
"""``robocal hand-eye`` in this process, and its answer beside the truth."""

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from command import conforms
from hand_eye_tables import TRUE

from robocal_ros.cli.main import main
from robocal_ros.ground import frames


def robocal(action: str, *words: object, status: int = 0) -> Any:
    """Run a command in this process: its document follows the schema."""
    with redirect_stdout(StringIO()) as printed:
        found = main(["hand-eye", action, *map(str, words), "--json"])
    document = json.loads(printed.getvalue())
    assert found == status, document
    conforms(document, f"hand-eye.{action}.json")
    return document


HEIGHTS = ["--z-grows", "towards"]  # as the simulated sensor tells its profiles
RANGE = ["--near-mm", 10, "--far-mm", -10]  # the same of a plan


def shots(folder: Path, table: str = "poses") -> list[object]:
    return ["--poses", folder / f"{table}.csv", "--profiles", folder / "profiles", *HEIGHTS]


def target(folder: Path) -> list[object]:
    return ["--target", folder / "target.yaml"]


def pose_of(document: Any, key: str = "T_flange_sensor") -> np.ndarray:
    pose = document[key]
    return frames.transform_from_quat(1e-3 * np.array(pose["xyz_mm"]), np.array(pose["quat_xyzw"]))


def chi_square(document: Any) -> float:
    """Distance from the truth in units of the covariance that the document tells."""
    T = pose_of(document)
    turn = frames.log_rotation(TRUE[:3, :3] @ T[:3, :3].T)
    error = np.concatenate([TRUE[:3, 3] - T[:3, 3], turn])
    return float(error @ np.linalg.solve(np.array(document["covariance"]), error))
