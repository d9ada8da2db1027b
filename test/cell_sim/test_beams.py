# SPDX-License-Identifier: Apache-2.0
"""True edges against distances that can be written down."""

from dataclasses import replace

import numpy as np
import pytest

from bench.measured_runs import NO_NOISE, PERFECT
from robocal_ros.cell_sim.beams import (
    BeamStation,
    Circle,
    Plunge,
    RoundTool,
    Sweep,
    TrueBeam,
    TrueInput,
    TrueNoise,
    beams_of,
    bent,
    reported,
)
from robocal_ros.ground import frames

UPRIGHT = frames.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.15])
TOOL = frames.transform(np.eye(3), [0.0, 0.0, 0.15])
X_BEAM = TrueBeam(np.array([-0.05, 0.0, 0.0]), np.array([0.05, 0.0, 0.0]))


def station(**changes) -> BeamStation:
    settings = {"input": PERFECT, "noise": NO_NOISE} | changes
    return BeamStation(beams_of(np.eye(4), np.pi / 2.0), **settings)


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_clearance_of_a_cylinder_is_distance_less_radius():
    T = np.tile(UPRIGHT, (3, 1, 1))
    T[:, 1, 3] = [0.0, 0.003, -0.007]
    T[:, 2, 3] -= 0.03
    tool = RoundTool.cylinder(TOOL, 0.0025)
    assert X_BEAM.clearance(tool, T) == pytest.approx([-0.0025, 0.0005, 0.0045], abs=1e-15)


def test_clearance_of_a_tip_is_that_of_its_sphere():
    T = np.tile(UPRIGHT, (2, 1, 1))
    T[:, 2, 3] += [0.004, 0.0]  # the tip above the beam, and at it
    tool = RoundTool.cylinder(TOOL, 0.002)
    assert X_BEAM.clearance(tool, T) == pytest.approx([0.004, 0.0], abs=1e-15)


def test_a_cone_has_its_radius_at_the_height_of_the_beam():
    """Level beam, upright cone: distance of a point from a flank is (y - r) cos(half angle)."""
    taper, tip_radius, height = 0.1, 0.001, 0.04
    tool = RoundTool.cone(TOOL, tip_radius, taper)
    T = UPRIGHT[None].copy()
    T[0, :3, 3] += [0.0, 0.012, -height]
    half_angle = np.arctan(taper)
    apex_below_tip = tip_radius / np.sin(half_angle) - tip_radius
    radius = (height + apex_below_tip) * taper
    wanted = (0.012 - radius) * np.cos(half_angle)
    assert X_BEAM.clearance(tool, T)[0] == pytest.approx(wanted, abs=1e-15)


def test_clearance_agrees_with_points_of_the_surface():
    """The smallest distance over many spheres between the given ones, all tilted."""
    tool = RoundTool.torch(bent(TOOL, [0.002, 0.001, 0.0], [0.1, -0.2, 0.3]), 0.0006, 0.004)
    T = frames.transform(frames.exp_rotation([np.pi - 0.1, 0.05, 0.2]), [0.03, 0.01, 0.13])[None]
    pose = T[0] @ tool.T_flange_tool
    share = np.linspace(0.0, 1.0, 4001)
    least = np.inf
    u = (X_BEAM.end - X_BEAM.start) / np.linalg.norm(X_BEAM.end - X_BEAM.start)
    for i in range(len(tool.height) - 1):
        height = tool.height[i] + share * (tool.height[i + 1] - tool.height[i])
        radius = tool.radius[i] + share * (tool.radius[i + 1] - tool.radius[i])
        centre = pose[:3, 3] - height[:, None] * pose[:3, 2] - X_BEAM.start
        distance = np.linalg.norm(centre - (centre @ u)[:, None] * u, axis=1)
        least = min(least, float(np.min(distance - radius)))
    assert X_BEAM.clearance(tool, T)[0] == pytest.approx(least, abs=1e-7)
    assert X_BEAM.clearance(tool, T)[0] <= least + 1e-15


def test_a_mandrel_breaks_a_beam_as_the_tool_does():
    beside = TOOL @ frames.transform(np.eye(3), [0.0, 0.004, 0.0])
    tool = replace(RoundTool.cylinder(TOOL, 0.001), mandrel=RoundTool.cylinder(beside, 0.001))
    start = UPRIGHT.copy()
    start[:3, 3] += [0.003, -0.01, -0.02]
    sweep = Sweep(start, np.array([0.0, 0.02, 0.0]), 1.0)
    edges = [e for e in station().edges(tool, sweep, sweep.window, rng()) if e.beam == "x"]
    assert [e.blocked for e in edges] == [True, False, True, False]
    apart_s = edges[2].time_s - edges[0].time_s
    assert apart_s == pytest.approx(0.2, abs=1e-12)  # 4 mm at 20 mm/s
    bent_tool = tool.mounted(TOOL @ frames.transform(np.eye(3), [0.0, 0.001, 0.0]))
    assert bent_tool.mandrel is tool.mandrel


def test_edges_of_a_sweep_are_where_the_tool_touches():
    start = UPRIGHT.copy()
    start[:3, 3] += [0.003, -0.005, -0.02]
    sweep = Sweep(start, np.array([0.0, 0.01, 0.0]), 1.0)
    edges = station().edges(RoundTool.cylinder(TOOL, 0.001), sweep, sweep.window, rng())
    assert [e.blocked for e in edges if e.beam == "x"] == [True, False]
    times = [e.time_s for e in edges if e.beam == "x"]
    assert times == pytest.approx([0.4, 0.6], abs=1e-12)


def test_a_wide_beam_with_hysteresis_breaks_late_and_restores_late():
    beam = TrueBeam(X_BEAM.start, X_BEAM.end, 0.001, dark_at=0.3, light_at=0.7)
    assert beam.threshold(0.5) == pytest.approx(0.0, abs=1e-15)
    assert beam.threshold(beam.dark_at) < 0.0 < beam.threshold(beam.light_at)
    assert beam.threshold(0.3) == pytest.approx(-beam.threshold(0.7), abs=1e-15)
    x = beam.threshold(0.7) / 0.0005  # area of a segment of the unit circle
    assert 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi == pytest.approx(0.7, abs=1e-9)


def test_circle_runs_at_constant_speed_in_its_window_and_rests_at_its_ends():
    move = Circle(UPRIGHT, np.eye(3), 0.012, 1.5, start_s=1.0, direction=-1)
    t = np.linspace(1.0, 2.5, 50)
    angle = np.unwrap(np.arctan2(move(t)[:, 1, 3], move(t)[:, 0, 3]))
    assert np.diff(angle) == pytest.approx(np.full(49, -2.0 * np.pi / 49.0), abs=1e-9)
    ends = np.array([move.span[0], move.span[0] + 1e-4, move.span[1] - 1e-4, move.span[1]])
    assert np.linalg.norm(np.diff(move(ends)[:, :3, 3], axis=0)[[0, 2]], axis=1).max() < 1e-7


def test_a_plunge_goes_down_at_its_speed_and_returns():
    move = Plunge(UPRIGHT, np.array([0.0, 0.0, -1.0]), 0.006, 0.01)
    first, last = move.window
    assert last - first == pytest.approx(1.4)
    time = np.linspace(first, last, 1401)
    height = move(time)[:, 2, 3] - UPRIGHT[2, 3]
    assert height[[0, 700, 1400]] == pytest.approx([0.0, -0.006, 0.0], abs=1e-12)
    speed = np.diff(height) / np.diff(time)
    assert np.abs(speed).max() == pytest.approx(0.01, rel=1e-9)
    assert np.abs(np.diff(speed)).max() < 1.1 * 0.01 * 1e-3 / 0.1  # no jump


def test_a_sampled_input_is_late_by_a_uniform_part_of_a_period():
    late = (
        np.array(
            [
                reported(0.123456, TrueInput(0.004, 0.0, 0.002), np.random.default_rng(i))
                for i in range(4000)
            ]
        )
        - 0.123456
    )
    assert late.min() >= 0.004
    assert late.max() <= 0.006
    assert late.mean() == pytest.approx(0.005, abs=4.0 * 0.002 / np.sqrt(12.0 * 4000))
    assert late.std() == pytest.approx(0.002 / np.sqrt(12.0), rel=4.0 / np.sqrt(4000.0))


def test_bounces_and_lost_edges():
    lower = frames.transform(UPRIGHT[:3, :3], [0.0, 0.0, 0.13])
    move = Circle(lower, np.eye(3), 0.012, 2.0)
    tool = RoundTool.cylinder(TOOL, 0.002)
    bounced = station(input=TrueInput(0.0, 0.0, bounce_s=2e-4))
    assert len(bounced.edges(tool, move, move.window, rng())) == 24
    lost = station(input=TrueInput(0.0, 0.0, lost_share=1.0))
    assert lost.edges(tool, move, move.window, rng()) == []


@pytest.mark.long
def test_repeatability_shifts_a_step_and_scatters_edges():
    """A sweep at 10 mm/s: middle of a shadow scatters by the step, its width by the edges."""
    start = UPRIGHT.copy()
    start[:3, 3] += [0.003, -0.005, -0.02]
    sweep = Sweep(start, np.array([0.0, 0.01, 0.0]), 1.0)
    noisy, random = station(noise=TrueNoise(3e-5, 1e-5)), rng()
    tool = RoundTool.cylinder(TOOL, 0.001)
    found = []
    for _ in range(400):
        edges = noisy.edges(tool, sweep, sweep.window, random)
        found.append([0.01 * e.time_s for e in edges if e.beam == "x"])
    first, last = np.array(found).T
    loose = 4.0 / np.sqrt(800.0)
    middle = np.hypot(3e-5, 1e-5 / np.sqrt(2.0))
    assert np.std(0.5 * (first + last)) == pytest.approx(middle, rel=loose)
    assert np.std(last - first) == pytest.approx(1e-5 * np.sqrt(2.0), rel=loose)
