# SPDX-License-Identifier: Apache-2.0
"""Has a measured tool moved? By chance alone it looks so as often as is said."""

import json
from dataclasses import replace

import numpy as np
import pytest
from beam_cell import make_cell
from long_form import amount

from bench.measured_runs import TAUGHT, laser_of
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise
from robocal_ros.ground import frames
from robocal_ros.tool.crossed_model import Held
from robocal_ros.tool.judging import (
    UNCHANGED,
    CheckRule,
    KnownTool,
    QuickCheck,
    changed_tool,
    quick_check,
    unchanged,
)
from robocal_ros.tool.laser_frame import LaserFrame

LASER_M = 2.2e-5  # of each point of a frame that the same robot has calibrated
ROBOT_M = np.array([4e-4, -2e-4, 3e-4])  # absolute error: the same in each run
TOOL = RoundTool.cylinder(TAUGHT, 0.0025)
TRIALS, ROOM = 2000, 4.0
BY_CHANCE = 1.0 - UNCHANGED


@pytest.fixture(scope="module")
def cell():
    """A station whose laser frame is off by what its sigma says."""
    source = TrueInput(latency_s=0.004, sample_period_s=0.002)
    cell = make_cell(exact=False, source=source, noise=TrueNoise(3e-5, 1e-5))
    points, random = laser_of(cell.station).points, np.random.default_rng(1)
    cell.laser = LaserFrame(points + LASER_M * random.standard_normal(points.shape), LASER_M)
    return cell


@pytest.fixture(scope="module")
def runs(cell) -> list[KnownTool]:
    """Of one tool at one station."""
    measured = [
        cell.full_run(TOOL, TAUGHT, np.random.default_rng(i)) for i in range(amount(24, 60))
    ]
    return [KnownTool.measured(run.estimate(Held())) for run in measured]


def moved(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A tool (4, 4) moved by (5,): the tip, flange axes, and tilts along its own x and y."""
    turn = frames.exp_rotation(T[:3, :3] @ [-by[4], by[3], 0.0])
    return frames.transform(turn @ T[:3, :3], T[:3, 3] + by[:3])


def away(found: KnownTool, other: KnownTool) -> np.ndarray:
    """(5,) from one tool to another."""
    R = other.T_flange_tool[:3, :3]
    lean = R[:, :2].T @ (found.T_flange_tool[:3, 2] - other.T_flange_tool[:3, 2])
    return np.append(found.T_flange_tool[:3, 3] - other.T_flange_tool[:3, 3], lean)


def test_two_runs_differ_by_what_is_their_own(runs):
    """Chi-square of five numbers for each pair; the laser frame is alike in both."""
    squared = 0.0
    for one, other in zip(runs[::2], runs[1::2], strict=True):
        both = one.own_covariance + other.own_covariance
        squared += away(one, other) @ np.linalg.solve(both, away(one, other))
    count = 5 * len(runs) // 2
    assert squared == pytest.approx(count, abs=ROOM * np.sqrt(2.0 * count))
    own, whole = (np.trace(c[:3, :3]) for c in (runs[0].own_covariance, runs[0].covariance))
    assert own < whole


def checked(cell, stored: KnownTool, seed: int) -> QuickCheck:
    run = cell.quick_run(TOOL, stored.T_flange_tool, np.random.default_rng(seed))
    return quick_check(cell.laser, run.path, run.steps, stored, CheckRule(), noise=cell.robot)


def test_a_check_is_away_from_the_tool_in_force_by_what_its_covariance_says(cell, runs):
    """Taught, as its healthy run measured it: that run's own noise counts, the laser's does not."""
    squared = 0.0
    for seed, healthy in enumerate(runs):
        stored = KnownTool.taught(TAUGHT, healthy)
        stored = replace(stored, T_flange_tool=healthy.T_flange_tool)
        found = checked(cell, stored, 1000 + seed)
        squared += found.deviation @ np.linalg.solve(found.covariance, found.deviation)
    count = 3 * len(runs)
    assert squared == pytest.approx(count, abs=ROOM * np.sqrt(2.0 * count))


def test_a_check_knows_less_of_a_tool_from_an_older_history(cell, runs):
    first, second = runs[:2]
    kept = replace(changed_tool(TAUGHT, first, second), T_flange_tool=second.T_flange_tool)
    sigma = [checked(cell, tool, 7).sigma_m for tool in (kept, replace(kept, own_covariance=None))]
    assert sigma[0] < sigma[1]


class Draws:
    """Measurements as far off as a run's covariance says, all through one laser frame."""

    def __init__(self, run: KnownTool, seed: int) -> None:
        self._run, self._random = run, np.random.default_rng(seed)
        self._laser = self._error(run.covariance - run.own_covariance)

    def _error(self, covariance: np.ndarray) -> np.ndarray:
        value, way = np.linalg.eigh(covariance)
        size = np.sqrt(np.maximum(value, 0.0)) * self._random.standard_normal(len(value))
        return way @ size

    def measured(self, tool: np.ndarray = TAUGHT) -> KnownTool:
        """A tool as a run shows it."""
        error = self._error(self._run.own_covariance) + self._laser
        error[:3] += ROBOT_M
        return replace(self._run, T_flange_tool=moved(tool, error))


def said_to_have_moved(run: KnownTool, in_force: str, move_m: float, parts: bool = True) -> float:
    """Share of measurements of a tool that did move by so much; ``parts`` of covariances known."""
    said = 0
    away = moved(TAUGHT, np.array([move_m, 0.0, 0.0, 0.0, 0.0]))
    for seed in range(TRIALS):
        draws = Draws(run, seed)
        healthy = draws.measured()
        kept = KnownTool.taught(TAUGHT, healthy)
        if in_force == "measured":
            kept = changed_tool(TAUGHT, healthy, draws.measured())
        found = changed_tool(TAUGHT, healthy, draws.measured(away))
        if not parts:
            kept, found = replace(kept, own_covariance=None), replace(found, own_covariance=None)
        said += not unchanged(found, kept)
    return said / TRIALS


@pytest.mark.long
@pytest.mark.parametrize("in_force", ["taught", "measured"])
def test_a_tool_that_did_not_move_is_taken_for_another_in_five_percent(runs, in_force):
    room = ROOM * np.sqrt(BY_CHANCE * UNCHANGED / TRIALS)
    assert said_to_have_moved(runs[0], in_force, 0.0) == pytest.approx(BY_CHANCE, abs=room)


@pytest.mark.long
def test_a_move_is_found_more_often_than_with_all_noise_counted_twice(runs):
    """0.1 mm: some three sigmas of the difference."""
    now = said_to_have_moved(runs[0], "measured", 1e-4)
    before = said_to_have_moved(runs[0], "measured", 1e-4, parts=False)
    assert now - before > ROOM * np.sqrt(0.5 / TRIALS)


@pytest.mark.parametrize("in_force", ["taught", "measured"])
def test_of_an_older_history_whole_covariances_count(runs, in_force):
    """Nothing is taken for another tool more often than is said."""
    room = ROOM * np.sqrt(BY_CHANCE * UNCHANGED / TRIALS)
    assert said_to_have_moved(runs[0], in_force, 0.0, parts=False) < BY_CHANCE + room


def test_a_tool_is_read_as_it_was_kept(runs):
    healthy, first, second = runs[:3]
    kept = changed_tool(TAUGHT, healthy, first)
    found = changed_tool(TAUGHT, healthy, second)
    read = KnownTool.of_document(json.loads(json.dumps(kept.document())))
    for name in ("T_flange_tool", "covariance", "own_covariance", "against"):
        assert np.array_equal(getattr(read, name), getattr(kept, name)), name
    assert unchanged(found, read) == unchanged(found, kept)
    older = {name: kept.document()[name] for name in ("T_flange_tool", "covariance")}
    assert KnownTool.of_document(older).own_covariance is None
    assert KnownTool.of_document(KnownTool(TAUGHT).document()).covariance is None


def test_without_a_healthy_run_a_measurement_is_never_the_taught_tool(runs):
    """How far off the robot is as a whole nobody knows."""
    assert not unchanged(runs[0], KnownTool(TAUGHT))
    assert not unchanged(runs[0], KnownTool(runs[0].T_flange_tool))
    assert unchanged(runs[0], runs[0])


def test_changes_against_two_healthy_runs_count_whole(runs):
    """Another healthy run brings its own error, which does not cancel."""
    first, second, one = runs[:3]
    kept, found = changed_tool(TAUGHT, first, one), changed_tool(TAUGHT, second, one)
    whole = kept.covariance + found.covariance
    value, way = np.linalg.eigh(whole)
    by = 3.0 * np.sqrt(value[0]) * way[:, 0]  # chi-square 9 of 11.1 allowed
    found = replace(found, T_flange_tool=moved(kept.T_flange_tool, by))
    assert unchanged(found, kept)
    assert not unchanged(replace(found, against=kept.against), kept)
