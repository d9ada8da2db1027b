# SPDX-License-Identifier: Apache-2.0
"""A recorded run: the circle that was driven, the classic method on it, steps by their names."""

import numpy as np
import pytest
from beam_cell import make_cell

from bench.measured_runs import TAUGHT
from robocal_ros.cell_sim.beams import RoundTool, bent, joints_at
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, ResidualError
from robocal_ros.tool.circle import classic_from_path, classic_tool, driven_circle
from robocal_ros.tool.crossed_model import BeamStep
from robocal_ros.tool.edges import BeamEdge, BeamError
from robocal_ros.tool.files import named_steps, step_kind
from robocal_ros.tool.laser_frame import JointPath

TRUTH = bent(TAUGHT, [0.003, -0.002, 0.001], [0.03, -0.02, 0.0])
SPLINE_M = (
    1e-9  # cubics through readings each 8 ms: 5 / 384 (8 ms)^4 R w^4 = 0.2 nm, a turn in 1.5 s
)


@pytest.fixture(scope="module")
def run():
    return make_cell().full_run(
        RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, np.random.default_rng(3), "classic"
    )


@pytest.mark.parametrize("i", [0, 1, 2])
def test_the_driven_circle_is_the_commanded_one(run, i):
    found, wanted = driven_circle(run.cell.laser, run.path, run.steps[i].edges), run.commanded(i)
    assert found.T_base_centre == pytest.approx(wanted.T_base_centre, abs=SPLINE_M)
    assert found.motion.direction == wanted.motion.direction
    assert found.motion.radius_m == pytest.approx(wanted.motion.radius_m, abs=SPLINE_M)
    middle = np.mean([e.time_s for e in run.steps[i].edges])
    angle = [m.start_rad + m.rate_rad_s * middle for m in (found.motion, wanted.motion)]
    assert np.angle(np.exp(1j * (angle[0] - angle[1]))) == pytest.approx(0.0, abs=SPLINE_M / 0.012)
    drift = (found.motion.rate_rad_s - wanted.motion.rate_rad_s) * wanted.motion.period_s
    assert drift == pytest.approx(0.0, abs=SPLINE_M / 0.012)


def test_classic_from_the_joints_is_classic_from_the_commands(run):
    """The same tool as with the commanded circles, whose truth the classic bias keeps away from."""
    found = classic_from_path(run.cell.laser, run.path, run.steps, TAUGHT)
    times = np.concatenate([[e.time_s for e in s.edges] for s in run.steps[3:]])
    T, _ = run.path.at(times)
    circles = run.commanded(0), run.commanded(1)
    wanted = classic_tool(run.cell.laser, circles, T[0, :3, :3], T[:, :3, 3], TAUGHT)
    assert found == pytest.approx(wanted, abs=2.0 * SPLINE_M / 0.05)
    assert found[:3, 3] == pytest.approx(TRUTH[:3, 3], abs=1e-3)


def test_what_is_no_circle_is_refused(run):
    laser, path, low = run.cell.laser, run.path, run.steps[0].edges
    with pytest.raises(BeamError, match="beam x was never broken"):
        driven_circle(laser, path, [e for e in low if e.beam == "y"])
    still = JointPath(path.arm, path.time_s, np.tile(path.q[0], (len(path.q), 1)))
    with pytest.raises((RankDeficientError, ResidualError)):
        driven_circle(laser, still, low)
    time = np.linspace(min(e.time_s for e in low) - 0.1, max(e.time_s for e in low) + 0.1, 400)
    angle = 2.0 * np.pi * time / 1.5
    oval = np.column_stack([0.012 * np.cos(angle), 0.010 * np.sin(angle), 0.0 * angle])
    T = np.tile(run.commanded(0).T_base_centre, (len(time), 1, 1))
    T[:, :3, 3] += oval @ laser.T_base_laser[:3, :3].T
    driven = JointPath(path.arm, time, joints_at(path.arm, T, run.cell.q_near))
    with pytest.raises(ResidualError, match="leaves a circle in the beam plane by 1"):
        driven_circle(laser, driven, low)


@pytest.mark.parametrize(
    ("ripple", "tilt_rad", "words"),
    [(0.05, 0.0, r"was 0\.[56]\d\d mm from where"), (0.0, 0.01, r"turned by 1\.1\d+ deg")],
)
def test_a_circle_at_another_speed_or_with_a_turn_is_none_for_classic(run, ripple, tilt_rad, words):
    """Once a turn 5 % faster and slower, 0.05 * 12 mm ahead and behind; it set a tip 0.6 mm off."""
    low = run.steps[0].edges
    time = np.linspace(min(e.time_s for e in low) - 0.1, max(e.time_s for e in low) + 0.1, 400)
    turn = 2.0 * np.pi * time / 1.5
    angle = turn + ripple * np.sin(turn)
    flat = 0.012 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    T = np.tile(run.commanded(0).T_base_centre, (len(time), 1, 1))
    T[:, :3, 3] += flat @ run.cell.laser.T_base_laser[:3, :3].T
    tilts = [frames.exp_rotation([a, 0.0, 0.0]) for a in tilt_rad * np.sin(turn)]
    T[:, :3, :3] = T[:, :3, :3] @ np.array(tilts)
    driven = JointPath(run.path.arm, time, joints_at(run.path.arm, T, run.cell.q_near))
    with pytest.raises(ResidualError, match=words):
        driven_circle(run.cell.laser, driven, low)


def test_classic_names_what_is_missing(run):
    laser, path, (low, high, upright, *plunges) = run.cell.laser, run.path, run.steps
    with pytest.raises(RankDeficientError, match="there is no plunge"):
        classic_from_path(laser, path, [low, high, upright], TAUGHT)
    with pytest.raises(RankDeficientError, match="there is no circle"):
        classic_from_path(laser, path, plunges, TAUGHT)
    with pytest.raises(RankDeficientError, match="second circle at least 5 mm lower"):
        classic_from_path(laser, path, [low, upright, *plunges], TAUGHT)
    lost = BeamStep("high", "circle", high.edges[1:])
    with pytest.raises(BeamError, match="high: beam"):
        classic_from_path(laser, path, [low, lost, *plunges], TAUGHT)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, "circle") for name in ("low", "high", "upright", "circle", "circle_2")),
        *((name, "plunge") for name in ("plunge", "plunge_1")),
        *((name, None) for name in ("lower", "dip", "Circle", "")),
    ],
)
def test_names_of_steps(name, kind):
    assert step_kind(name) == kind


def test_steps_come_in_order_of_time_and_once():
    edges = [BeamEdge("x", k % 2 == 0, 0.1 * k, 1e-5) for k in range(8)]
    names = ["circle_b"] * 4 + ["plunge_a"] * 4
    steps = named_steps(edges[::-1], names[::-1], 5e-4)
    assert [(s.name, s.kind, len(s.edges)) for s in steps] == [
        ("circle_b", "circle", 4), ("plunge_a", "plunge", 4),
    ]  # fmt: skip
    with pytest.raises(
        InputError, match=r"'circle_b' comes again at 0\.7000 s, after step 'plunge"
    ):
        named_steps(edges, [*names[:7], "circle_b"], 5e-4)
    with pytest.raises(InputError, match="step 'dip' is neither"):
        named_steps(edges, ["dip"] * 8, 5e-4)


def test_angles_about_fixed_axes_return():
    for rpy in ([0.1, -0.4, 2.9], [-3.0, 1.2, 0.0], [0.7, np.pi / 2.0, 0.0]):
        R = frames.rotation_from_rpy(rpy)
        assert frames.rpy(R) == pytest.approx(rpy, abs=1e-7)
