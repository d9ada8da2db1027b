# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the place of the real measurements, and which tests can run here."""

import gc
import importlib.util
import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

gc.disable()  # until all tests are read: nothing of them is garbage
ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "test" / "worlds"))  # what tests share: cells, robots, recordings
from long_form import LONG  # noqa: E402
from measured_cell import cell, known_set_up, make_cell_fixture  # noqa: E402, F401
from shift import arm, nominal  # noqa: E402, F401

from robocal_ros.history.calibrations import CalibrationHistory  # noqa: E402

# Cores are shared with other tests: how long an example takes tells nothing of it. Each run draws
# other examples, so that runs together try far more of them than one does.
settings.register_profile(
    "shared", max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("shared")

# Without rclpy (make test-floor) what needs a node cannot even be imported.
NEED_ROS = [
    "nodes",
    "correction/test_stops_on_controllers.py",
    "hand_eye/test_boards.py",  # and OpenCV 4.7 for ChArUco boards
]
collect_ignore = [] if importlib.util.find_spec("rclpy") else NEED_ROS


def find_data() -> Path:
    """Folder of the real measurements, whether it is there or not."""
    return Path(os.environ.get("ROBOCAL_DATA", ROOT.parent / "shared" / "data"))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """A file in which pytest finds no test is a mistake, and would pass unseen."""
    report = yield
    if isinstance(collector, pytest.Module) and report.passed and not report.result:
        report.outcome = "failed"
        report.longrepr = f"{collector.path}: no test in this file"
    return report


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not LONG:
        left_out = [item for item in items if item.get_closest_marker("long")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("long")]
    folder = find_data()
    if folder.is_dir():
        return
    absent = pytest.mark.skip(reason=f"no real measurements at {folder} (set ROBOCAL_DATA)")
    for item in items:
        if item.get_closest_marker("data"):
            item.add_marker(absent)


def pytest_collection_finish() -> None:
    """Each look for garbage, those of node tests too, is at what the tests made alone."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real measurements; the test must be marked ``data``."""
    return find_data()


@pytest.fixture
def history(tmp_path: Path) -> Iterator[CalibrationHistory]:
    """An empty history of a robot."""
    with CalibrationHistory.open("K1", state_dir=tmp_path) as opened:
        yield opened


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 2 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    found = subprocess.run(mount, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip(f"this user may mount nothing: {found.stderr.strip()}")
    try:
        yield disk
    finally:
        # lazily: what a test leaves open ends after this
        subprocess.run(["umount", "-l", str(disk)], check=True)
