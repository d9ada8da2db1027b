# SPDX-License-Identifier: Apache-2.0
"""Each fault does to what the cell tells what it says, and to nothing else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kr150_shift import ABOVE, CYCLE, HOME, WORK, cell_of, first_circle, went

from bench.closed_loop.faults import proven, rights_by_size, shown, smallest_held
from bench.measured_fixture import fixture_poses
from robocal_ros.cell_sim.cell import TAUGHT
from robocal_ros.cell_sim.faults import CONTROLLER_FAULTS, FAULTS, NEXT_MOTION, SIZES
from robocal_ros.cell_sim.robot import Effects

EFFECTS = replace(Effects(), outliers=False)


@cache
def tour(fault: str = "none", size: float = 0.0):
    """Shows the ball twice, goes to the beams, drives a circle; all that was told on the way."""
    cell = cell_of(7, EFFECTS, points=20, fixture=True)
    cell.set_fault(fault, size)
    shown = went(cell, [HOME, *CYCLE[:2], ABOVE])
    cell.drive(first_circle(cell))
    there = cell.advance(cell.motion.end_s + 0.5)
    found = went(cell, [HOME, *fixture_poses()[:2]], 4.0, readings=False).features
    parts = [
        np.concatenate([getattr(part, name) for part in (shown, there)])
        for name in ("time_s", "q", "qd")
    ]
    return {
        "stamps": parts[0],
        "joints": parts[1],
        "speeds": parts[2],
        "edges": shown.edges + there.edges,
        "shot stamps": np.array([shot.time_s for shot in shown.shots]),
        "ball": np.array([shot.centre for shot in shown.shots]),
        "cloud": np.array([shot.points for shot in shown.shots]),
        "floor": np.array([shot.floor for shot in shown.shots]),
        "temperatures": np.array([t.celsius for t in shown.temperatures + there.temperatures]),
        "features": np.array([feature.point for feature in found]),
        "error": cell.tcp_error(WORK),
        "tool": cell.tool.T_flange_tool,
    }


def same(a, b) -> bool:
    return a == b if isinstance(a, list) else np.array_equal(a, b)


TOUCHED = {
    "collision": {"edges", "error", "tool"},
    "wrong_tool": {"edges", "error", "tool"},
    "sensor_knocked": {"ball", "cloud", "floor", "features"},
    "sphere_knocked": {"ball", "cloud"},
    "beam_dirty": {"edges"},
    "beam_x_dead": {"edges"},
    "beam_y_dead": {"edges"},
    "beams_dead": {"edges"},
    "chatter": {"edges"},
    "lost_edge": {"edges"},
    "double_edge": {"edges"},
    "swapped_cables": {"edges"},
    "wrong_station": set(),
    "input_latency": {"edges"},
    "lost_messages": {
        "edges", "stamps", "joints", "speeds", "shot stamps", "ball", "cloud", "floor", "features",
    },
    "joints_silent": {"stamps", "joints", "speeds"},
    "frozen_clock": {"stamps"},
    "clock_jump": {"stamps"},
    "sensor_clock_jump": {"shot stamps"},
    "frozen_encoder": {"joints", "speeds"},
    "swapped_temperatures": {"temperatures"},
    "moved_by_hand": {"edges", "error", "ball", "cloud", "features"},
    "station_knocked": {"edges"},
    "station_knocked_shift": {"edges"},
    "station_knocked_turn": {"edges"},
    "fixture_moved": {"features"},
}  # fmt: skip


def test_every_fault_is_looked_at():
    assert set(TOUCHED) == set(FAULTS) - {"none"}
    assert set(SIZES) <= {*FAULTS, *CONTROLLER_FAULTS}
    healthy = tour()
    assert len(healthy["edges"]) == 8
    assert len(healthy["ball"]) == 2


@pytest.mark.long
@pytest.mark.parametrize("fault", TOUCHED)
def test_a_fault_touches_what_it_names_alone(fault):
    healthy, faulty = tour(), tour(fault, 0.8 if fault == "lost_messages" else 0.0)
    touched = {name for name in healthy if not same(healthy[name], faulty[name])}
    assert touched == TOUCHED[fault]


@pytest.mark.long
@pytest.mark.parametrize("size", [0.1, 1.0, 5.0])
def test_a_collision_bends_the_tool_by_its_size(size):
    T = tour("collision", size)["tool"]
    assert np.linalg.norm(T[:3, 3] - TAUGHT[:3, 3]) == pytest.approx(size * 1e-3, rel=0.01)
    assert np.arccos(T[2, 2]) == pytest.approx(size * 1e-3 * 0.92 / 0.15, rel=0.02)
    moved = np.linalg.norm(tour("collision", size)["error"] - tour()["error"], axis=1)
    assert moved == pytest.approx(np.full(len(WORK), size * 1e-3), rel=0.02)


def test_a_wrong_tool_is_longer_and_thicker():
    T = tour("wrong_tool", 12.0)["tool"]
    assert T[:3, 3] == pytest.approx([0.0, 0.0, 0.412])
    healthy, longer = shadows(tour()), shadows(tour("wrong_tool", 12.0))
    assert np.all(longer - healthy > 2.0 * 0.8e-3 / 0.1)  # 1.2 mm more radius, at 100 mm/s


def shadows(told, beam: str | None = None):
    """How long (k,) a beam was dark each time, s."""
    found = []
    for name in ("x", "y") if beam is None else (beam,):
        times = [edge.time_s for edge in told["edges"] if edge.beam == name]
        found += [after - before for before, after in zip(times[::2], times[1::2], strict=True)]
    return np.array(found)


@pytest.mark.long
@pytest.mark.parametrize("size", [0.3, 2.0])
def test_a_knocked_sensor_sees_both_spheres_moved_alike(size):
    healthy, knocked = tour(), tour("sensor_knocked", size)
    turned = size * 1e-3 * 0.9  # rad, over less than a metre
    for name in ("ball", "floor"):
        off = np.linalg.norm(knocked[name] - healthy[name], axis=1)
        assert np.all(np.abs(off - 0.99 * size * 1e-3) < turned)
    apart = [np.linalg.norm(t["ball"] - t["floor"], axis=1) for t in (healthy, knocked)]
    assert apart[0] == pytest.approx(apart[1], abs=1e-12)


def test_a_knocked_ball_is_off_by_its_size():
    off = tour("sphere_knocked", 0.7)["ball"] - tour()["ball"]
    assert np.linalg.norm(off, axis=1) == pytest.approx(np.full(2, 0.7e-3), rel=1e-3)


@pytest.mark.long
def test_dirt_lengthens_the_shadows_of_its_beam():
    healthy, dirty = tour(), tour("beam_dirty", 0.4)
    assert np.all(shadows(dirty, "x") > shadows(healthy, "x") + 1e-3)
    assert shadows(dirty, "y") == pytest.approx(shadows(healthy, "y"), abs=0.0)
    blind = tour("beam_dirty", 0.6)["edges"]
    assert [edge.beam for edge in blind] == ["y"] * 4


def test_edges_are_late_by_the_latency():
    pairs = zip(tour()["edges"], tour("input_latency", 15.0)["edges"], strict=True)
    assert [late.time_s - edge.time_s for edge, late in pairs] == pytest.approx([0.015] * 8)


def test_exchanged_cables_exchange_the_beams():
    other = {"x": "y", "y": "x"}
    swapped = [(other[e.beam], e.blocked, e.time_s) for e in tour("swapped_cables")["edges"]]
    assert swapped == [(e.beam, e.blocked, e.time_s) for e in tour()["edges"]]


@pytest.mark.long
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_messages_are_lost_at_random(share):
    healthy, left = tour(), tour("lost_messages", share)
    count = len(healthy["stamps"])
    lost = 1.0 - len(left["stamps"]) / count
    assert lost == pytest.approx(share, abs=4.0 * np.sqrt(share * (1.0 - share) / count))
    kept = np.isin(healthy["stamps"], left["stamps"])
    assert np.array_equal(healthy["joints"][kept], left["joints"])
    assert {e.time_s for e in left["edges"]} < {e.time_s for e in healthy["edges"]}


@pytest.mark.long
def test_clocks_step():
    assert tour("clock_jump", -2.0)["stamps"] == pytest.approx(tour()["stamps"] - 2.0)
    jumped = tour("sensor_clock_jump", 3.0)["shot stamps"]
    assert jumped == pytest.approx(tour()["shot stamps"] + 3.0)
    assert len(set(tour("frozen_clock")["stamps"].tolist())) == 1


def test_an_encoder_stands_still():
    healthy, frozen = tour(), tour("frozen_encoder", 2.0)
    others = [0, 2, 3, 4, 5]
    assert np.array_equal(healthy["joints"][:, others], frozen["joints"][:, others])
    assert np.all(frozen["joints"][:, 1] == healthy["joints"][0, 1])
    assert np.ptp(healthy["joints"][:, 1]) > 0.05
    assert not np.any(frozen["speeds"][:, 1])


def test_temperature_cables_are_exchanged():
    order = [0, 2, 1, 3, 4, 5]
    assert np.array_equal(
        tour("swapped_temperatures")["temperatures"], tour()["temperatures"][:, order]
    )


def test_a_hand_moves_the_flange_and_not_the_readings():
    off = np.linalg.norm(tour("moved_by_hand", 1.5)["error"] - tour()["error"], axis=1)
    assert off == pytest.approx(np.full(len(WORK), 1.5e-3), rel=0.02)


def test_what_was_moved_stays_while_other_faults_come():
    cell = cell_of()
    cell.set_fault("collision", 2.0)
    cell.set_fault("sensor_knocked", 0.5)
    cell.set_fault("lost_messages")
    cell.set_fault("clock_jump", 2.0)
    assert cell.faults.sizes == pytest.approx(
        {"collision": 2e-3, "sensor_knocked": 5e-4, "clock_jump": 2.0}
    )
    cell.set_fault("none")
    assert not cell.faults.sizes
    assert cell.tool is cell.plan.tool


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "none"])
def test_when_a_fault_begins(fault):
    cell = cell_of()
    cell.set_fault(fault)
    assert (fault in cell.faults) == (fault not in NEXT_MOTION)
    cell.follow([0.1], [HOME])
    assert fault in cell.faults
    cell.set_fault("none")
    assert not cell.faults.sizes


def test_a_fault_may_begin_in_the_middle_of_a_motion():
    cell = cell_of(7, EFFECTS)
    cell.follow([1.0], [HOME + 0.3])
    before = cell.advance(0.5)
    cell.set_fault("frozen_encoder", 1.0)
    after = cell.advance(1.0)
    assert np.ptp(before.q[:, 0]) > 0.1
    assert np.ptp(after.q[:, 0]) == 0.0
    assert after.q[0, 0] == pytest.approx(before.q[-1, 0], abs=0.01)
    cell.set_fault("none")
    cell.advance(1.2)
    cell.set_fault("frozen_encoder", 1.0)
    assert cell.advance(1.3).q[0, 0] == pytest.approx(HOME[0] + 0.3)


def test_the_next_encoder_that_stands_still_shows_its_own_joint():
    cell = cell_of(7, EFFECTS)
    cell.follow([1.0], [HOME + 0.3 * np.arange(6)])
    for joint in (4, 2):
        cell.set_fault("frozen_encoder", joint + 1.0)
        came = cell.advance(cell.now_s + 0.2)
        true, _ = cell.motion.at(came.time_s)
        off = np.abs(came.q - true)
        assert np.ptp(came.q[:, joint]) == 0.0
        assert off[0, joint] < 1e-5
        assert off[-1, joint] > 1e-3
        assert np.max(np.delete(off, joint, axis=1)) < 1e-5


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("frozen_encoder", 99.0),
        ("frozen_encoder", -1.0),
        ("wrong_tool", -40.0),
        ("beam_dirty", 2.0),
    ],
)
def test_no_size_brings_the_cell_down(fault, size):
    told = tour(fault, size)
    for name in ("stamps", "joints", "ball", "error"):
        assert np.all(np.isfinite(told[name]))


@pytest.mark.parametrize(("held", "cells", "missed"), [(shown, 10, 1), (proven, 46, 1)])
def test_the_smallest_size_is_found_from_the_largest_downwards(held, cells, missed):
    def smallest(*misses):
        """By the misses at 2, 1, ... ."""
        trials = [
            (2.0 / 2**step, cell >= count)
            for step, count in enumerate(misses)
            for cell in range(cells)
        ]
        return smallest_held(rights_by_size(reversed(trials)), held)

    assert smallest(0, missed) == 1.0
    assert smallest(0, missed, missed + 1, 0) == 1.0  # by chance
    assert smallest(missed + 1, 0) is None
