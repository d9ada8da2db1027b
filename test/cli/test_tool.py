# SPDX-License-Identifier: Apache-2.0
"""``robocal tool``: beams, one circle, touches; each from a table."""

from pathlib import Path

import numpy as np
import pytest
from command import robocal, robocal_json
from tool_tables import (
    CENTRE_MM,
    PERIOD_S,
    PUBLISHED_MM,
    RADIUS_MM,
    RHO_MM,
    START_DEG,
    TIP_MM,
    circle_rows,
    tool_tables,
    touch_rows,
    write,
)

CIRCLE = ("--radius-mm", RADIUS_MM, "--period-s", PERIOD_S, "--start-deg", START_DEG)
EVENTS = "stamp_s,beam,blocked"
POSES = "x_mm,y_mm,z_mm,qx,qy,qz,qw"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("tool")
    tool_tables(made)
    return made


def crossed(path: Path, *more: object, status: int = 0):
    words = ("tool", "crossed", "--events", path, *CIRCLE, *more)
    return robocal_json("tool.crossed.json", *words, status=status)


def test_the_sources_beams_to_the_printed_digits(folder):
    found = robocal_json("tool.beams.json", "tool", "beams", "--data", folder / "beams.csv")
    assert np.round(found["origin_mm"], 3).tolist() == [799.413, -126.302, 194.498]
    assert round(abs(found["gap_mm"]), 3) == 0.058
    assert round(found["beam_angle_deg"], 2) == 92.20
    assert np.round(found["axes"][2], 5).tolist() == [-0.04057, -0.02273, 0.99892]


def test_a_point_measured_twice_counts_with_its_mean(folder, tmp_path):
    rows = [(name, *place) for name, place in PUBLISHED_MM.items()]
    twice = [(n, x + s, y, z) for n, x, y, z in rows for s in (-0.05, 0.05)]
    path = write(tmp_path / "twice.csv", "point,x_mm,y_mm,z_mm", twice)
    found = robocal_json("tool.beams.json", "tool", "beams", "--data", path)
    once = robocal_json("tool.beams.json", "tool", "beams", "--data", folder / "beams.csv")
    assert found["origin_mm"] == pytest.approx(once["origin_mm"], abs=1e-9)


@pytest.mark.parametrize("latency_s", [0.0, 0.013])
def test_a_thick_tool_on_one_circle(tmp_path, latency_s):
    """Exact but for the nine digits of the stamps: a nanosecond at 38 mm/s is 4e-8 mm."""
    path = write(tmp_path / "events.csv", EVENTS, circle_rows(latency_s))
    best = crossed(path)
    assert best["center_mm"] == pytest.approx(CENTRE_MM, abs=1e-6)
    assert list(best["tool_radius_mm"].values()) == pytest.approx([RHO_MM] * 2, abs=1e-6)
    assert best["latency_s"] == pytest.approx(latency_s, abs=1e-8)
    assert best["verdict"]["accept"]
    classic = crossed(path, "--method", "classic")
    assert (classic["sigma_mm"], classic["tool_radius_mm"]) == (None, None)
    away = np.linalg.norm(np.subtract(classic["center_mm"], CENTRE_MM))
    assert 1e-3 < away < 1.0  # biased: the baseline


def test_a_speed_that_is_not_constant_is_refused_by_what_sigma_explains(tmp_path):
    """Twice a turn 0.6 % faster and slower: 0.04 mm at an edge, four times the robot's scatter."""
    path = write(tmp_path / "events.csv", EVENTS, circle_rows(ripple=0.006, ripples=2))
    refused = crossed(path, status=3)["error"]
    assert refused["code"] == "RESIDUAL_TOO_LARGE"
    assert "speed not constant: record joints" in refused["message"]
    sampled = crossed(path, "--sample-period-s", 0.01)  # edges to 2.9 ms, 0.1 mm: explained
    assert max(sampled["sigma_mm"]) > 0.05


def test_a_known_latency_is_taken(tmp_path):
    path = write(tmp_path / "events.csv", EVENTS, circle_rows(0.013))
    assert crossed(path, "--latency-s", "0.013")["latency_s"] == 0.013


@pytest.mark.parametrize(
    ("header", "row", "column", "words"),
    [
        (EVENTS, ("0.1", "z", 1), "beam", "not one of x, y"),
        (EVENTS, ("0.1", "x", "yes"), "blocked", "neither 1"),
        (EVENTS, ("soon", "x", 1), "stamp_s", "not a number"),
        (EVENTS + ",sigma_s", ("0.1", "x", 1, 0), "sigma_s", "no stamp is exact"),
        ("stamp_s,beam", ("0.1", "x"), None, "column blocked is missing"),
        (EVENTS + ",colour", ("0.1", "x", 1, 2), "colour", "unknown column"),
    ],
)
def test_a_table_is_refused_with_row_and_column(tmp_path, header, row, column, words):
    path = write(tmp_path / "events.csv", header, [row])
    refused = crossed(path, status=2)
    assert refused["error"]["column"] == column
    assert words in refused["error"]["message"]


def test_touches_give_the_tip(folder):
    words = ("tool", "points", "--data", folder / "touches.csv")
    found = robocal_json("tool.points.json", *words)
    assert found["tcp_mm"] == pytest.approx(TIP_MM, abs=1e-6)
    assert found["quat_xyzw"] is None
    assert found["verdict"]["accept"]


def test_seven_poses_give_the_orientation_too(tmp_path):
    rows = touch_rows(4)
    x, y, z, *quat = rows[-1]
    moves = [[x, y, z, *quat], [x + 50.0, y, z, *quat], [x + 50.0, y, z + 60.0, *quat]]
    path = write(tmp_path / "seven.csv", POSES, [*rows, *moves])
    found = robocal_json("tool.points.json", "tool", "points", "--method", "seven", "--data", path)
    assert found["tcp_mm"] == pytest.approx(TIP_MM, abs=1e-6)
    # The tool's axes are those of the base: the flange's own orientation, undone.
    undone = np.array(quat) * [-1.0, -1.0, -1.0, 1.0]
    assert abs(float(undone @ found["quat_xyzw"])) == pytest.approx(1.0, abs=1e-9)


def test_poses_without_an_orientation_are_refused(tmp_path):
    path = write(tmp_path / "bare.csv", "x_mm,y_mm,z_mm", [(1, 2, 3)] * 4)
    words = ("tool", "points", "--data", path)
    refused = robocal_json("tool.points.json", *words, status=2)
    assert "column qx, qy, qz, qw is missing" in refused["error"]["message"]


def test_people_get_it_in_words(folder):
    circle = robocal("tool", "crossed", "--events", folder / "edges.csv", *CIRCLE)
    assert "ACCEPT: the axis is at (3.000, -4.000) mm" in circle.stdout
    beams = robocal("tool", "beams", "--data", folder / "beams.csv")
    assert "92.20" in beams.stdout
    points = robocal("tool", "points", "--data", folder / "touches.csv")
    assert "12.000 ±" in points.stdout
