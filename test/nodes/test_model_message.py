# SPDX-License-Identifier: Apache-2.0
"""A model with joint functions as a message, over the wire and back; what cannot be is refused."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from joint_errors import with_joint_errors
from rclpy.serialization import deserialize_message, serialize_message
from robocal_msgs.msg import KinematicModel
from std_msgs.msg import Header

from robocal_ros.correction.interface import OfferedModel, Reason, RefusedError, offered_model
from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.joint_functions import ArmLoad, IdentifiedFrom
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.conversions import kinematic_model

NOMINAL = load_robot("ur10")
COLD = with_joint_errors(NOMINAL, 3)
Q = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 6))


def message_of(arm: SerialArm) -> Any:
    made = kinematic_model(
        model_document(arm),
        serial="s1",
        model_hash=NOMINAL.model_hash,
        revision=2,
        state=KinematicModel.ACCEPTED,
        stamp=Header(frame_id="base"),
    )
    return deserialize_message(serialize_message(made), KinematicModel)


def read(message: Any) -> OfferedModel:
    return offered_model(message, KinematicModel.ACCEPTED)


KNOWN = IdentifiedFrom(
    q=Q, target=np.arange(50) % 2, weight=np.linspace(0.5, 2.0, 50), p_flange=np.eye(3)[:2],
    lever=0.05, noise=4e-5, parameter_sigma=np.linspace(0.0, 1.0, len(NOMINAL.parameters)),
    base_sigma=1.0, target_sigma=0.5, length=np.full(6, 0.06), amplitude=np.arange(6) * 1e-4,
)  # fmt: skip
IDENTIFIED = replace(COLD, functions=replace(COLD.functions, identified_from=KNOWN))
FOUND = replace(IDENTIFIED, load=ArmLoad.unknown(6))


@pytest.mark.parametrize("arm", [NOMINAL, COLD, IDENTIFIED, FOUND, replace(NOMINAL, load=None)])
def test_it_is_the_same_arm_behind_the_wire(arm: SerialArm) -> None:
    offered = read(message_of(arm))
    bare = replace(NOMINAL, load=None)
    back = bare.with_model(offered.mdh, offered.functions, offered.load)
    np.testing.assert_array_equal(back.fk(Q), arm.fk(Q))
    assert back.model_hash == arm.model_hash
    if arm is IDENTIFIED:
        for part in fields(KNOWN):
            given = getattr(KNOWN, part.name)
            np.testing.assert_array_equal(getattr(back.functions.identified_from, part.name), given)
    if arm.load is not None:
        assert back.load.found == arm.load.found
        assert back.load.payload_mass == arm.load.payload_mass
        np.testing.assert_array_equal(back.load.payload_centre, arm.load.payload_centre)


def set_to(name: str, values: Any) -> Callable[[Any], None]:
    return lambda message: setattr(message, name, values)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (set_to("function_coefficients", [0.0] * 7), "cannot reshape"),
        (set_to("function_first", [0.0] * 5), "do not fit"),
        (set_to("compliance", [-1e-7] * 6), "compliances not below"),
        (set_to("function_step", [float("nan")] * 6), "step holds a number that is not finite"),
        (set_to("link_mass", [1.0] * 5), "load: centre must be"),
        (set_to("link_mass", []), "compliances without masses"),
        (set_to("payload_mass", -2.0), "mass must not be below 0"),  # -1 says none is known
        (set_to("payload_mass", np.nan), "mass must not be below 0"),
        (set_to("identified_q", [0.0] * 7), "cannot reshape"),
        (set_to("identified_noise", float("nan")), "noise holds a number that cannot be"),
        (set_to("identified_target", [2] * 50), "a target or a length is not told"),
    ],
)
def test_what_cannot_be_is_refused_in_words(spoil: Callable[[Any], None], words: str) -> None:
    message = message_of(IDENTIFIED)
    spoil(message)
    with pytest.raises(RefusedError, match=words) as caught:
        read(message)
    assert caught.value.reason is Reason.BAD_FUNCTIONS


def test_a_document_whose_numbers_cannot_be_is_not_sent() -> None:
    document = model_document(COLD)
    document["functions"]["compliance"][2] = float("inf")
    with pytest.raises(InputError, match="compliance holds a number that is not finite"):
        kinematic_model(document, serial="", model_hash="", revision=0, state=0, stamp=Header())
