# SPDX-License-Identifier: Apache-2.0
"""The laser frame from a mandrel's run: found with the scatter that is told; a knock is seen."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command import ROOT, beyond_rounding, robocal_json
from long_form import amount
from scipy.stats import chi2
from tool_driver import NOISE, Driver, config_of, noisy_cell

from bench.measured_runs import ToolCell, laser_of
from robocal_ros.cell_sim.beams import BeamStation, RoundTool, TrueBeam, joints_at, step_move
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import inverse
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody
from robocal_ros.tool.crossed_model import BeamStep, RobotNoise
from robocal_ros.tool.driving import approach, measuring
from robocal_ros.tool.laser_frame import JointPath, read_laser_for
from robocal_ros.tool.run import MeasuringPlan, WrongToolError, rows_of
from robocal_ros.tool.session import ToolSession
from robocal_ros.tool.station import (
    DAY_NS,
    NEVER,
    StationMeasurement,
    StationShift,
    StationTrend,
    measure_station,
    measurement_document,
    measurement_of,
    result_document,
    station_shift,
    station_verdict,
)

RADIUS_M = 2.5e-3
MANDREL = frames.transform(frames.exp_rotation([0.01, -0.02, 0.0]), [0.03, -0.02, 0.14])
ROBOT = RobotNoise(NOISE.step_m, NOISE.edge_m)
RUNS = amount(40, 200)


def knocked(cell: ToolCell, shift_m, turn_rad=(0.0, 0.0, 0.0)) -> ToolCell:
    """The station stands elsewhere; the robot does not know."""
    T = cell.laser.T_base_laser
    moved = T @ frames.transform(frames.exp_rotation(turn_rad), shift_m) @ frames.invert(T)

    def at(p: np.ndarray) -> np.ndarray:
        return moved[:3, :3] @ p + moved[:3, 3]

    beams = tuple(replace(b, start=at(b.start), end=at(b.end)) for b in cell.station.beams)
    return replace(cell, station=replace(cell.station, beams=beams))


def driven(
    cell: ToolCell, seed: int, tool: RoundTool | None = None, radius_m: float = RADIUS_M
) -> StationMeasurement:
    """All steps of a laser run, and what follows from them with a radius as it is told."""
    rng, tool = np.random.default_rng(seed), tool or RoundTool.cylinder(MANDREL, RADIUS_M)
    plan, now_s, q = MeasuringPlan("laser", cell.laser, MANDREL), 0.0, cell.q_near
    times, joints, steps = [], [], []
    for number in range(1, len(plan.names) + 1):
        step = plan.step(number)
        move = step_move(step, now_s, 0.02, 0.0)
        time = np.arange(move.span[0], move.span[1], 0.008)
        way = joints_at(cell.arm, move(time), q)
        edges = cell.station.edges(tool, move, move.window, rng)
        steps.append(BeamStep(step.name, step.kind, edges, step.beams))
        times.append(time)
        joints.append(way)
        now_s, q = float(time[-1]) + 1.0, way[-1]
    path = JointPath(cell.arm, np.concatenate(times), np.concatenate(joints))
    return measure_station(cell.laser, path, steps, MANDREL, radius_m, ROBOT)


def bends(cell: ToolCell, found: StationMeasurement) -> StationShift:
    """Against the truth, which has no scatter."""
    truth = StationMeasurement(laser_of(cell.station), np.zeros((8, 8)), 0.0)
    return station_shift(replace(truth, laser=replace(truth.laser, sigma_m=1e-9)), found)


def test_without_noise_the_beams_are_found_exactly():
    from beam_cell import make_cell

    cell = knocked(make_cell(), [3e-4, -5e-4, 4e-4], [2e-3, -1e-3, 3e-3])
    found = bends(cell, driven(cell, 1))
    # Half of the light of a beam of 0.8 mm, at an edge that is round: a tenth of a micrometre; the
    # end of the mandrel is round too and is met (0.6 mm)^2 / 2 r beside its axis.
    assert np.linalg.norm(found.shift[:2]) < 2e-6
    assert abs(found.shift[2]) < 1e-4


def by_interrupt(cell: ToolCell) -> ToolCell:
    """Its input stamps edges where they happen."""
    source = replace(cell.station.input, sample_period_s=0.0)
    return replace(cell, station=replace(cell.station, input=source))


@pytest.fixture(scope="module")
def many() -> list[StationShift]:
    cell = by_interrupt(noisy_cell())
    return [bends(cell, driven(cell, seed)) for seed in range(RUNS)]


def scatter_over_told(many: list[StationShift]) -> np.ndarray:
    """Mean square of each of the six over the variance that is told."""
    scatter = np.array([np.append(one.shift, one.turn) for one in many])
    told = np.mean([np.diag(one.covariance) for one in many], axis=0)
    return np.asarray(np.mean(scatter**2, axis=0) / told)


def test_the_sigma_told_is_the_scatter(many):
    """Over all runs, in each of the six ways: within what so many draws of chi-square allow."""
    ratio = scatter_over_told(many)
    low, high = chi2.ppf([0.0005, 0.9995], RUNS) / RUNS
    assert np.all((ratio > low) & (ratio < high)), ratio
    away = [np.append(one.shift, one.turn) for one in many]
    squared = [x @ np.linalg.solve(one.covariance, x) for x, one in zip(away, many, strict=True)]
    low, high = chi2.ppf([0.0005, 0.9995], 6 * RUNS) / RUNS
    assert low < np.mean(squared) < high


@pytest.mark.long
def test_a_polled_input_leaves_the_sigma_honest():
    """Edges half a turn apart may fall on one phase of the input: they are not independent then.

    Sigma within 0.8 to 1.25 of the scatter, give or take what the runs leave of that (3 sigma).
    """
    cell, runs = noisy_cell(), 60
    ratio = np.sqrt(scatter_over_told([bends(cell, driven(cell, seed)) for seed in range(runs)]))
    slack = 3.0 / np.sqrt(2 * runs)
    assert np.all((ratio > 0.8 * (1.0 - slack)) & (ratio < 1.25 * (1.0 + slack))), ratio


def test_a_station_that_stands_still_seldom_looks_moved(many):
    false = sum(one.moved for one in many)
    assert false <= NEVER * RUNS + 4.0 * np.sqrt(NEVER * RUNS)


@pytest.mark.parametrize("way", [[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.577, 0.577, -0.577]])
def test_a_shift_of_a_tenth_of_a_millimetre_is_found(way):
    """With its sigma, of two runs of a robot that repeats to 0.03 mm; twice as much is told."""
    cell, shift = noisy_cell(), 1e-4 * np.array(way, dtype=np.float64)
    before, now = driven(cell, 7), driven(knocked(cell, shift), 8)
    found = station_shift(before, now)
    away = found.shift - shift
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < chi2.ppf(0.999, 3)
    assert found.sigma_m < 0.3 * np.linalg.norm(shift)
    assert station_shift(before, driven(knocked(cell, 2.0 * shift), 8)).moved


def test_a_turn_is_told_as_a_turn():
    cell, turn = noisy_cell(), np.array([4e-3, -3e-3, 6e-3])
    found = station_shift(driven(cell, 9), driven(knocked(cell, [0.0, 0.0, 0.0], turn), 10))
    away = np.append(found.shift, found.turn - turn)
    assert away @ np.linalg.solve(found.covariance, away) < chi2.ppf(0.999, 6)
    assert found.moved


def test_a_late_input_and_slow_receivers_move_nothing():
    """Latency is an unknown of the run; the reach of a beam follows from its shadows."""
    cell = noisy_cell()
    beams = tuple(replace(b, dark_at=0.35, light_at=0.45) for b in cell.station.beams)
    source = replace(cell.station.input, latency_s=0.012)
    late = replace(cell, station=BeamStation(beams, source, cell.station.noise))
    found = bends(late, driven(late, 11))
    away = np.append(found.shift, found.turn)
    assert away @ np.linalg.solve(found.covariance, away) < chi2.ppf(0.999, 6)


def test_each_plunge_breaks_one_beam():
    plan = MeasuringPlan("laser", noisy_cell().laser, MANDREL)
    steps = [plan.step(n) for n in range(1, len(plan.names) + 1)]
    assert [s.beams for s in steps if s.kind == "circle"] == [("x", "y")] * 4
    assert [s.beams for s in steps if s.kind == "plunge"] == [("x",), ("x",), ("y",), ("y",)] * 2


def test_another_mandrel_is_named():
    with pytest.raises(WrongToolError, match=r"mandrel's is 2\.50 mm"):
        driven(noisy_cell(), 12, RoundTool.cylinder(MANDREL, 6e-3))


@pytest.mark.parametrize("wrong_m", [-5e-4, -2.5e-5, 2.5e-5, 1e-4, 5e-4])
def test_a_wrong_radius_counts_in_the_height_and_is_said(wrong_m):
    """It lowers the beams by as much, which the covariance of the frame holds."""
    cell = by_interrupt(noisy_cell())
    found = driven(cell, 15, radius_m=RADIUS_M - wrong_m)
    away = found.laser.T_base_laser[:3, 3] - laser_of(cell.station).T_base_laser[:3, 3]
    z = found.laser.T_base_laser[:3, 2]
    assert z @ away == pytest.approx(-wrong_m, abs=8e-5)
    height = z @ found.frame_covariance[:3, :3] @ z
    assert (z @ away) ** 2 < chi2.ppf(0.999, 1) * height
    told = station_verdict(found, None, 2e-4, 2e-4).reason
    assert f"{1e3 * found.wider_m:+.3f} mm from what mandrel_radius_mm" in told
    right = station_verdict(driven(cell, 15), None, 2e-4, 2e-4).reason
    assert "mandrel_radius_mm" not in right


def test_another_radius_than_the_first_time_is_named():
    """A tenth of a millimetre; what is less counts in the height of the shift."""
    cell = by_interrupt(noisy_cell())
    first = driven(cell, 16)
    thicker = RoundTool.cylinder(MANDREL, RADIUS_M + 1e-4)
    with pytest.raises(WrongToolError, match=r"\+0\.(09|10)\d mm from that of the first time"):
        station_shift(first, driven(cell, 17, thicker))
    little = driven(cell, 17, RoundTool.cylinder(MANDREL, RADIUS_M + 3e-5))
    shift = station_shift(first, little)
    assert shift.sigma_m > 2.5e-5
    assert not shift.moved


def test_two_stations_are_not_one_that_moved():
    cell = noisy_cell()
    found = driven(cell, 13)
    far = replace(found, laser=replace(found.laser, points=found.laser.points + 0.05))
    with pytest.raises(InputError, match="two stations"):
        station_shift(found, far)


def test_beams_that_are_known_badly_are_no_answer():
    """Neither the first time, nor where they may have moved by more than they may."""
    found = driven(noisy_cell(), 14)
    shaky = replace(found, laser=replace(found.laser, sigma_m=3e-4), covariance=9e-8 * np.eye(8))
    first = station_verdict(shaky, None, 2e-4, 2.5e-4)
    assert first.code is Code.RESIDUAL_TOO_LARGE
    assert "allowed 0.25 mm" in first.reason
    none = station_shift(shaky, shaky)
    told = result_document(shaky, none, StationTrend(), first, commissioned=False)
    assert told["answer"] == "cannot tell"
    points = shaky.laser.points + np.array([4e-4, 0.0, 0.0])
    away = station_shift(shaky, replace(shaky, laser=replace(shaky.laser, points=points)))
    assert not away.moved
    later = station_verdict(shaky, away, 2e-4, 2e-4)
    assert later.code is Code.TOO_FEW_SAMPLES
    told = result_document(shaky, away, StationTrend(), later, commissioned=True)
    assert told["answer"] == "cannot tell"


def test_a_measurement_is_kept_bit_for_bit():
    found = driven(noisy_cell(), 14)
    again = measurement_of(measurement_document(found))
    assert np.array_equal(again.laser.points, found.laser.points)
    assert np.array_equal(again.covariance, found.covariance)


@pytest.fixture
def driver(tmp_path):
    """A session whose robot carries the mandrel."""
    cell = noisy_cell()
    config = config_of(cell, mandrel=rows_of(MANDREL), mandrel_radius_m=RADIUS_M, station="s")
    with CalibrationHistory.open(
        "K1", model_hash=cell.arm.model_hash, state_dir=tmp_path
    ) as history:
        session = ToolSession(cell.arm, history, config, "test")
        made = Driver(session, cell, RoundTool.cylinder(MANDREL, RADIUS_M))
        made.program.station = "s"
        made.history = history
        yield made


def test_another_radius_as_told_is_another_first_time(driver, tmp_path):
    """What is told of a mandrel moves no station; the command counts from there, too."""
    assert driver.measure("laser", cycle_id="c1").status is Code.ACCEPT
    mended = replace(driver.session.config, mandrel_radius_m=RADIUS_M + 3e-4)
    driver.session = ToolSession(driver.cell.arm, driver.history, mended, "test")
    assert driver.session.current.commissioned_station is None
    anew = driver.measure("laser", cycle_id="c2")
    assert anew.status is Code.ACCEPT
    assert driver.session.current.commissioned_station is not None
    later = driver.measure("laser", cycle_id="c3")
    assert later.status is Code.ACCEPT
    document = robocal_json(
        "tool.station.json", "tool", "station", "--robot", "ur10", "--robot-serial", "K1",
        "--state", tmp_path,
    )  # fmt: skip
    assert document["first_stamp_ns"] == driver.history.get(anew.calibration_id).stamp_ns
    assert [row["calibration"] for row in document["measured"]] == [later.calibration_id]
    assert document["trend"] == later.document["trend"]


def test_a_station_is_commissioned_and_followed(driver, tmp_path):
    """First, in a gap, after a knock; what the command then tells, and the laser file it writes."""
    first = driver.measure("laser", cycle_id="c1")
    assert first.status is Code.ACCEPT, first.message
    assert driver.measure("laser", cycle_id="c1").repeated  # nothing runs twice
    second = driver.measure("laser", cycle_id="c2")
    assert (second.status, second.document["answer"]) == (Code.ACCEPT, "pass"), second.message
    standing = second.document["trend"]
    assert standing["days"] > 0.0
    assert "no drift is seen over 2 measurements" in second.message
    shift = 5e-4 * np.array([0.6, -0.4, 0.7])
    driver.program.cell.station = knocked(driver.cell, shift).station
    third = driver.measure("laser", cycle_id="c3")
    assert third.status is Code.STATION_MOVED, third.message
    told = third.document["station"]
    away = 1e-3 * np.array(told["shift_mm"]) - shift
    assert np.all(np.abs(away) < 4.0 * 1e-3 * np.array(told["shift_sigma_mm"]))
    assert third.document["trend"] == standing  # a knock is no drift
    again = ToolSession(driver.cell.arm, driver.history, driver.session.config, "test")
    assert np.array_equal(  # the first one stays what all are compared with
        again.current.commissioned_station.laser.points,
        driver.session.current.commissioned_station.laser.points,
    )
    laser = tmp_path / "laser.yaml"
    document = robocal_json(
        "tool.station.json", "tool", "station", "--robot", "ur10", "--robot-serial", "K1",
        "--state", tmp_path, "--output", laser,
    )  # fmt: skip
    assert [row["moved"] for row in document["measured"]] == [False, True]
    assert document["trend"] == standing
    placed = read_laser_for(laser, driver.cell.arm)
    assert (placed.station, placed.serial) == ("s", "K1")
    truth = laser_of(driver.program.cell.station).T_base_laser
    off = truth[:3, 3] - placed.laser.T_base_laser[:3, 3]
    assert np.linalg.norm(off) < 4.0 * placed.laser.sigma_m


def test_no_laser_file_is_written_from_what_proves_nothing(driver, tmp_path):
    config = driver.session.config
    strict = replace(config, limits=replace(config.limits, sigma_m=1e-9))
    driver.session = ToolSession(driver.cell.arm, driver.history, strict, "test")
    found = driver.measure("laser", cycle_id="c1")
    assert found.status is Code.RESIDUAL_TOO_LARGE
    document = robocal_json(
        "error.json", "tool", "station", "--robot", "ur10", "--robot-serial", "K1",
        "--state", tmp_path, "--output", tmp_path / "laser.yaml", status=2,
    )  # fmt: skip
    assert f"calibration {found.calibration_id}, is RESIDUAL" in document["error"]["message"]
    assert not (tmp_path / "laser.yaml").exists()


@pytest.mark.parametrize(("turn_deg", "code"), [(0.05, Code.ACCEPT), (0.5, Code.STATION_MOVED)])
def test_a_station_that_only_turned_has_moved_too(driver, turn_deg, code):
    """As a full run of the tool says; a turn as small as a warm robot's does not matter."""
    assert driver.measure("laser", cycle_id="c1").status is Code.ACCEPT
    turned = knocked(driver.cell, [0.0, 0.0, 0.0], [0.0, 0.0, np.radians(turn_deg)])
    driver.program.cell.station = turned.station
    found = driver.measure("laser", cycle_id="c2")
    assert found.status is code, found.message
    assert ("turned by 0.5" in found.message) == (code is Code.STATION_MOVED)


def test_without_a_mandrel_it_says_so(tmp_path):
    cell = noisy_cell()
    with CalibrationHistory.open("K2", state_dir=tmp_path) as history:
        session = ToolSession(cell.arm, history, config_of(cell), "test")
        made = Driver(session, cell, RoundTool.cylinder(MANDREL, RADIUS_M))
        found = made.measure("laser")
    assert found.status is Code.CONFLICT
    assert "mandrel" in found.message


def test_the_node_may_drive_every_step():
    """Ways and steps stay clear of the housing and inside all limits, from step to step."""
    cell = noisy_cell()
    plan = MeasuringPlan("laser", cell.laser, MANDREL)
    body = ToolBody(MANDREL, 0.05, RADIUS_M, 0.03)
    room = Housing(clear_radius_m=0.06, top_m=0.03, floor_m=-0.12, retract_m=0.05)
    motion = MotionCell(cell.arm, body, cell.laser.T_base_laser, room)
    q = inverse(cell.arm, plan.step(1).T_base_flange[None], cell.q_near)[0]
    for number in range(1, len(plan.names) + 1):
        step = plan.step(number)
        way = approach(motion, step, q, after_circle=1 < number <= 4)
        done = measuring(motion, step, way.q[-1])
        assert way.duration_s + done.duration_s < 60.0
        q = done.q[-1]


def test_a_trend_is_a_line_with_its_sigma():
    """Of measurements that scatter alike about a drift of 0.02 mm a day, over 200 draws."""
    rng, sigma = np.random.default_rng(1), 2e-5
    days = np.arange(10)
    stamps = [int(day) * DAY_NS for day in days]
    slopes, told = [], 0.0
    for _ in range(RUNS):
        drawn = np.outer(days, [2e-5, 0.0, -1e-5]) + sigma * rng.standard_normal((10, 3))
        drawn -= sigma * rng.standard_normal(3)  # of the first one, in all alike
        C = np.diag([sigma**2] * 6)
        shifts = [StationShift(s, np.zeros(3), 2.0 * C, C, True) for s in drawn]
        trend = StationTrend()
        for stamp, shift in zip(stamps, shifts, strict=True):
            trend = trend.after(stamp, shift)
        found = StationTrend.of_model(json.loads(json.dumps(trend.model()))).document()
        slopes.append(found["per_day_mm"])
        told = found["sigma_mm"][0]
    assert np.mean(slopes, axis=0) == pytest.approx(
        [0.02, 0.0, -0.01], abs=4.0 * told / np.sqrt(RUNS)
    )
    assert np.std(slopes, axis=0) == pytest.approx([told] * 3, rel=4.0 / np.sqrt(2 * RUNS))


def test_a_drift_is_told_with_the_day_on_which_it_matters():
    C, axis = np.diag([4e-10] * 6), np.array([0.6, 0.0, -0.8])

    def drifted(per_day_m: float) -> StationTrend:
        trend = StationTrend()
        for day in range(10):
            shift = StationShift(day * per_day_m * axis, np.zeros(3), 2.0 * C, C, False)
            trend = trend.after(day * DAY_NS, shift)
        return trend

    assert StationTrend().words(1e-4) == ""
    assert drifted(0.0).after(0, StationShift(np.zeros(3), np.zeros(3), C, C, False)).count == 11
    assert drifted(0.0).words(1e-4).startswith("no drift is seen over 10 measurements in 9 days")
    # slope of a line through 0 ... 9 with 0.02 mm each: 0.02 / sqrt(82.5)
    told = "it drifts by 0.02 mm a day (sigma 0.0022, over 10 measurements in 9 days)"
    assert drifted(2e-5).words(1e-4) == f"{told}: 0.10 mm in 5 days"


def test_a_beam_is_what_the_simulation_says():
    """The truth that all is compared with: two points on each true beam."""
    cell = noisy_cell()
    x: TrueBeam = cell.station.beams[0]
    assert np.array_equal(laser_of(cell.station).points[0], x.start)


def test_the_golden_bag_gives_its_session_again():
    """Commissioned, in a gap, and after a knock of 0.5 mm: `bags/make_laser_frame.py`."""
    document = robocal_json("replay.tool.json", "replay", ROOT / "bags" / "laser_frame.mcap")
    assert (document["recorded"], beyond_rounding(document)) == (True, [])
    codes = [run["verdict"]["code"] for run in document["runs"]]
    assert codes == ["ACCEPT", "ACCEPT", "STATION_MOVED"]
