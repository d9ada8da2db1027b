# SPDX-License-Identifier: Apache-2.0
"""The cell over time: what it shows against what is commanded, and what can be found from it."""

from dataclasses import replace

import numpy as np
import pytest
from beam_cell import SILENT, make_cell
from cell_plans import ARM, Q_START, TRUTH, driven, measured, plan_of

from bench.measured_runs import T_BASE_LASER, TAUGHT, laser_of, point_sigma
from robocal_ros.cell_sim.beams import CYLINDER_M, RoundTool, TrueInput, TrueNoise
from robocal_ros.cell_sim.cell import SimulatedCell, known_laser
from robocal_ros.cell_sim.sensors import TICK_S
from robocal_ros.cell_sim.trajectory_controller import CYCLE_S
from robocal_ros.ground.errors import LimitError
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.edges import BeamError, debounced
from robocal_ros.tool.laser_frame import calibrate_laser
from robocal_ros.tool.run import MeasuringPlan, PlannedStep

NOISE = TrueNoise(3e-5, 1e-5)
SAMPLED = TrueInput(latency_s=0.004, sample_period_s=0.002)
LASER = laser_of(make_cell().station)


def circle(**changes) -> PlannedStep:
    """The first circle of a run, twice as fast as usual."""
    step = MeasuringPlan("full", LASER, TAUGHT).step(1)
    return replace(step, **({"speed_m_s": 0.1} | changes))


def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def keys(edges) -> list:
    return [(e.beam, e.blocked) for e in edges]


def test_readings_are_the_commanded_joints_at_their_rate():
    cell = SimulatedCell(plan_of(rate_hz=250.0))
    q, qd = [Q_START + 0.1, Q_START], np.zeros((2, 6))
    cell.follow([0.5, 1.0], q, qd)
    parts = [cell.advance(t) for t in (0.1, 0.1001, 0.37, 0.9, 1.2)]
    time = np.concatenate([p.time_s for p in parts])
    assert time == pytest.approx(np.arange(len(time)) / 250.0, abs=1e-12)
    assert time[-1] > 1.2 - TICK_S - 1.0 / 250.0
    s = np.clip((time - CYCLE_S) / (0.5 - CYCLE_S), 0.0, 1.0)  # it begins in the next cycle
    s = np.where(time > 0.5, np.clip((1.0 - time) / 0.5, 0.0, 1.0), s)
    wanted = Q_START + 0.1 * (s**2 * (3.0 - 2.0 * s))[:, None]
    assert np.concatenate([p.q for p in parts]) == pytest.approx(wanted, abs=1e-9)


def test_a_programmed_circle_has_the_edges_of_the_same_circle_as_geometry():
    """Two ways to the same edges: along joints over time, and along the circle itself."""
    reference = make_cell().full_run(RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, rng())
    plan, move, wanted = reference.cell.plan, reference.moves[0], reference.steps[0].edges
    cell = SimulatedCell(plan_of())
    step = circle(T_base_flange=move.T_base_centre, direction=move.direction, speed_m_s=plan.speed)
    start_s = cell.drive(step).start_s
    edges = cell.advance(cell.motion.end_s + 0.2).edges
    assert keys(edges) == keys(wanted)
    times = np.array([e.time_s for e in edges]) - start_s
    # Cubics between points 8 ms apart miss the circle by 0.05 nm: 1 ns at 50 mm/s.
    assert times == pytest.approx([e.time_s - move.start_s for e in wanted], abs=1e-8)


@pytest.mark.long
def test_each_motion_has_its_own_scatter():
    cell = SimulatedCell(plan_of(noise=TrueNoise(3e-5, 0.0)))
    off = []
    for i in range(200):
        cell.follow(cell.now_s + np.array([0.01]), [Q_START + 1e-4 * (i % 2)])
        cell.advance(cell.now_s + 0.06)
        at = np.array([cell.now_s])
        off.append((cell.flange(at) - ARM.fk(cell.motion.at(at)[0]))[0, :3, 3])
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    assert spread == pytest.approx(np.full(3, 3e-5), rel=4.0 / np.sqrt(2 * 200))
    assert abs(np.corrcoef(np.array(off)[:-1, 0], np.array(off)[1:, 0])[0, 1]) < 4.0 / np.sqrt(200)


def test_scatter_moves_edges_no_more_than_it_is():
    exact = driven(SimulatedCell(plan_of()), circle()).edges
    noisy = driven(SimulatedCell(plan_of(noise=NOISE)), circle()).edges
    assert keys(noisy) == keys(exact)
    off_m = 0.1 * np.array([a.time_s - b.time_s for a, b in zip(noisy, exact, strict=True)])
    # Beams are crossed at 30 deg and more: at half of the speed or faster.
    assert np.all(np.abs(off_m) < 2.0 * 5.0 * np.hypot(NOISE.step_m, NOISE.edge_m))
    assert np.all(off_m != 0.0)


def test_a_run_without_noise_gives_the_tool_back():
    cell = SimulatedCell(plan_of(source=TrueInput(latency_s=0.011, jitter_s=0.0)))
    found, counts = measured(cell, LASER, SILENT)
    assert counts == [8, 8, 8, 4, 4]  # and none on the ways between
    assert found.tip == pytest.approx(TRUTH[:3, 3], abs=1e-7)
    assert found.axis == pytest.approx(TRUTH[:3, 2], abs=1e-6)
    assert found.latency_s == pytest.approx(0.011, abs=1e-5)
    assert cell.now_s - 5 * 0.2 < 12.0  # s of motion


def test_a_noisy_run_gives_the_tool_back_within_its_covariance():
    plan = plan_of(source=SAMPLED, noise=NOISE, ripple=0.02)
    laser = calibrate_laser(
        known_laser(plan, T_BASE_LASER, Q_START, rng()), point_sigma(plan.station), CYLINDER_M
    )
    found, _ = measured(SimulatedCell(plan), laser, RobotNoise(NOISE.step_m, NOISE.edge_m))
    off = found.tip - TRUTH[:3, 3]
    assert np.linalg.norm(off) < 5 * np.sqrt(np.trace(found.covariance[:3, :3]))
    assert np.linalg.norm(off) < 5e-4


def test_the_arms_own_error_is_in_the_flange_and_in_the_known_laser():
    plan = plan_of(error_m=2e-4)
    cell = SimulatedCell(plan)
    wrong = ARM.fk(Q_START)[:3, 3] - cell.flange(np.zeros(1))[0, :3, 3]
    assert 1e-4 < np.linalg.norm(wrong) < 2e-3
    laser = calibrate_laser(known_laser(plan, T_BASE_LASER, Q_START, rng()))
    moved = laser.T_base_laser[:3, 3] - LASER.T_base_laser[:3, 3]
    # The robot sees its station where its own error puts it, up to the turn over the tool.
    assert np.linalg.norm(moved - wrong) < 0.5 * np.linalg.norm(wrong)
    found, _ = measured(cell, laser, RobotNoise(1e-4, 1e-5))
    # Only what the error changes over the small motions at the station remains.
    assert np.linalg.norm(found.tip - TRUTH[:3, 3]) < 0.3 * np.linalg.norm(wrong)


def test_edges_are_told_when_their_stamp_has_passed():
    late = 0.05
    plain = SimulatedCell(plan_of())
    slow = SimulatedCell(plan_of(source=TrueInput(latency_s=late, jitter_s=0.0)))
    wanted = [e.time_s + late for e in driven(plain, circle()).edges]
    slow.drive(circle())
    told = []
    while slow.moving:
        before = slow.now_s
        for edge in slow.advance(before + 0.02).edges:
            assert before < edge.time_s <= slow.now_s
            told.append(edge.time_s)
    assert told == pytest.approx(wanted, abs=1e-9)


def test_a_sampled_input_stamps_on_one_clock():
    edges = driven(SimulatedCell(plan_of(source=TrueInput(0.0, 0.0, 0.002))), circle()).edges
    phase = np.array([e.time_s for e in edges]) / 0.002
    phase -= phase[0]
    assert phase == pytest.approx(np.round(phase), abs=1e-6)
    assert [e.sigma_s for e in edges] == pytest.approx([0.002 / np.sqrt(12.0)] * 8)


def test_the_seed_tells_everything_whenever_the_cell_is_asked():
    def run(seed, pieces):
        cell = SimulatedCell(plan_of(source=SAMPLED, noise=NOISE, ripple=0.02, seed=seed))
        cell.drive(circle())
        parts = [cell.advance(t) for t in np.linspace(0.0, 2.2, pieces)[1:]]
        return np.concatenate([p.q for p in parts]), [e for p in parts for e in p.edges]

    one, other, new = run(1, 2), run(1, 211), run(2, 2)
    assert np.array_equal(one[0], other[0])
    assert one[1] == other[1]
    assert one[1] != new[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "x", "y"),
    [
        ("beam_x_dead", 0, 4),
        ("beam_y_dead", 4, 0),
        ("beams_dead", 0, 0),
        ("lost_edge", 4, 3),
        ("double_edge", 4, 5),
    ],
)
def test_faults_of_the_input_from_the_next_motion_on(fault, x, y):
    cell = SimulatedCell(plan_of())
    cell.set_fault(fault)
    assert not cell.faults.sizes
    came = keys(driven(cell, circle()).edges)
    assert list(cell.faults.sizes) == [fault]
    assert [sum(beam == b for beam, _ in came) for b in "xy"] == [x, y]
    cell.set_fault("none")
    assert len(driven(cell, circle()).edges) == 8


def test_chatter_does_not_settle():
    cell = SimulatedCell(plan_of())
    cell.set_fault("chatter")
    edges = driven(cell, circle()).edges
    with pytest.raises(BeamError, match="chatters"):
        debounced(edges, 5e-4)


def test_a_hand_moves_the_flange_and_no_joint():
    cell = SimulatedCell(plan_of())
    cell.set_fault("moved_by_hand")
    cell.drive(circle())
    time = np.arange(0.0, cell.motion.end_s, 1e-3)
    q = cell.motion.at(time)[0]
    off = np.linalg.norm(cell.flange(time)[:, :3, 3] - ARM.fk(q)[:, :3, 3], axis=1)
    assert off[0] == pytest.approx(0.0, abs=1e-9)
    assert np.max(np.abs(np.diff(off))) < 5e-5  # it does not jump
    assert off[-1] == pytest.approx(1e-3, rel=0.02)


def test_a_replaced_or_ended_motion_goes_on_where_it_is():
    cell = SimulatedCell(plan_of(noise=NOISE))
    cell.drive(circle())
    cell.advance(1.2)
    before = cell.flange(np.array([cell.now_s]))
    cell.drive(circle(direction=-1))
    assert cell.flange(np.array([cell.now_s])) == pytest.approx(before, abs=1e-12)
    cell.advance(1.5)
    cell.hold()
    cell.advance(1.6)
    before = cell.flange(np.array([cell.now_s]))
    assert not cell.moving
    later = cell.flange(cell.now_s + np.array([0.0, 1.0]))
    assert later == pytest.approx(np.tile(before, (2, 1, 1)), abs=1e-12)


def test_what_is_out_of_reach_is_refused():
    T = circle().T_base_flange.copy()
    T[0, 3] += 3.0
    cell = SimulatedCell(plan_of())
    with pytest.raises(LimitError, match="does not reach step low"):
        cell.drive(circle(T_base_flange=T))
    assert not cell.moving


@pytest.mark.parametrize(
    "tool",
    [RoundTool.cone(TAUGHT, 1e-3, 0.1), RoundTool.torch(TAUGHT, 6e-4, 8e-3)],
    ids=["cone", "torch"],
)
def test_other_tools_pass_too(tool):
    came = driven(SimulatedCell(plan_of(tool=tool)), circle()).edges
    assert len(came) == 8


def test_a_tool_is_bent_when_the_next_motion_begins():
    cell = SimulatedCell(plan_of())
    straight = plan_of().tool.mounted(TAUGHT)
    cell.drive(circle())
    cell.next_tool = straight
    bent_edges = cell.advance(cell.motion.end_s + 0.2).edges
    assert cell.tool is not straight
    begin_s = cell.now_s
    edges = driven(cell, circle()).edges
    assert cell.tool is straight
    wanted = driven(SimulatedCell(plan_of(tool=straight)), circle()).edges
    gaps = [np.diff([e.time_s for e in found]) for found in (bent_edges, edges, wanted)]
    assert begin_s < edges[0].time_s
    assert gaps[1] == pytest.approx(gaps[2], abs=1e-8)
    assert np.max(np.abs(gaps[0] - gaps[2])) > 1e-2  # bent by 3 mm
