# SPDX-License-Identifier: Apache-2.0
"""Spheres as clouds or centres: the same drift; what is no sphere is said."""

from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest
from shift import Shift, built, postures, warmed

from robocal_ros.cell_sim.sensors import CloudScene, sphere_cloud
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    JointSample,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession, take_message

NS = 1_000_000_000
POSES = 8


@pytest.fixture(scope="module")
def visits(nominal: Any) -> list[list[Any]]:
    shift = Shift(nominal.joint_names)
    cold, q = built(nominal), postures(nominal, POSES)
    return [list(shift.visit(cold, q)), list(shift.visit(warmed(cold), q, after_h=2.0))]


def header(ns: int, frame: str = "sensor/ball") -> Message:
    return Message(stamp=Message(sec=ns // NS, nanosec=ns % NS), frame_id=frame)


def cloud(ns: int, points: np.ndarray) -> Message:
    fields = [Message(name=name, offset=4 * i, datatype=7) for i, name in enumerate("xyz")]
    return Message(
        header=header(ns),
        fields=fields,
        width=len(points),
        height=1,
        point_step=12,
        row_step=12 * len(points),
        is_bigendian=False,
        data=points.astype("<f4").tobytes(),
    )


def messages(samples: list[Any], kind: str, scene: CloudScene | None = None) -> Any:
    """The visit as messages, its measurements on the input ``kind``."""
    rng = np.random.default_rng(0)
    for sample in samples:
        ns = sample.stamp_ns
        if isinstance(sample, JointSample):
            yield (
                JOINTS,
                Message(header=header(ns, ""), name=sample.names, position=sample.position),
            )
        elif kind == SPHERE_CLOUD:
            yield SPHERE_CLOUD, cloud(ns, sphere_cloud(sample.position_m, 1000, rng, scene))
        else:
            p = Message(**dict(zip("xyz", sample.position_m.tolist(), strict=True)))
            yield kind, Message(header=header(ns), point=p)


def drift(nominal: Any, visits: list[list[Any]], kind: str, folder: Any) -> Any:
    history = CalibrationHistory.open("s1", model_hash=nominal.model_hash, state_dir=folder)
    session = ThermalSession(nominal, history, ThermalConfig(sigma_m=2e-5), "test")
    outcomes = []
    for samples, name in zip(visits, (events.CAPTURE_REFERENCE, events.IDENTIFY), strict=True):
        for topic, message in messages(samples, kind):
            take_message(session, topic, message)
        session.submit(Command(name, {"cycle_id": "warm"}))
        outcomes += session.advance(wall_ns=7, force=True)
    assert session.desk.received[kind] == 2 * POSES
    assert [outcome.samples for outcome in outcomes] == [POSES, POSES]
    return outcomes[1]


def test_cloud_and_centre_give_the_same_drift(nominal, visits, tmp_path):
    """The centre of a thousand points is known to 2 µm: far below the 20 µm of a visit."""
    by_point, by_centre, by_cloud = (
        drift(nominal, visits, kind, tmp_path / kind)
        for kind in (MEASURED_POINT, SPHERE_CENTER, SPHERE_CLOUD)
    )
    assert by_point.document["parameters"] == by_centre.document["parameters"]
    assert by_cloud.status is by_point.status is Code.ACCEPT
    for name, row in by_point.document["parameters"].items():
        other = by_cloud.document["parameters"][name]
        assert other["value"] == pytest.approx(row["value"], abs=0.5 * row["sigma"])


def test_a_cloud_without_a_sphere_is_counted_with_its_figure(nominal, visits, tmp_path):
    history = CalibrationHistory.open("s1", model_hash=nominal.model_hash, state_dir=tmp_path)
    session = ThermalSession(nominal, history, ThermalConfig(), "test")
    small = CloudScene(half_angle_rad=np.radians(12.0), stem=0.0, background=0.0)
    for topic, message in messages(visits[0], SPHERE_CLOUD, small):
        take_message(session, topic, message)
    assert sum(session.desk.ignored[SPHERE_CLOUD].values()) == POSES
    session.submit(Command(events.CAPTURE_REFERENCE, {}))
    (outcome,) = session.advance(wall_ns=7, force=True)
    assert outcome.status is Code.TOO_FEW_SAMPLES
    assert "half angle of 12 deg (at least 20 deg)" in outcome.message
