"""A run against the healthy tool's: what is no bend ends it, with its own code. Simulated."""

from dataclasses import replace

import pytest
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.tool.session import ToolSession

RADIUS_M = 2.5e-3
SECOND_NS = 1_000_000_000


@pytest.fixture
def driver(tmp_path):
    """The healthy tool was measured."""
    cell = noisy_cell()
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        made = Driver(
            ToolSession(cell.arm, history, config_of(cell), "test"),
            cell,
            RoundTool.cylinder(TAUGHT, RADIUS_M),
        )
        assert made.measure("reference").done
        yield made


def edited(driver, edit):
    """Change the samples that are given from now on."""
    play = driver.play
    driver.play = lambda samples: play(edit(samples))


def dirty_x(driver):
    x, y = driver.cell.station.beams
    x = replace(x, dark_at=x.dark_at / 0.6, light_at=x.light_at / 0.6)
    driver.cell.station = replace(driver.cell.station, beams=(x, y))


def thicker(driver):
    driver.program.tool = RoundTool.cylinder(TAUGHT, RADIUS_M + 5e-4)


def late_input(driver):
    station = driver.cell.station
    later = replace(station.input, latency_s=station.input.latency_s + 0.02)
    driver.cell.station = replace(station, input=later)


def joints_ahead(driver):
    def edit(samples):
        return [
            replace(s, stamp_ns=s.stamp_ns + SECOND_NS) if isinstance(s, JointSample) else s
            for s in samples
        ]

    edited(driver, edit)


def every_fifth_lost(driver):
    def edit(samples):
        return [s for i, s in enumerate(samples) if not (isinstance(s, JointSample) and i % 5 == 0)]

    edited(driver, edit)


FAULTS = [
    (dirty_x, Code.BEAM_EDGES_WRONG, "beam x is dirty"),
    (thicker, Code.WRONG_TOOL, "another tool is mounted"),
    (late_input, Code.CLOCK_WRONG, "behind the joint readings"),
    (joints_ahead, Code.CLOCK_WRONG, "behind the joint states"),
    (every_fifth_lost, Code.TOO_FEW_SAMPLES, "of the joint readings are missing"),
]


@pytest.mark.parametrize(
    ("mode", "fault", "code", "words"),
    [("quick", *fault) for fault in FAULTS] + [("full", *fault) for fault in FAULTS[:2]],
)
def test_a_fault_ends_the_run_with_its_code(driver, mode, fault, code, words):
    fault(driver)
    said = driver.measure(mode)
    assert said.status is code, said.message
    assert words in said.message
    assert said.document is None
    assert driver.session.run is None


def test_a_bent_tool_is_no_fault(driver):
    driver.program.tool = RoundTool.cylinder(TRUTH, RADIUS_M)
    assert driver.measure("quick").document["answer"] == "recalibrate"
    assert driver.measure().done


def test_a_new_reference_ends_it(driver):
    thicker(driver)
    assert driver.measure("quick").status is Code.WRONG_TOOL
    assert driver.measure("reference").done
    assert driver.measure("quick").document["answer"] == "pass"
