"""The station's housing: distances of capsules against points drawn within them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.ground.errors import InputError
from robocal_ros.motion.cell import Housing, ToolBody

HOUSING = Housing(clear_radius_m=0.04, top_m=0.02, floor_m=-0.08, retract_m=0.04)


def solid(points):
    """Whether points (..., 3) of the laser frame are in the housing."""
    across = np.hypot(points[..., 0], points[..., 1])
    beside = (across > HOUSING.clear_radius_m) & (points[..., 2] < HOUSING.top_m)
    return beside | (points[..., 2] < HOUSING.floor_m)


def within(start, end, radius, rng, count=20000):
    """Points on the surface of a capsule."""
    on_axis = start + rng.random((count, 1)) * (end - start)
    out = rng.normal(size=(count, 3))
    return on_axis + radius * out / np.linalg.norm(out, axis=1)[:, None]


places = st.tuples(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.1, 0.1))


@given(start=places, end=places, radius=st.floats(1e-3, 0.02), seed=st.integers(0, 9))
@settings(max_examples=200, deadline=None)
def test_what_counts_as_clear_has_no_point_in_the_housing(start, end, radius, seed):
    start, end = np.array(start), np.array(end)
    cut = float(HOUSING.cut_by(start[None], end[None], radius)[0])
    # never refused for more than the corner of the square around the round at the rim
    allowed = (np.sqrt(2.0) - 1.0) * radius + 2e-3  # and the draw's coarseness
    grown = radius + (allowed if cut > 0.0 else -1e-12)
    points = within(start, end, grown, np.random.default_rng(seed))
    assert np.any(solid(points)) == (cut > 0.0)


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        ([0.035, 0.0, 0.0], [0.035, 0.0, 0.1], 0.0),  # upright in the opening
        ([0.038, 0.0, 0.0], [0.038, 0.0, 0.1], 0.002),  # on its wall
        ([0.0, 0.0, -0.077], [0.0, 0.0, 0.1], 0.001),  # on the floor
        ([0.1, 0.0, 0.025], [0.1, 0.0, 0.2], 0.0),  # over the top
        ([0.1, 0.0, 0.021], [0.1, 0.0, 0.2], 0.003),  # on the top
        ([0.05, 0.0, 0.0], [0.05, 0.0, 0.1], 0.014),  # in the wall
        ([0.0, 0.0, 0.025], [0.2, 0.0, 0.025], 0.0),  # level, over the top
        ([0.0, 0.0, 0.0], [0.3, 0.0, 0.2], 0.0),  # slanted, out of the opening
        ([0.01, 0.0, 0.0], [0.31, 0.0, 0.2], 0.01),  # slanted, at 24 mm height 46 mm off the middle
    ],
)
def test_known_cuts(start, end, expected):
    for ends in ((start, end), (end, start)):
        found = HOUSING.cut_by(*(np.array([p]) for p in ends), 0.004)
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_tool_is_seen_along_its_axis_and_on_to_the_flange():
    T = np.eye(4)
    T[:3, 3] = [0.05, 0.0, 0.3]  # a torch that sits beside the flange's axis
    tool = ToolBody(T, 0.1, 0.004, 0.06)
    np.testing.assert_allclose(tool.corners, [[0.05, 0, 0.3], [0.05, 0, 0.2], [0, 0, 0]])
    places = tool.corners[None] * [1.0, -1.0, -1.0] + [-0.05, 0.0, 0.3]
    parts = {
        # above the crossing: only if too thick for the opening
        (0.0, 1e-3): (0.0, 0.0, 0.0),
        (0.0, 37e-3): (1e-3, 0.0, 0.0),
        # beside the opening the tip is in the wall, its upper part 80 mm above the top
        (0.1, 1e-3): (20e-3 + 5e-3, 0.0, 0.0),
        (0.1, 81e-3): (105e-3, 5e-3, 0.0),
        # the flange, a ball of 60 mm at 300 mm, comes 20 mm off the top last
        (0.1, 221e-3): (245e-3, 145e-3, 1e-3),
    }
    for (beside, margin), expected in parts.items():
        found = tool.cuts(HOUSING, places + np.array([beside, 0.0, 0.0]), margin)
        np.testing.assert_allclose([float(x[0]) for x in found.values()], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"clear_radius_m": 0.0}, "opening radius 0 mm: must be positive"),
        ({"floor_m": 0.01}, "housing depth -10 mm: must be positive"),
        ({"floor_m": -np.inf}, "housing depth inf mm"),
        ({"retract_m": 0.02}, "retract height 20 mm: .* above the housing top, 20 mm"),
        ({"top_m": np.nan}, "housing top nan mm"),
        ({"reach_m": 0.03}, "housing reach 30 mm: must be more than the opening radius, 40 mm"),
    ],
)
def test_sizes_that_make_no_sense_are_refused_as_the_parameters_are_called(bad, words):
    """In mm and in the words of `opening_radius_mm`, `housing_top_mm`, `retract_mm` and so on."""
    with pytest.raises(InputError, match=words):
        Housing(**(vars(HOUSING) | bad))
    with pytest.raises(InputError, match="tool radius 0 mm"):
        ToolBody(np.eye(4), 0.1, 0.0, 0.05)


def test_beyond_the_reach_of_the_housing_nothing_is_solid():
    """A capsule of 5 mm, level and 50 mm under the brim, passes z at several distances."""
    housing = Housing(**(vars(HOUSING) | {"reach_m": 0.3}))
    passes = np.array([0.1, 0.29, 0.304, 0.306, 1.0])
    start = np.column_stack([passes, np.full(5, -0.5), np.full(5, -0.03)])
    end = start * [1.0, -1.0, 1.0]
    cut = housing.cut_by(start, end, 0.005)
    assert (cut > 0.0).tolist() == [True, True, True, False, False]
    assert cut[2] == pytest.approx(0.001, abs=1e-12)
    np.testing.assert_allclose(cut[:1], HOUSING.cut_by(start, end, 0.005)[:1])
    aside = start + np.array([0.0, 0.9, 0.0])  # the line would pass at 0.1 m, but it ends before
    assert housing.cut_by(aside[:1], aside[:1] + np.array([0.0, 0.5, 0.0]), 0.005)[0] == 0.0
