# SPDX-License-Identifier: Apache-2.0
"""Runs through the beams, driven by a simulated robot as a session asks for them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from joint_errors import with_joint_errors
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell

from robocal_ros.cell_sim.beams import RoundTool, bent
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.samples import JointSample
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.session.events import (
    ACCEPT,
    BREAK_OFF,
    ROLLBACK,
    TOOL_STEP,
    Command,
    bring_into_force,
)
from robocal_ros.tool.edges import BeamEdge, EdgeSample
from robocal_ros.tool.judging import KnownTool, ToolLimits
from robocal_ros.tool.laser_frame import LaserFile, read_laser, write_laser
from robocal_ros.tool.run import SAME, ToolConfig, rows_of
from robocal_ros.tool.session import ToolSession


def driver_of(history, tool=TRUTH, cell=None, **changes) -> Driver:
    cell = cell or noisy_cell()
    session = ToolSession(cell.arm, history, config_of(cell, **changes), "test")
    return Driver(session, cell, RoundTool.cylinder(tool, 0.0025))


def tilt(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a[:3, 2] @ b[:3, 2], -1.0, 1.0)))


def test_a_bent_tool_is_found_judged_and_accepted(history):
    driver = driver_of(history)
    outcome = driver.measure()
    assert outcome.status is Code.ACCEPT, outcome.message
    found = KnownTool.of_document(history.model(outcome.calibration_id))
    away = found.T_flange_tool[:3, 3] - TRUTH[:3, 3]
    # 3 unknowns: beyond 4.1 sigma in one of 1000 (chi-square 16.3).
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < 16.3
    sigma = float(np.sqrt(np.max(np.diag(found.covariance)[3:])))
    assert tilt(found.T_flange_tool, TRUTH) < 4.0 * sigma
    assert outcome.document["absolute"] is True
    accepted = driver.command(Command(ACCEPT, {"id": outcome.calibration_id, "by": "me"}))
    assert accepted.done
    assert driver.session.in_force.revision == 1
    back = driver.command(Command(ROLLBACK, {"previous": True, "by": "me"}))
    assert back.message == "revision 2: the taught tool in force"
    assert driver.session.current.tool.T_flange_tool == pytest.approx(TAUGHT)


def test_each_step_is_a_command_with_the_bounds_of_its_samples(history):
    driver = driver_of(history)
    driver.measure()
    steps = [o.command for o in driver.outcomes if o.command.name == TOOL_STEP]
    names = [command.arguments["step"] for command in steps]
    assert names == ["low", "high", "upright", "plunge_1", "plunge_2"]
    wanted = {"joint_states", "beam_events/x", "beam_events/y", "clock_jumps"}
    assert all(set(command.marks) == wanted for command in steps)
    assert [o.samples for o in driver.outcomes if o.command.name == TOOL_STEP] == [8, 8, 8, 4, 4]


def test_a_quick_check_passes_an_unchanged_tool_and_finds_a_bent_one(history):
    driver = driver_of(history)
    full = driver.measure()
    driver.command(Command(ACCEPT, {"id": full.calibration_id, "by": "me"}))
    unchanged = driver.measure("quick")
    assert (unchanged.status, unchanged.document["answer"]) == (Code.ACCEPT, "pass")
    driver.program.tool = RoundTool.cylinder(
        bent(TRUTH, [0.001, 0.0, 0.0], [0.0, 0.005, 0.0]), 0.0025
    )
    moved = driver.measure("quick")
    assert moved.status is Code.LIMIT_EXCEEDED
    assert moved.document["answer"] == "recalibrate"
    # The shift of 1 mm, to the check's own sigma.
    off = moved.document["change"]["tip_mm"] - 1.0
    assert abs(off) < 4.0 * moved.document["sigma_mm"]
    assert history.pending("tool") == ()


def test_a_tool_that_did_not_move_is_said_to_be_the_one_in_force(history):
    driver = driver_of(history)
    first = driver.measure()
    driver.command(Command(ACCEPT, {"id": first.calibration_id, "by": "me"}))
    again = driver.measure()
    assert again.status is Code.NO_SIGNIFICANT_GAIN
    assert "has not moved" in again.message


def test_a_healthy_tool_is_said_to_be_the_taught_one(history):
    """As soon as it is known how the taught tool measures; before, the robot's error is in it."""
    cell = noisy_cell()
    cell.laser = replace(cell.laser, points=cell.laser.points + np.full(3, 3e-4))
    driver = driver_of(history, TAUGHT, cell)
    assert driver.measure().status is Code.ACCEPT
    assert driver.measure("reference").done
    first = driver.measure()
    assert first.status is Code.NO_SIGNIFICANT_GAIN, first.message
    assert "the tool has not moved" in first.message
    driver.program.tool = RoundTool.cylinder(TRUTH, 0.0025)
    bent_one = driver.measure()
    assert driver.command(Command(ACCEPT, {"id": bent_one.calibration_id, "by": "me"})).done
    assert driver.measure().status is Code.NO_SIGNIFICANT_GAIN
    driver.program.tool = RoundTool.cylinder(TAUGHT, 0.0025)
    assert driver.measure().status is Code.ACCEPT  # straightened
    driver.command(Command(ROLLBACK, {"previous": True, "by": "me"}))
    assert driver.measure().status is Code.NO_SIGNIFICANT_GAIN


def test_a_check_counts_a_healthy_run_that_was_made_anew_since(history):
    """It does not cancel against that of the tool in force: the check knows less."""
    driver = driver_of(history, TAUGHT, noisy_cell())
    assert driver.measure("reference").done
    driver.program.tool = RoundTool.cylinder(TRUTH, 0.0025)
    bent_one = driver.measure()
    assert driver.command(Command(ACCEPT, {"id": bent_one.calibration_id, "by": "me"})).done
    before = driver.measure("quick")
    driver.program.tool = RoundTool.cylinder(TAUGHT, 0.0025)
    assert driver.measure("reference").done
    driver.program.tool = RoundTool.cylinder(TRUTH, 0.0025)
    after = driver.measure("quick")
    assert [one.document["answer"] for one in (before, after)] == ["pass", "pass"]
    assert after.document["sigma_mm"] > before.document["sigma_mm"]


def test_the_healthy_tool_takes_the_robots_absolute_error_away(history):
    """The laser is believed 0.4 mm from where it is: the change of the tool does not show it."""
    cell = noisy_cell()
    off = np.array([3e-4, -2e-4, 2e-4])
    cell.laser = replace(cell.laser, points=cell.laser.points + off)
    driver = driver_of(history, TAUGHT, cell)
    healthy = driver.measure("reference")
    assert healthy.done, healthy.message
    assert healthy.document["change"]["tip_mm"] == pytest.approx(np.linalg.norm(off) * 1e3, abs=0.2)
    driver.program.tool = RoundTool.cylinder(TRUTH, 0.0025)
    bent_one = driver.measure()
    found = KnownTool.of_document(history.model(bent_one.calibration_id))
    assert bent_one.document["absolute"] is False
    away = found.T_flange_tool[:3, 3] - TRUTH[:3, 3]
    # Turned by the tilt of 0.064 rad, 0.4 mm of the laser's error leaves 0.026 mm beside the noise.
    wide = found.covariance[:3, :3] + np.eye(3) * (0.064 * np.linalg.norm(off)) ** 2
    assert away @ np.linalg.solve(wide, away) < 16.3


def test_a_healthy_tool_is_known_as_well_as_a_tool_must_be(history):
    """`sigma_limit_mm` holds in mode REFERENCE too, and the message has it as it was set."""
    driver = driver_of(history, TAUGHT, limits=ToolLimits(sigma_m=2e-5))
    refused = driver.measure("reference")
    assert refused.status is Code.RESIDUAL_TOO_LARGE, refused.message
    assert "allowed sigma 0.02 mm" in refused.message
    assert driver.session.current.measured_healthy is None


def test_a_change_beyond_what_may_be_is_refused_with_the_limits_as_they_were_set(history):
    limits = ToolLimits(change_m=1.5e-3, tilt_rad=np.radians(0.5))
    refused = driver_of(history, TRUTH, limits=limits).measure()
    assert refused.status is Code.LIMIT_EXCEEDED, refused.message
    assert "(allowed 1.5 mm, 0.5 deg)" in refused.message


def test_a_cycle_that_has_ended_is_answered_again(history):
    driver = driver_of(history)
    first = driver.measure(cycle_id="gap-7")
    again = driver.command(replace(driver.outcomes[0].command, stamp_ns=None, marks=None))
    assert again.repeated
    assert again.calibration_id == first.calibration_id
    assert driver.session.run is None


def lost(beam, index):
    def edit(step, edges):
        own = [e for e in edges if e.beam == beam]
        return [e for e in edges if e is not own[index]]

    return edit


def dead(beam):
    return lambda step, edges: [e for e in edges if e.beam != beam]


def extra(step, edges):
    """A ninth edge: something else passed the beam."""
    e = edges[3]
    return [*edges, BeamEdge(e.beam, not e.blocked, e.time_s + 0.02, e.sigma_s)]


def chatter(step, edges):
    e = edges[3]
    more = [BeamEdge(e.beam, e.blocked ^ (i % 2 == 0), e.time_s + 1e-4 * (i + 1), e.sigma_s)
            for i in range(9)]  # fmt: skip
    return [*edges, *more]


def swapped(step, edges):
    """Break and restore of one passage in the wrong order."""
    own = [e for e in edges if e.beam == "x"]
    return [replace(e, blocked=not e.blocked) if e in own[:2] else e for e in edges]


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (swapped, "twice"),
        (lost("x", 1), "an edge between was lost"),
        (lost("y", -1), "edges"),
        (dead("x"), "beam x was never broken"),
        (extra, "twice"),
        (chatter, "chatters"),
        (lambda step, edges: [], "no edge within"),
    ],
)
def test_wrong_edges_end_the_run_and_say_why(history, edit, words):
    driver = driver_of(history, step_timeout_s=4.0)
    driver.program.edit = edit
    outcome = driver.measure()
    assert outcome.status is Code.BEAM_EDGES_WRONG
    assert words in outcome.message
    assert history.list(5) == ()
    driver.program.edit = lambda step, edges: edges
    assert driver.measure().done


def test_a_tool_too_thick_for_the_circle_is_refused(history):
    driver = driver_of(history)
    driver.program.tool = RoundTool.cylinder(TRUTH, 0.013)
    driver.measure()
    assert driver.outcomes[-1].status in (Code.BEAM_EDGES_WRONG, Code.TOO_FEW_SAMPLES)


def test_a_robot_moved_by_hand_in_between_is_refused(history):
    """A nudge that the joints do not show: the base slid by 2 mm."""
    driver = driver_of(history)
    moved = np.array([0.002, 0.0, 0.0])

    def edit(step, edges):
        if step.name != "plunge_2":
            return edges
        shifted = replace(driver.cell.station, beams=tuple(
            replace(b, start=b.start + moved, end=b.end + moved) for b in driver.cell.station.beams
        ))  # fmt: skip
        from robocal_ros.cell_sim.beams import step_move

        move = step_move(step, edges[0].time_s - 0.55, 0.0, 0.0)
        return shifted.edges(driver.program.tool, move, move.window, np.random.default_rng(5))

    driver.program.edit = edit
    outcome = driver.measure()
    assert outcome.status in (Code.RESIDUAL_TOO_LARGE, Code.BEAM_EDGES_WRONG)


def test_edges_of_another_station_are_not_used(history):
    driver = driver_of(history, station="south", step_timeout_s=2.0)
    with pytest.raises(InputError, match="station ''"):
        driver.measure()
    driver.command(driver.session.recognised())
    assert driver.outcomes[-1].status is Code.BEAM_EDGES_WRONG
    assert "connect the right station" in driver.outcomes[-1].message
    assert driver.session.run is None


def test_joint_states_that_pause_are_refused(history):
    driver = driver_of(history)
    play = driver.play

    def gappy(samples):
        at = [s.stamp_ns for s in samples if not isinstance(s, JointSample)][4:5]
        play(
            [
                s
                for s in samples
                if not at or abs(s.stamp_ns - at[0]) > 80_000_000 or s.stamp_ns == at[0]
            ]
        )

    driver.play = gappy
    outcome = driver.measure()
    assert outcome.status is Code.BAD_INPUT
    assert "raise the rate of joint_states" in outcome.message


def test_a_run_can_be_broken_off(history):
    driver = driver_of(history)
    driver.rest(0.1)
    driver.command(Command("measure_tool", {"mode": "full"}))
    outcome = driver.command(Command(BREAK_OFF, {"reason": "cancelled by the PLC"}))
    assert outcome.status is Code.CONFLICT
    assert driver.session.awaited is None
    assert driver.measure().done


def test_a_clock_that_jumps_back_ends_the_run(history):
    driver = driver_of(history)
    driver.rest(0.1)
    driver.command(Command("measure_tool", {"mode": "full"}))
    for k in range(3):
        stamp = driver.program.ns(-100.0 + 0.008 * k)
        driver.give(JointSample(stamp, driver.cell.arm.joint_names, driver.program.q))
    assert "jumped back" in driver.outcomes[-1].message
    assert driver.session.run is None


@pytest.mark.parametrize("sooner", [False, True])
def test_a_recording_may_bring_an_edge_of_the_run_before_the_runs_begin(history, sooner):
    """A recorder gets topics in another order than the node: the marks tell what was there."""
    driver = driver_of(history)
    driver.rest(0.1)
    session, before = driver.session, driver.session.marks
    edge = EdgeSample(session.newest_joints_ns + 1_000_000, "", "x", True, 1e-4)
    if sooner:
        session.add(edge)
    session.submit(Command("measure_tool", {"mode": "full"}, session.newest_joints_ns, before))
    assert session.step(wall_ns=1)[-1].done
    if not sooner:
        session.add(edge)
    driver.rest(0.1)
    session.submit(Command(TOOL_STEP, {}, session.newest_joints_ns, session.marks))
    assert session.step(wall_ns=2)[-1].samples == 1


def test_settings_survive_json():
    config = config_of(noisy_cell(), station="north")
    assert ToolConfig.of_document(json.loads(json.dumps(config.document()))) == config


def test_a_reference_of_another_tool_counts_for_nothing(history):
    """Two tools of one robot: the change against one says nothing about the other."""
    first = driver_of(history, TAUGHT)
    assert first.measure("reference").done
    second = bent(TAUGHT, [0.004, 0.0, 0.006], [0.0, 0.0, 0.0])
    driver = driver_of(history, second, taught=rows_of(second))
    outcome = driver.measure()
    assert outcome.document["absolute"] is True
    found = KnownTool.of_document(history.model(outcome.calibration_id))
    away = found.T_flange_tool[:3, 3] - second[:3, 3]
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < 16.3


def test_a_tool_of_another_taught_one_is_not_in_force(history):
    """The history has one tool for a robot: that of a shorter one would drive this one too low."""
    first = driver_of(history)
    found = first.measure()
    assert first.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"})).done
    longer = bent(TAUGHT, [0.0, 0.0, 0.006], [0.0, 0.0, 0.0])
    driver = driver_of(history, longer, taught=rows_of(longer))
    assert driver.session.current.foreign
    assert driver.session.current.tool.T_flange_tool == pytest.approx(longer)
    assert driver.session.in_force.revision == 1  # what decisions count on
    rounded = bent(TAUGHT, [0.0, 0.0, 5e-6], [0.0, 0.0, 0.0])  # as a pendant writes it
    assert not driver_of(history, rounded, taught=rows_of(rounded)).session.current.foreign
    assert driver.measure("quick").status is Code.ACCEPT
    own = driver.measure()
    assert driver.command(Command(ACCEPT, {"id": own.calibration_id, "by": "me"})).done
    assert not driver.session.current.foreign
    assert driver_of(history).session.current.foreign  # nor the other way round


def test_a_tool_from_before_the_healthy_run_is_no_change_against_it(history):
    """What the beams are placed wrongly by is in both, and counted once."""
    cell = noisy_cell()
    cell.laser = replace(cell.laser, points=cell.laser.points + np.array([4e-4, -3e-4, 2e-4]))
    driver = driver_of(history, TAUGHT, cell)
    absolute = driver.measure()
    assert driver.command(Command(ACCEPT, {"id": absolute.calibration_id, "by": "me"})).done
    healthy = driver.measure("reference")
    assert healthy.done
    away_mm = absolute.document["change"]["tip_mm"]
    assert f"{away_mm:.3f} mm from the taught tool, is in force still" in healthy.message
    assert driver.measure("quick").document["answer"] == "pass"
    full = driver.measure()
    assert full.status in (Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN), full.message
    assert full.document["witness"]["tip_mm"] < 0.15  # two runs' own noise
    assert full.document["change"]["tip_mm"] == pytest.approx(away_mm, abs=0.15)


def test_what_other_beams_err_by_is_not_taken_out(history):
    """A tool from before a new laser file: what both files are off by stays in its sigma."""
    first = driver_of(history, TAUGHT)
    absolute = first.measure()
    assert first.command(Command(ACCEPT, {"id": absolute.calibration_id, "by": "me"})).done
    assert first.measure("reference").done
    same = first.measure("quick").document["sigma_mm"]
    cell = noisy_cell()
    cell.laser = replace(cell.laser, points=cell.laser.points + np.array([3e-4, -2e-4, 0.0]))
    driver = driver_of(history, TAUGHT, cell)
    assert driver.measure("reference").done
    assert not driver.session.current.by_these_beams
    file_mm = 1e3 * cell.laser.sigma_m
    assert driver.measure("quick").document["sigma_mm"] > np.hypot(same, file_mm)


def test_the_healthy_tool_counts_after_its_beams_went_through_a_file(history, tmp_path):
    """In millimetres their last digits are others; beams that were placed anew are other beams."""
    driver = driver_of(history, TAUGHT)
    assert driver.measure("reference").done
    laser, path = driver.session.config.laser, tmp_path / "laser.yaml"
    write_laser(path, LaserFile(laser, "station", "robot", "hash"))
    points = read_laser(path).laser.points
    assert not np.array_equal(points, laser.points)
    again = driver_of(history, TAUGHT, points_m=rows_of(points))
    assert again.session.current.measured_healthy is not None
    assert again.measure().document["absolute"] is False
    other = driver_of(history, TAUGHT, points_m=rows_of(points + 2.0 * SAME))
    assert other.session.current.measured_healthy is None


def test_a_bent_tool_is_no_healthy_one(history):
    driver = driver_of(history, bent(TAUGHT, [0.008, 0.0, 0.0], [0.0, 0.1, 0.0]))
    outcome = driver.measure("reference")
    assert outcome.status is Code.LIMIT_EXCEEDED
    assert "allowed 3 mm and 1.5 deg" in outcome.message
    assert driver.session.current.measured_healthy is None


def test_one_edge_from_the_future_blinds_no_beam(history):
    driver = driver_of(history)
    driver.rest(0.1)
    late = driver.program.ns(3600.0)
    with pytest.raises(InputError, match="ahead of the joint states"):
        driver.session.add(EdgeSample(late, "", "x", True, 1e-4))
    assert driver.measure().done


def test_a_program_that_never_rests_ends_the_run(history):
    driver = driver_of(history, step_timeout_s=4.0)
    driver.rest(0.1)
    driver.command(Command("measure_tool", {"mode": "full"}))
    step = driver.session.awaited
    while driver.session.run is not None:
        circle = driver.program.drive(step)
        driver.play([s for s in circle if s.stamp_ns < circle[-1].stamp_ns - 500_000_000])
        assert driver.program.now_s < 60.0
    assert "rest after each step" in driver.outcomes[-1].message


@pytest.mark.parametrize("full", [False, True])
def test_flange_poses_come_from_the_thermal_model_in_force(history, full):
    """A robot that has drifted by 0.5 mm, or whose joints err besides: the tool is found."""
    cell = noisy_cell()
    nominal = cell.arm
    drifted = nominal.with_mdh(nominal.mdh + np.array([5e-4, 0.0, 5e-4, 0.0, 0.0]))
    drifted = with_joint_errors(drifted, 1) if full else drifted
    bring_into_force(history, THERMAL, nominal, model_document(drifted), "test")
    driver = driver_of(history, TRUTH, replace(cell, arm=drifted))
    driver.session = ToolSession(nominal, history, config_of(cell), "test")
    outcome = driver.measure()
    model = history.model(outcome.calibration_id)
    assert model["thermal_revision"] == 1
    found = KnownTool.of_document(model)
    away = found.T_flange_tool[:3, 3] - TRUTH[:3, 3]
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < 16.3


@pytest.mark.parametrize(
    ("mode", "code"),
    [("full", Code.NO_SIGNIFICANT_GAIN), ("reference", Code.TOO_FEW_SAMPLES)],
)
def test_a_burst_of_lost_readings_is_judged_over_the_whole_run(history, mode, code):
    """A fifth of one step is a twentieth of all; a healthy tool measured so would hide loss."""
    driver = driver_of(history, TAUGHT, noisy_cell())
    assert driver.measure("reference").done
    play, driven = driver.play, 0

    def bursty(samples):
        nonlocal driven
        edges = [s.stamp_ns for s in samples if not isinstance(s, JointSample)]
        driven += bool(edges)
        if driven == 5 and edges:  # before the last plunge meets a beam
            begin, end = edges[0] - 700_000_000, edges[0] - 200_000_000
            samples = [s for s in samples if not begin < s.stamp_ns < end]
        play(samples)

    driver.play = bursty
    outcome = driver.measure(mode)
    assert driven == 5
    assert outcome.status is code, outcome.message
