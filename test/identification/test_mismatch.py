# SPDX-License-Identifier: Apache-2.0
"""Mistakes in the data that are named instead of fitted."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import linear_start
from robocal_ros.identification.judged import explain_mismatch
from robocal_ros.kinematics import SerialArm

T_FRAME_BASE = frames.transform(frames.exp_rotation(np.array([0.3, -0.2, 1.0])), [2.0, 1.0, -0.5])
POINT = np.array([0.10, 0.05, 0.20, 1.0])


@pytest.fixture(scope="module")
def nominal() -> SerialArm:
    """A six-axis arm of two metres' reach, all joints counting the same way."""
    mdh = np.zeros((6, 5))
    mdh[:, 0] = [0.4, 0.0, 0.0, 0.9, 0.0, 0.1]
    mdh[:, 1] = np.radians([0.0, -90.0, 0.0, 0.0, 0.0, 180.0])
    mdh[:, 2] = [0.15, 0.8, 0.1, 0.0, 0.0, 0.0]
    mdh[:, 3] = np.radians([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0])
    names = tuple(f"joint_{i}" for i in range(1, 7))
    free = np.full(6, np.inf)
    return SerialArm("six", names, mdh, np.ones(6), np.zeros(6, dtype=bool), -free, free)


@pytest.fixture(scope="module")
def data(nominal: SerialArm) -> Measurements:
    """Thirty poses of a robot as built: off by millimetres and tenths of a degree."""
    rng = np.random.default_rng(2)
    size = np.where(nominal.parameters.is_length, 1e-3, np.radians(0.1))
    true = nominal.with_mdh(nominal.parameters.add(nominal.mdh, size * rng.normal(size=len(size))))
    q = rng.uniform(-1.5, 1.5, (30, 6))
    position = (T_FRAME_BASE @ true.fk(q) @ POINT)[:, :3]
    names = tuple(str(i) for i in range(30))
    return Measurements(q=q, position=position, target=("ball",) * 30, sample=names)


def explained(nominal: SerialArm, data: Measurements) -> str:
    def residual(measured: Measurements) -> np.ndarray:
        return linear_start(nominal, measured, base=True, tool=True).residual(measured)

    return explain_mismatch(nominal, data, residual)


def test_a_robot_as_built_is_no_mistake(nominal, data):
    assert explained(nominal, data) == ""


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: replace(d, position=d.position * 1e3), "1000 times too large"),
        (lambda d: replace(d, position=d.position * 1e-3), "1000 times too small"),
        (lambda d: replace(d, position=d.position * [1.0, -1.0, 1.0]), "left-handed"),
        (lambda d: replace(d, position=d.position[:, [1, 0, 2]]), "left-handed"),
        (lambda d: replace(d, q=np.degrees(d.q)), "degrees given as radians"),
        (lambda d: replace(d, q=np.radians(d.q)), "radians given as degrees"),
        (lambda d: replace(d, q=d.q * [1, 1, -1, 1, 1, 1]), "joint 3 (joint_3) counts the other"),
        (lambda d: replace(d, q=d.q[:, [0, 1, 3, 2, 4, 5]]), "joints 3 and 4 are swapped"),
    ],
)
def test_the_mistake_is_named(nominal, data, spoil, words):
    message = explained(nominal, spoil(data))
    assert words in message
    assert "mm (median)" in message


def test_data_of_something_else_are_not_explained(nominal, data):
    noise = np.random.default_rng(0).normal(size=data.position.shape)
    assert explained(nominal, replace(data, position=noise)) == ""


def test_without_a_fitted_base_the_axis_is_named(nominal, data):
    """With base and target known, the very axis that is wrong can be told."""
    known = linear_start(nominal, data, base=True, tool=True)
    flipped = replace(data, position=data.position * [1.0, 1.0, -1.0])
    message = explain_mismatch(nominal, flipped, known.residual)
    assert "z has the wrong sign" in message
