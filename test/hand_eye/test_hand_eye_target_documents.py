"""Targets as documents: the same bits come back, also through JSON."""

import json
from dataclasses import fields

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.targets import (
    BoardTarget,
    LineTarget,
    SphereTarget,
    Staircase,
    StepTarget,
    target_document,
    target_of,
)

T = frames.transform(frames.exp_rotation([0.1, 0.2, 0.3]), [0.7, 0.1, 1 / 3])
STAIRS = Staircase(5, 0.09, 0.01, 0.01, "both")
STEP = StepTarget(T, STAIRS.marked_corners(), STAIRS.edge_user, 1e-5, 2e-4, 1e-3)
LINE = LineTarget(T[:3, 3], T[:3, 0])
K = np.array([[610.0 / 3, 0.0, 322.0], [0.0, 612.0, 236.0], [0.0, 0.0, 1.0]])
GIVEN = BoardTarget(9, 6, 0.025 / 3, K, np.array([0.1 / 3, 0, 0, 0, 0]), np.array([640.0, 480.0]))
TARGETS = [
    ("sphere", SphereTarget(0.1 / 3)), ("step", STEP), ("line", LINE),
    ("camera", BoardTarget(9, 6, 0.025 / 3)), ("camera", GIVEN),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "target"), TARGETS)
def test_a_target_comes_back_to_the_last_bit(kind, target):
    document = json.loads(json.dumps(target_document(kind, target), allow_nan=False))
    assert document["kind"] == kind
    found = target_of(document)
    assert type(found) is type(target)
    for field in fields(target):
        before, after = getattr(target, field.name), getattr(found, field.name)
        if field.name == "corners":
            assert list(after) == list(before)
            before, after = list(before.values()), list(after.values())
        assert np.array_equal(after, before)


def test_nothing_known_stays_nothing_known():
    assert target_of(target_document("line", None)) is None
    assert target_of({"kind": "camera"}) is None


def test_a_board_with_its_camera_is_known_whole():
    assert BoardTarget(9, 6, 0.025).intrinsics is None
    assert GIVEN.intrinsics.size == (640, 480)
    assert np.array_equal(GIVEN.intrinsics.matrix, K)
    assert (GIVEN.board.columns, GIVEN.board.rows, GIVEN.board.square_m) == (9, 6, 0.025 / 3)


def test_another_target_than_named_is_refused():
    with pytest.raises(InputError, match="describes a line, not a sphere"):
        target_document("sphere", LINE)
    step, line = target_document("step", STEP), target_document("line", LINE)
    for broken in (
        {"kind": "cone", "x": 1}, {"kind": "sphere", "width_m": 1}, {"radius_m": 1},
        {"kind": "sphere", "radius_m": "x"}, {"kind": "sphere", "radius_m": 0.0},
        {"kind": "sphere", "radius_m": float("nan")}, {"kind": "sphere", "radius_m": [0.02]},
        line | {"point_base": [0.0, 1.0]}, line | {"direction_base": 3.0},
        step | {"corners": {}}, step | {"corners": {"near": []}}, step | {"corners": 3.0},
        step | {"corners": {"near": [[0.0, 1.0]]}}, step | {"sigma_m": None},
    ):  # fmt: skip
        with pytest.raises(InputError, match="cannot be read"):
            target_of(broken)
