# SPDX-License-Identifier: Apache-2.0
"""A fixture's file, and tables of its points: taught, and once it or the sensor has moved."""

from pathlib import Path

import yaml

from bench.measured_fixture import ARM, PLATE, MeasuredFixture
from robocal_ros.fixture.features import FixturePoints
from robocal_ros.fixture.files import fixture_document
from robocal_ros.kinematics.tables import joint_texts, write_cells

MOVED_M = 6e-4


def fixture_tables(folder: Path) -> None:
    cell = MeasuredFixture(4)
    (folder / "plate.yaml").write_text(yaml.safe_dump(fixture_document(PLATE)))
    _table(folder / "fixture_taught.csv", cell.points(cell.faults(), 3, 1))
    _table(folder / "fixture_now.csv", cell.points(cell.faults("fixture_moved", MOVED_M), 2, 2))
    _table(folder / "fixture_knocked.csv", cell.points(cell.faults("sensor_knocked", 1e-3), 2, 2))


def _table(path: Path, points: FixturePoints) -> None:
    at = {
        f"{axis}_mm": [repr(x) for x in (1e3 * points.p[:, i]).tolist()]
        for i, axis in enumerate("xyz")
    }
    write_cells(path, at | joint_texts(points.q, ARM))
