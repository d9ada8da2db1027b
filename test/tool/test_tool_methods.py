# SPDX-License-Identifier: Apache-2.0
"""The other ways to a tool: four and seven touches, two parallel beams."""

import numpy as np
import pytest

from robocal_ros.cell_sim.beams import RoundTool, Sweep, TrueBeam, bent, crossings
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.tool.edges import ParallelStation
from robocal_ros.tool.laser_frame import minimal_rotation
from robocal_ros.tool.touch_points import Edges, fit_four, fit_parallel, fit_seven

TIP = np.array([0.012, -0.034, 0.21])
POINT = np.array([0.9, 0.2, 0.5])
SIGMA = 1e-4


def touches(count: int = 6, seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """Flange poses that bring the tip to one point, turned by up to 40 deg each way."""
    random = np.random.default_rng(seed)
    R = frames.exp_rotation(random.uniform(-0.7, 0.7, (count, 3)) + np.array([np.pi, 0.0, 0.0]))
    t = POINT - R @ TIP + noise * random.standard_normal((count, 3))
    return frames.transform(R, t)


def test_four_touches_give_the_tip():
    found = fit_four(touches(4))
    assert found.tip == pytest.approx(TIP, abs=1e-10)
    assert found.point == pytest.approx(POINT, abs=1e-10)
    assert found.verdict.accept


def test_touches_scatter_as_the_covariance_says():
    """Same poses, 400 draws: chi-square of 1200 degrees."""
    exact = touches(5)
    random, squared = np.random.default_rng(1), 0.0
    for _ in range(400):
        T = exact.copy()
        T[:, :3, 3] += SIGMA * random.standard_normal((5, 3))
        found = fit_four(T, SIGMA)
        error = found.tip - TIP
        # The fit widens a covariance that its own residuals contradict; here they are the truth.
        squared += error @ np.linalg.solve(found.covariance / found.estimate.scale**2, error)
    assert squared == pytest.approx(1200.0, abs=4.0 * np.sqrt(2400.0))


def test_moving_the_base_does_not_move_the_tip():
    T = touches(5, noise=SIGMA)
    move = frames.transform(frames.exp_rotation([0.4, 0.9, -0.3]), [1.0, -2.0, 0.3])
    assert fit_four(move @ T).tip == pytest.approx(fit_four(T).tip, abs=1e-10)


def test_poor_touches_fail_the_verdict():
    T = touches(6)
    T[2, :3, 3] += [0.004, -0.003, 0.002]
    T[4, :3, 3] -= [0.005, 0.001, 0.0]
    verdict = fit_four(T[:6]).verdict
    assert verdict.code is Code.RESIDUAL_TOO_LARGE
    assert "Euler convention" in verdict.reason


def test_too_few_touches_or_one_axis_are_refused():
    with pytest.raises(TooFewSamplesError, match="3 touches: at least 4"):
        fit_four(touches(3))
    R = frames.exp_rotation(np.outer([0.0, 0.5, 1.0, 1.5, 2.0], [0.0, 0.6, 0.8]))
    one_axis = frames.transform(R, POINT - R @ TIP)
    with pytest.raises(RankDeficientError, match=r"determine 5 of 6 .* about a second axis"):
        fit_four(one_axis)
    small = frames.exp_rotation(0.01 * np.random.default_rng(0).standard_normal((6, 3)))
    with pytest.raises(RankDeficientError, match="about a second axis"):
        fit_four(frames.transform(small, POINT - small @ TIP))


def seven(R_flange_tool: np.ndarray, x=(0.1, 0.0, 0.0), z=(0.0, 0.0, 0.1)) -> np.ndarray:
    """Four touches, then the aligned tool moved along x and z of the base."""
    last = np.tile(frames.transform(R_flange_tool.T, [0.8, 0.1, 0.6]), (3, 1, 1))
    last[1:, :3, 3] += x
    last[2:, :3, 3] += z
    return np.concatenate([touches(4), last])


def test_seven_points_give_the_orientation_too():
    R = frames.exp_rotation([0.3, 2.9, -0.4])
    found = fit_seven(seven(R))
    assert found.tip == pytest.approx(TIP, abs=1e-10)
    assert found.rotation == pytest.approx(R, abs=1e-10)


def test_seven_points_with_slanted_moves_stay_a_rotation():
    found = fit_seven(seven(np.eye(3), z=(0.002, 0.0, 0.1)))
    assert found.rotation.T @ found.rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.norm(frames.log_rotation(found.rotation)) == pytest.approx(0.01, rel=0.01)


def test_moves_that_give_no_axes_are_refused():
    with pytest.raises(RankDeficientError, match=r"a move of 5\.0 mm gives no direction"):
        fit_seven(seven(np.eye(3), x=(0.005, 0.0, 0.0)))
    with pytest.raises(RankDeficientError, match="nearly parallel"):
        fit_seven(seven(np.eye(3), z=(0.1, 0.0, 0.01)))
    turned = seven(np.eye(3))
    turned[-1, :3, :3] = frames.exp_rotation([0.0, 0.01, 0.0])
    with pytest.raises(InputError, match=r"turned by 0\.573 deg"):
        fit_seven(turned)


X_BEAM = 0.8
BEAMS = ParallelStation(0.40, 0.36, X_BEAM)
R_FIRST = np.column_stack([[-1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]])  # y_e along y_b, z_e down
R_TURNED = np.column_stack([[0, 1.0, 0], [1.0, 0, 0], [0, 0, -1.0]])  # x_e along y_b
QUARTER = frames.exp_rotation([0.0, 0.0, np.pi / 2.0])


def sweep(name: str, tool: RoundTool, R: np.ndarray) -> Edges:
    """Flange poses at the edges of the upper and the lower beam."""
    start = frames.transform(R, [X_BEAM - 0.03, 0.0, 0.53])
    move = Sweep(start, np.array([0.06, 0.0, 0.0]), 1.0)
    found = {}
    for at, h in (("up", BEAMS.up_m), ("down", BEAMS.down_m)):
        beam = TrueBeam(np.array([X_BEAM, -0.1, h]), np.array([X_BEAM, 0.1, h]))
        time, _ = crossings(beam, tool, move, move.window, 0.0, np.random.default_rng(0))
        found[name, at] = move(time)
    return found


def test_parallel_beams_find_axis_and_tip():
    truth = bent(frames.transform(np.eye(3), [0.0, 0.0, 0.2]), [4e-3, -3e-3, 1e-3], [0.06, 0.04, 0])
    tool = RoundTool.cylinder(truth, 0.003)
    first = sweep("straight", tool, R_FIRST) | sweep("turned", tool, R_TURNED)
    v = fit_parallel(BEAMS, first).axis
    assert v == pytest.approx(truth[:3, 2], abs=1e-9)
    straight = minimal_rotation(R_FIRST @ v, [0.0, 0.0, -1.0]) @ R_FIRST
    again = sweep("upright", tool, straight) | sweep("upright_turned", tool, QUARTER @ straight)
    z = BEAMS.up_m - (straight @ truth[:3, 3])[2]  # where the tip reaches the upper beam
    plunge = {("plunge", "up"): frames.transform(straight, [X_BEAM, 0.0, z])[None]}
    tip = fit_parallel(BEAMS, first | again | plunge).tip
    assert tip == pytest.approx(truth[:3, 3], abs=1e-8)


def test_parallel_beams_refuse_what_they_cannot_tell():
    def swept(turned: np.ndarray, lean_m: float = 0.0) -> Edges:
        """All sweeps of a tool that stands upright, or leans, when it was set so."""
        found = {("plunge", "up"): frames.transform(R_FIRST, [X_BEAM, 0.0, 0.6])[None]}
        for name, R, lean in (
            ("straight", R_FIRST, 0.0), ("turned", R_TURNED, 0.0),
            ("upright", R_FIRST, lean_m), ("upright_turned", turned, lean_m),
        ):  # fmt: skip
            for beam, off in (("up", 0.0), ("down", lean)):
                places = np.array([[x + off, 0.0, 0.5] for x in (0.79, 0.81)])
                found[name, beam] = frames.transform(R, places)
        return found

    with pytest.raises(RankDeficientError, match=r"beams are 1\.00 mm apart in height"):
        ParallelStation(0.401, 0.4, X_BEAM)
    lacking = swept(R_TURNED)
    lacking["straight", "down"] = lacking["straight", "down"][:1]
    with pytest.raises(InputError, match="beam down: 1 edges; each pass of the tool has a break"):
        fit_parallel(BEAMS, lacking)
    unknown = swept(R_TURNED)
    unknown["turned", "up"][0, 2, 3] = np.nan
    with pytest.raises(InputError, match="sweep turned, beam up: a flange pose is not finite"):
        fit_parallel(BEAMS, unknown)
    with pytest.raises(ResidualError, match=r"leans by 1\.000 mm"):
        fit_parallel(BEAMS, swept(R_TURNED, 1e-3))
    with pytest.raises(RankDeficientError, match="turn the flange by 90 deg"):
        fit_parallel(BEAMS, swept(R_FIRST))
