"""From the bag of a hand-eye node to its calibrations: what ``robocal replay`` computes of it."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import BagOverview
from robocal_ros.cli.replay_parts import commanded_document, replay_commanded, seconds
from robocal_ros.ground.frames import transform_document
from robocal_ros.ground.proposals import Head
from robocal_ros.hand_eye.recorded import hand_eye_session_as_recorded
from robocal_ros.hand_eye.session import take_hand_eye_message
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm


def replay_hand_eye(
    recording: BagOverview, arm: SerialArm, history: CalibrationHistory, samples: Iterable[Any]
) -> Document:
    """Replay what a hand-eye node recorded: each calibration with its figures.

    Raises
    ------
    InputError, WrongRobotError
        The bag lacks what a replay needs.
    """
    report, session = replay_commanded(
        recording, arm, history, samples, hand_eye_session_as_recorded, take_hand_eye_message
    )
    return commanded_document(report, session, recording) | {
        "calibrations": [
            {"stamp": seconds(o.command.stamp_ns), **(o.document or {})}
            for o in report.outcomes
            if o.document is not None and o.calibration_id
        ],
        "final_sensor": _sensor(session.in_force),
    }


def _sensor(head: Head) -> Document | None:
    """What is in force at the end; None: nothing is."""
    if head.model is None:
        return None
    frames = {name: head.model[name] for name in ("parent", "child")}
    T = np.array(head.model["T_parent_sensor"])
    return frames | transform_document(T) | {"revision": head.revision}
