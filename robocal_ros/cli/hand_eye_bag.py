"""Shots of a line laser from a bag: a recording, or a data file of hand_eye_node."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.hand_eye_bags import DATA_SET, read_data_set
from robocal_ros.bags.replay import topic_kind
from robocal_ros.cli.recording import open_recording
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.hand_eye.config import HandEyeConfig, flange_poses
from robocal_ros.hand_eye.data import data_set_of
from robocal_ros.hand_eye.recorded import is_hand_eye_session
from robocal_ros.hand_eye.shots import (
    PROFILE,
    Profile,
    StandingShot,
    Standstills,
    captured_marks,
    first_of_each,
)
from robocal_ros.hand_eye.tasks import HandEyeData
from robocal_ros.kinematics import SerialArm

if TYPE_CHECKING:
    from robocal_ros.cli.recording import BagOverview

BagShots = tuple[HandEyeData, dict[str, str]]


def read_bag_shots(path: Path, arm: SerialArm, topics: Mapping[str, str]) -> BagShots:
    """Shots of a bag, and the profiles that are none with the reason.

    ``topics``: input to topic, where given.

    Raises
    ------
    InputError
        When the bag cannot be read, or lacks what is needed.
    WrongRobotError
        A data file was made with another robot.
    TooFewSamplesError
        When no profile was taken at standstill.
    """
    with BagReader(path) as reader:
        if DATA_SET not in reader.info.topics:
            given = dict(topics)
            seen = [topic for topic in reader.info.topics if topic_kind(topic) == PROFILE]
            if len(seen) == 1:
                given.setdefault(PROFILE, seen[0])
            return _recorded(open_recording(reader, given), arm)
    return _saved(path, arm), {}


def _saved(path: Path, arm: SerialArm) -> HandEyeData:
    data = data_set_of(read_data_set(path, arm), arm)
    if data.topic != PROFILE:
        raise InputError(f"holds shots of a {data.kind}, not profiles", file=str(path))
    samples = data.chosen([])
    names = tuple(str(sample.handle) for sample in samples)
    q = np.array([sample.q for sample in samples])
    return HandEyeData(
        names,
        flange_poses(q, [sample.thermal for sample in samples], arm),
        [Profile(sample.values, name) for name, sample in zip(names, samples, strict=True)],
        _marks([sample.mark for sample in samples]),
    )


def _recorded(recording: "BagOverview", arm: SerialArm) -> BagShots:
    path = recording.reader.info.path
    if PROFILE not in recording.inputs.values():
        raise InputError(
            f"profiles are not found among {', '.join(recording.reader.info.topics)}: choose with "
            f"--topic {PROFILE}:=TOPIC",
            file=path,
        )
    rule, configured = StandstillRule(), recording.configured
    if configured is not None and is_hand_eye_session(configured):
        rule = HandEyeConfig.of_document(configured.arguments["config"]).standstill
    standstills = Standstills(arm.joint_names, rule)
    for recorded in recording.samples():
        standstills.take(recording.inputs[recorded.topic], recorded.message)
    standstills.close()
    kept, left_out = _chosen(recording, standstills.found, rule)
    rejected = dict(sorted((standstills.rejected | left_out).items()))
    if not kept:
        why = next(iter(rejected.values()), "there is none")
        raise TooFewSamplesError(f"{path}: no profile is of use, of {len(rejected)}: {why}")
    return HandEyeData(
        tuple(one.name for one in kept),
        np.array([arm.fk(one.q) for one in kept]),
        [Profile(one.shot.read(), one.name) for one in kept],
        _marks([one.mark for one in kept]),
    ), rejected


def _chosen(
    recording: "BagOverview", found: list[StandingShot], rule: StandstillRule
) -> tuple[list[StandingShot], dict[str, str]]:
    """What the recorded session holds; without one, a shot of each standstill."""
    marks = captured_marks(recording.commands)
    if marks is None:
        return first_of_each(found, rule.tolerance_rad)
    kept = [
        replace(one, mark=marks[one.shot.stamp_ns]) for one in found if one.shot.stamp_ns in marks
    ]
    why = "not captured, or removed, in the recorded session"
    return kept, {one.name: why for one in found if one.shot.stamp_ns not in marks}


def _marks(marks: list[str]) -> tuple[str, ...] | None:
    return tuple(marks) if any(marks) else None
