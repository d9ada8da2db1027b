# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

import numpy as np
from command import robocal_json
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from tool_runs import run_tables

from robocal_ros.report.figures import svg
from robocal_ros.report.measured_figures import CELLS, errors_figure, result_figure

DRAWS = 20_000
# Of a share of 0.95 in so many draws: five standard deviations.
CHANCE = 5.0 * np.sqrt(0.95 * 0.05 / DRAWS)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-12.0, -6.0))
def test_the_ellipses_hold_95_percent_of_what_the_covariance_says(seed, exponent):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 10.0 ** (exponent / 2.0)
    covariance = root @ root.T
    figure = result_figure({"a": [0.1]}, covariance, place="it")
    draws_mm = 1e3 * rng.multivariate_normal(np.zeros(3), covariance, DRAWS)
    planes = [axes for axes in figure.axes if axes.get_aspect() == 1.0]
    assert [(axes.get_xlabel()[0], axes.get_ylabel()[0]) for axes in planes] == [
        ("x", "y"),
        ("x", "z"),
        ("y", "z"),
    ]
    for axes, plane in zip(planes, ([0, 1], [0, 2], [1, 2]), strict=True):
        outline = axes.lines[0].get_xydata()
        inside = Outline(outline).contains_points(draws_mm[:, plane])
        # The outline has 180 sides: 1 - pi² / (6 · 90²) of the ellipse, less than the chance.
        assert abs(inside.mean() - 0.95) < CHANCE
        low, high = (np.array(pair) for pair in zip(axes.get_xlim(), axes.get_ylim(), strict=True))
        assert np.all(outline > low)
        assert np.all(outline < high)


def test_what_is_not_known_is_not_drawn():
    assert len(result_figure({"a": [0.1]}, None, place="it").axes) == 1
    seen = {"a": np.zeros((5, 2))}
    assert len(result_figure({"a": [0.1]}, np.eye(3), place="it", seen=seen).axes) == 5


def test_each_sample_has_its_residuals_above_its_name():
    left = {"low": [0.01, -0.02], "high": [0.03]}
    axes = result_figure(left, None, place="it", rms_mm=0.02).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["low", "high"]
    drawn = [line.get_xydata().tolist() for line in axes.lines[:2]]
    assert drawn == [[[0, 0.01], [0, -0.02]], [[1, 0.03]]]


def test_each_cell_of_the_workspace_has_the_mean_error_of_its_poses():
    place = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 3))
    before = 1e-3 * (2.0 + place[:, 0])  # known wherever a cell is
    figure = errors_figure(place, {"before": before, "after": 0.1 * before})
    views = [axes.collections[0] for axes in figure.axes[:4]]
    above = views[0]
    x_mm = above.get_offsets()[:, 0]
    width_mm = 2000.0 / CELLS
    assert len(x_mm) > 0.8 * CELLS**2 / np.sqrt(3.0)  # cells in the square, nearly all with poses
    assert np.all(np.abs(above.get_array() - 2.0 - 1e-3 * x_mm) < 1e-3 * width_mm)
    for one, tenth in zip(views[:2], views[2:], strict=True):
        np.testing.assert_allclose(tenth.get_array(), 0.1 * one.get_array(), rtol=1e-12)
        assert tenth.norm is one.norm  # one scale of colours
    assert "before: mean 2.0" in figure.axes[0].get_title(loc="left")


def test_errors_of_one_pose_and_of_exact_data_are_drawn():
    for errors in (np.array([1e-4]), np.zeros(5)):
        figure = errors_figure(np.ones((len(errors), 3)), {"a": errors, "b": errors})
        assert svg(figure).startswith("<svg")


def test_a_run_draws_its_figure_where_it_is_asked_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_tables(tmp_path)
    run = ["tool", "crossed", "--robot", "ur10", "--laser", "laser.yaml", "--taught-mm=0,0,150",
           "--sample-period-s", "0.002", "--joints", "joints.csv",
           "--events", "run.csv"]  # fmt: skip
    plain = robocal_json("tool.crossed.json", *run)
    drawn = robocal_json("tool.crossed.json", *run, "--figures", "new/folder")
    assert plain["figures"] is None
    assert Path(drawn["figures"]) == Path("new/folder/tool.svg")
    assert (tmp_path / "new/folder/tool.svg").read_text().startswith("<svg")
    assert json.dumps(drawn | {"figures": None}) == json.dumps(plain)
