# SPDX-License-Identifier: Apache-2.0
"""A run against the healthy tool's: what is no bend ends it, with its own code. Simulated."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tool_driver import TAUGHT, TRUTH

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.ground.errors import Code, RobocalError, TooFewSamplesError
from robocal_ros.ground.samples import JointSample
from robocal_ros.tool.edges import BeamError
from robocal_ros.tool.run import ClockError, RunTraits, TraitLimits, WrongToolError, require_even

RADIUS_M = 2.5e-3
SECOND_NS = 1_000_000_000


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


LIMITS = TraitLimits()
SIGMA_M, SIGMA_S = 1e-5, 1e-3
HEALTHY = RunTraits(
    {"low": (2.6e-3, 2.4e-3), "high": (2.9e-3, 2.7e-3)}, SIGMA_M, 4e-3, SIGMA_S, 125.0
)
TRIALS = 400


def quick(x_m: float = 0.0, y_m: float = 0.0, later_s: float = 0.0) -> RunTraits:
    """A check with so much more radius in each beam."""
    radius = {"circle": (2.6e-3 + x_m, 2.4e-3 + y_m)}
    return RunTraits(radius, SIGMA_M, 4e-3 + later_s, SIGMA_S, 125.0)


def test_they_survive_json():
    assert RunTraits.of_document(json.loads(json.dumps(HEALTHY.document()))) == HEALTHY


def test_a_run_like_the_healthy_one_is_let_through():
    quick().require_like(HEALTHY, LIMITS)
    HEALTHY.require_like(HEALTHY, LIMITS)
    replace(HEALTHY, radius_m={"other": (1.0, 1.0)}).require_like(HEALTHY, LIMITS)


@pytest.mark.parametrize(
    ("run", "kind", "words"),
    [
        (quick(x_m=2e-4), BeamError, "beam x is dirty"),
        (quick(y_m=-2e-4), BeamError, "beam y is dirty"),
        (quick(2e-4, 2e-4), WrongToolError, "another tool is mounted"),
        (quick(-2e-4, -2e-4), WrongToolError, "this one is worn"),
        (quick(later_s=0.02), ClockError, "24.0 ms behind the joint readings"),
        (quick(later_s=-0.02), ClockError, "a clock has jumped"),
    ],
)
def test_what_no_bend_changes_is_refused(run, kind, words):
    with pytest.raises(kind, match=words):
        run.require_like(HEALTHY, LIMITS)


def refused(draws) -> dict[Code, float]:
    """Share of runs that are refused, by code."""
    found = {}
    for run in draws:
        try:
            run.require_like(HEALTHY, LIMITS)
        except RobocalError as error:
            found[error.code] = found.get(error.code, 0.0) + 1.0 / TRIALS
    return found


def drawn(x_m: float, y_m: float, later_s: float):
    """Runs with these true changes; the healthy one's noise comes in once more."""
    rng = np.random.default_rng(5)
    for _ in range(TRIALS):
        noise = np.sqrt(2.0) * rng.standard_normal(3)
        yield quick(
            x_m + SIGMA_M * noise[0], y_m + SIGMA_M * noise[1], later_s + SIGMA_S * noise[2]
        )


MOST = 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / TRIALS)  # of what may be 5 %, in so many trials


@pytest.mark.parametrize(
    ("x", "y", "later_s", "code"),
    [
        (LIMITS.radius_m, 0.0, 0.0, Code.BEAM_EDGES_WRONG),
        (LIMITS.radius_m, LIMITS.radius_m, 0.0, Code.WRONG_TOOL),
        (0.0, 0.0, LIMITS.latency_s, Code.CLOCK_WRONG),
    ],
)
def test_a_change_at_the_limit_is_refused_in_five_percent(x, y, later_s, code):
    assert 0.0 < refused(drawn(x, y, later_s))[code] < MOST


@pytest.mark.parametrize(
    ("x", "y", "later_s", "code"),
    [
        # Beyond the limit by 1.645 + 1.282 sigmas: found in 90 %; by four, in 99 %.
        (LIMITS.radius_m + 4.0 * 2.0 * SIGMA_M, 0.0, 0.0, Code.BEAM_EDGES_WRONG),
        (LIMITS.radius_m + 4.0 * SIGMA_M, LIMITS.radius_m + 4.0 * SIGMA_M, 0.0, Code.WRONG_TOOL),
        (0.0, 0.0, LIMITS.latency_s + 4.0 * np.sqrt(2.0) * SIGMA_S, Code.CLOCK_WRONG),
    ],
)
def test_a_change_clearly_beyond_is_found_by_its_code(x, y, later_s, code):
    assert refused(drawn(x, y, later_s))[code] > 0.95


@pytest.mark.parametrize(("lost", "found"), [(0.0, False), (0.05, False), (0.2, True)])
def test_readings_that_are_lost_are_counted(lost, found):
    rng = np.random.default_rng(3)
    said = 0
    for _ in range(TRIALS):
        count = rng.binomial(375, 1.0 - lost)  # in three seconds
        try:
            HEALTHY.require_readings(int(count), 3.0, LIMITS)
        except TooFewSamplesError:
            said += 1
    assert said / TRIALS > 0.95 if found else said / TRIALS < MOST


def test_a_faster_driver_loses_nothing():
    HEALTHY.require_readings(1500, 3.0, LIMITS)
    HEALTHY.require_readings(0, 0.0, LIMITS)


def test_a_limit_of_zero_is_not_looked_at():
    off = TraitLimits(0.0, 0.0, 0.0)
    quick(2e-4, 2e-4, later_s=1.0).require_like(HEALTHY, off)
    HEALTHY.require_readings(1, 3.0, off)
    require_even([60.0, 125.0], off)


@pytest.mark.parametrize(
    ("run", "kind"),
    [
        (quick(x_m=np.nan), BeamError),
        (replace(quick(), radius_sigma_m=np.nan), BeamError),
        (quick(later_s=np.nan), ClockError),
    ],
)
def test_not_a_number_is_let_through_nowhere(run, kind):
    with pytest.raises(kind):
        run.require_like(HEALTHY, LIMITS)


def test_a_healthy_run_under_loss_is_none():
    require_even([125.0, 121.0, 124.0], LIMITS)
    with pytest.raises(TooFewSamplesError, match="113 to 125 in a second"):
        require_even([125.0, 113.0, 124.0], LIMITS)
