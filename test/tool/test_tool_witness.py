# SPDX-License-Identifier: Apache-2.0
"""Bent tool or knocked station? Wrong as often as is said, and never by more than is said."""

import re
from dataclasses import replace

import numpy as np
import pytest
from long_form import amount, more
from tool_driver import TAUGHT, Driver, config_of, noisy_cell

from robocal_ros.cell_sim.beams import BeamStation, RoundTool, bent
from robocal_ros.cell_sim.faults import Fault, Faults, size_of
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import HEALTHY_TOOL, TOOL, CalibrationState
from robocal_ros.session.events import MEASURE_TOOL, Command, Outcome
from robocal_ros.tool.judging import SMALL_M, BendRule, Witness, bend_or_station
from robocal_ros.tool.run import rows_of
from robocal_ros.tool.session import ToolSession

RULE = BendRule(nearest_m=0.055, farthest_m=0.15)
TIP_M, TILT_RAD = 3.5e-5, np.radians(0.06)  # scatter in each direction of the change of two runs
COVARIANCE = np.diag(np.square([TIP_M, TIP_M, TIP_M, TILT_RAD, TILT_RAD]))
TRIALS = amount(1000, 4000)


def directions(rng: np.random.Generator, dimensions: int) -> np.ndarray:
    drawn = rng.standard_normal((TRIALS, dimensions))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1)[:, None])


def told(changes: np.ndarray, seed: int) -> list[Witness]:
    noise = np.random.default_rng(seed).standard_normal(changes.shape) @ np.sqrt(COVARIANCE)
    return [
        bend_or_station(change, COVARIANCE, RULE, float(np.linalg.norm(change[:3])))
        for change in changes + noise
    ]


@pytest.mark.parametrize("shift_mm", [0.2, 0.5, 1.2, *more(0.1, 0.3, 0.8, 2.0)])
def test_what_a_knocked_station_shows_is_not_accepted_as_a_bend(shift_mm):
    """In all directions; what is accepted as too small to matter is no larger than is said."""
    rng = np.random.default_rng(1)
    changes = np.hstack([1e-3 * shift_mm * directions(rng, 3), np.zeros((TRIALS, 2))])
    accepted = [one.tip_m for one in told(changes, 2) if one.cause == "tool"]
    beyond = sum(tip_m > SMALL_M for tip_m in accepted)
    allowed = 1e-3 * TRIALS
    assert beyond <= allowed + 3.0 * np.sqrt(allowed)


@pytest.mark.parametrize("shift_mm", [0.1, 0.3, 0.8, *more(0.05, 0.2, 0.5, 2.0)])
@pytest.mark.parametrize("lever_m", [0.055, 0.15, *more(0.1)])
def test_a_true_bend_is_rarely_the_stations(shift_mm, lever_m):
    way = directions(np.random.default_rng(3), 2)
    sideways = 1e-3 * shift_mm * way
    changes = np.hstack([sideways, np.zeros((TRIALS, 1)), sideways / lever_m])
    causes = [one.cause for one in told(changes, 4)]
    assert causes.count("station") <= 0.01 * TRIALS + 3.0 * np.sqrt(0.01 * TRIALS)
    if shift_mm >= 0.8:
        assert causes.count("tool") >= 0.9 * TRIALS  # that some of them wait is the price


def test_a_large_knock_sideways_is_the_stations():
    way = directions(np.random.default_rng(5), 2)
    changes = np.hstack([1.2e-3 * way, np.zeros((TRIALS, 3))])
    assert [one.cause for one in told(changes, 6)].count("station") >= 0.99 * TRIALS


@pytest.mark.parametrize(
    ("change_mm", "tilt_mrad", "cause"),
    [
        ([0.08, 0.0, 0.0], [0.0, 0.0], "tool"),  # too small to matter
        ([0.0, 0.0, 0.8], [0.0, 0.0], "doubt"),  # along the axis: pushed in, or a lower station
        ([0.8, 0.0, 0.0], [8.0, 0.0], "tool"),
        ([0.8, 0.0, 0.0], [-8.0, 0.0], "station"),  # tilted the other way
        ([0.8, 0.0, 0.0], [0.0, 8.0], "station"),
        ([0.8, 0.0, 0.9], [8.0, 0.0], "doubt"),
        ([0.3, 0.0, 0.0], [2.0, 0.0], "doubt"),
    ],
)
def test_what_each_change_says(change_mm, tilt_mrad, cause):
    change = np.append(1e-3 * np.array(change_mm), 1e-3 * np.array(tilt_mrad))
    small_m = float(np.linalg.norm(change[:3]))
    found = bend_or_station(change, COVARIANCE, RULE, small_m)
    assert found.cause == cause, found.reason


def test_small_changes_do_not_add_up():
    change = np.array([8e-5, 0.0, 0.0, 0.0, 0.0])
    assert bend_or_station(change, COVARIANCE, RULE, 8e-5).cause == "tool"
    assert bend_or_station(change, COVARIANCE, RULE, 1.6e-4).cause == "doubt"


def test_a_lever_below_the_upper_circle_is_refused():
    with pytest.raises(InputError, match="cannot bend between 55 and 30 mm"):
        BendRule(0.055, 0.03)


HARM_M = 1e-4  # more than this nobody may take for the tool's who has not proven it
RADIUS_M = 2.5e-3


def knocked(station: BeamStation, fault: Fault, size: float, seed: int) -> BeamStation:
    return Faults({fault: size_of(fault, size)}, seed).station(station)


def taken(driver: Driver) -> float:
    """How far the tip would move if all were accepted that no person must look at, m."""
    document = driver.outcomes[-1].document
    proven = driver.outcomes[-1].done and document["witness"]["cause"] == "tool"
    return 1e-3 * document["change"]["tip_mm"] if proven else 0.0


@pytest.mark.parametrize(
    ("fault", "size", "seed"),  # which draws the direction
    [
        ("station_knocked_shift", 0.8, 0),
        ("station_knocked", 0.3, 0),
        ("station_knocked_turn", 1.0, 0),
        *more(
            ("station_knocked_shift", 0.8, 1),
            ("station_knocked", 0.3, 2),
            ("station_knocked", 2.0, 1),
            ("station_knocked", 2.0, 2),
        ),
    ],
)
def test_a_knocked_station_is_never_taken_for_the_tool(driver, fault, size, seed):
    driver.cell.station = knocked(driver.cell.station, fault, size, seed)
    found = driver.measure("full")
    assert found.document is not None, found.message
    assert taken(driver) <= HARM_M, found.message


def test_a_station_that_was_knocked_sideways_is_named(driver):
    station = driver.cell.station
    side = 1.2e-3 * driver.cell.laser.T_base_laser[:3, 0]
    x, y = (replace(b, start=b.start + side, end=b.end + side) for b in station.beams)
    driver.cell.station = replace(station, beams=(x, y))
    found = driver.measure("full")
    assert found.status is Code.STATION_MOVED
    assert "the beam station was knocked, or the tool slipped in its mount" in found.message
    assert driver.history.get(found.calibration_id).state is not CalibrationState.PENDING
    assert not driver.history.pending(TOOL, 1)


def test_a_station_that_turns_about_its_crossing_changes_nothing(driver):
    """Tip and axis follow from where the flange stands when the tool is on the crossing."""
    driver.cell.station = knocked(driver.cell.station, "station_knocked_turn", 1.0, 1)
    found = driver.measure("full")
    assert found.document["change"]["tip_mm"] < 0.15
    assert found.document["change"]["axis_deg"] < 0.3


@pytest.mark.parametrize("size_m", [1e-3, 2e-3])
def test_a_bent_tool_is_proven_by_its_tilt(driver, size_m):
    shift = size_m * np.array([0.6, -0.7, 0.1])
    tilt = np.array([-shift[1], shift[0], 0.0]) / 0.12
    driver.program.tool = RoundTool.cylinder(bent(TAUGHT, shift, tilt), RADIUS_M)
    found = driver.measure("full")
    assert found.done, found.message
    assert found.document["witness"]["cause"] == "tool", found.message


@pytest.mark.parametrize("seed", [1, *more(2, 3)])
def test_a_station_that_was_knocked_hard_has_turned_and_says_so(driver, seed):
    """Finding: what the turn left unexplained made the axis look unknown, and the doubt stayed.

    A knock turns the station about any axis; about the laser's z the beams show it.
    """
    laser, faults = driver.cell.laser, Faults({"station_knocked": 2e-3}, seed)
    R = faults.T_station_knock(laser.T_base_laser[:3, 3])[:3, :3]
    turned_deg = np.degrees(frames.log_rotation(R) @ laser.T_base_laser[:3, 2])
    driver.cell.station = faults.station(driver.cell.station)
    found = driver.measure("full")
    told = re.search(r"turned by (\S+) deg \(sigma (\S+)\)", found.message)
    if abs(turned_deg) > 0.2:
        assert found.status is Code.STATION_MOVED
        assert told is not None
        # by its sigma, to the digits that are told
        assert abs(float(told[1]) - turned_deg) < 4.0 * float(told[2]) + 0.02
    assert taken(driver) <= HARM_M, found.message


@pytest.mark.parametrize("turn_deg", [1.0, *more(0.1, 0.3)])
def test_a_station_that_has_always_stood_turned_is_not_knocked(tmp_path, turn_deg):
    """Beams that were placed wrongly: for the healthy tool they lie as they do for the bent one."""
    cell = noisy_cell()
    config = config_of(cell)
    faults = Faults({"station_knocked_turn": np.radians(turn_deg)}, 2)
    cell.station = faults.station(cell.station)
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        session = ToolSession(cell.arm, history, config, "test")
        driver = Driver(session, cell, RoundTool.cylinder(TAUGHT, RADIUS_M))
        assert driver.measure("reference").done
        hit = bent(TAUGHT, [1e-3, 0.0, 0.0], [0.0, 1e-2, 0.0])
        driver.program.tool = RoundTool.cylinder(hit, RADIUS_M)
        found = driver.measure("full")
        assert "turned" not in found.message
        assert found.document["witness"]["cause"] == "tool", found.message


MANDREL = bent(TAUGHT, [-0.02, 0.01, -0.03], [0.0, 0.0, 0.0])  # shorter, beside the tool


@pytest.fixture
def with_mandrel(tmp_path):
    """Healthy tool and mandrel were measured."""
    cell = noisy_cell()
    config = config_of(cell, mandrel=rows_of(MANDREL))
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        session = ToolSession(cell.arm, history, config, "test")
        made = Driver(session, cell, RoundTool.cylinder(TAUGHT, RADIUS_M))
        assert made.measure("reference").done
        assert of_mandrel(made, "witness reference").done
        yield made


def of_mandrel(driver: Driver, mode: str = "witness", mandrel: np.ndarray = MANDREL) -> Outcome:
    """Measure what the flange carries beside the tool."""
    tool, driver.program.tool = driver.program.tool, RoundTool.cylinder(mandrel, RADIUS_M)
    found = driver.measure(mode)
    driver.program.tool = tool
    return found


@pytest.mark.parametrize(("size", "seed"), [(0.8, 1), *more((0.3, 0), (2.0, 2))])
def test_a_mandrel_tells_how_far_the_station_was_knocked(with_mandrel, size, seed):
    driver = with_mandrel
    before = driver.cell.station.beams[0]
    driver.cell.station = knocked(driver.cell.station, "station_knocked_shift", size, seed)
    moved = driver.cell.station.beams[0].start - before.start
    found = of_mandrel(driver)
    assert found.status is Code.STATION_MOVED, found.message
    sigma_mm = np.array(found.document["sigma_mm"])
    off_mm = np.array(found.document["station_shift_mm"]) - 1e3 * moved
    assert np.all(np.abs(off_mm) < 4.0 * sigma_mm)
    tool = driver.measure("full")  # now also a knock that looks like no bend is named
    assert tool.status is Code.STATION_MOVED, tool.message
    assert "without it the tool's tip is" in tool.message


@pytest.mark.parametrize(("size", "seed"), [(0.3, 0), *more((0.8, 1), (0.8, 2))])
def test_a_mandrel_from_before_a_knock_says_nothing_of_it(with_mandrel, size, seed):
    driver = with_mandrel
    assert of_mandrel(driver).done
    driver.cell.station = knocked(driver.cell.station, "station_knocked_shift", size, seed)
    found = driver.measure("full")
    assert taken(driver) <= HARM_M, found.message
    if found.document["witness"]["cause"] == "doubt":
        assert "measure the mandrel (mode WITNESS), then repeat" in found.message
    repeated = driver.measure("full")  # without the mandrel
    assert taken(driver) <= HARM_M, repeated.message
    assert of_mandrel(driver).status is Code.STATION_MOVED
    assert driver.measure("full").status is Code.STATION_MOVED


def slip(driver: Driver, size_m: float) -> None:
    slipped = bent(TAUGHT, [size_m, 0.0, 0.3 * size_m], [0.0, 0.0, 0.0])
    driver.program.tool = RoundTool.cylinder(slipped, RADIUS_M)


@pytest.mark.parametrize("size_m", [3e-4, *more(2e-4)])
def test_beside_a_mandrel_that_stands_a_doubt_is_the_tools(with_mandrel, size_m):
    driver = with_mandrel
    slip(driver, size_m)
    assert driver.measure("full").document["witness"]["cause"] == "doubt"
    standing = of_mandrel(driver)
    assert standing.done, standing.message
    found = driver.measure("full")
    assert found.done
    assert found.document["witness"]["cause"] == "tool", found.message


def test_a_mandrel_does_not_lift_what_no_bend_shows(with_mandrel):
    driver = with_mandrel
    slip(driver, 1e-3)
    for _ in range(2):
        assert driver.measure("full").status is Code.STATION_MOVED
        assert of_mandrel(driver).done


@pytest.mark.parametrize("seed", [0, *more(1)])
def test_a_mandrel_says_nothing_of_a_second_change(with_mandrel, seed):
    driver = with_mandrel
    slip(driver, 3e-4)
    assert driver.measure("full").document["witness"]["cause"] == "doubt"
    assert of_mandrel(driver).done
    driver.cell.station = knocked(driver.cell.station, "station_knocked_shift", 0.3, seed)
    found = driver.measure("full")
    assert not (found.done and found.document["witness"]["cause"] == "tool"), found.message


def test_a_mandrel_younger_than_the_tool_says_nothing_of_the_time_between(tmp_path):
    """Its first run may have been beside a station that had moved already."""
    cell = noisy_cell()
    config = config_of(cell, mandrel=rows_of(MANDREL))
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        session = ToolSession(cell.arm, history, config, "test")
        driver = Driver(session, cell, RoundTool.cylinder(TAUGHT, RADIUS_M))
        assert driver.measure("reference").done
        driver.cell.station = knocked(driver.cell.station, "station_knocked_shift", 0.3, 1)
        driver.program.now_s += 7200.0
        assert of_mandrel(driver, "witness reference").done
        for _ in range(2):
            found = driver.measure("full")
            assert found.document["witness"]["cause"] == "doubt", found.message
            assert "measure the healthy tool anew (mode REFERENCE)" in found.message
            assert history.model(found.calibration_id)["mandrel_young"]
            assert of_mandrel(driver).done
        healthy = history.head(HEALTHY_TOOL)
        older = replace(healthy, model={k: v for k, v in healthy.model.items() if k != "stamp_ns"})
        assert session.current.stamped(older) == healthy.model  # of a version that did not tell
        assert driver.measure("reference").done  # the knock is in both now
        slip(driver, 1e-4)
        found = driver.measure("full")
        assert not history.model(found.calibration_id)["mandrel_young"]


def test_a_mandrel_that_tilted_is_no_witness(with_mandrel):
    hit = bent(MANDREL, [2e-3, 0.0, 0.0], [0.0, 0.015, 0.0])
    found = of_mandrel(with_mandrel, mandrel=hit)
    assert found.status is Code.WRONG_TOOL
    assert "it is loose or was hit" in found.message


def test_a_mandrel_must_be_known(driver):
    found = driver.command(Command(MEASURE_TOOL, {"mode": "witness"}))
    assert found.status is Code.CONFLICT
    assert "there is no mandrel" in found.message


def test_a_mandrel_is_measured_once_while_the_station_stands_right(tmp_path):
    cell = noisy_cell()
    config = config_of(cell, mandrel=rows_of(MANDREL))
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        made = Driver(ToolSession(cell.arm, history, config, "test"), cell, None)
        made.rest(0.1)
        found = made.command(Command(MEASURE_TOOL, {"mode": "witness"}))
    assert found.status is Code.CONFLICT
    assert "WITNESS_REFERENCE" in found.message
