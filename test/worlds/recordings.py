# SPDX-License-Identifier: Apache-2.0
"""Bags of a simulated shift: what a recorder keeps of a robot, a sensor and a thermal session."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from campaign import NOISE_M, POINTS, ROBOT, postures, true_arm

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.ground import frames
from robocal_ros.ground.samples import JointSample, PointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Command, arguments_text, outcome_text
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession, configuration

NS = 1_000_000_000
START_NS = 1_700_000_000 * NS
T_SENSOR_BASE = frames.transform(frames.exp_rotation(np.array([0.3, -0.2, 1.0])), [2.0, 1.0, -0.5])
JOINTS, POINT, EVENTS = "/joint_states", "/measured_point", "/thermal_node/session_events"
TYPES = {
    JOINTS: "sensor_msgs/msg/JointState",
    POINT: "geometry_msgs/msg/PointStamped",
    EVENTS: "robocal_msgs/msg/SessionEvent",
}
POSES = 8
BETWEEN_S = 7200  # from visit to visit; a robot takes hours to warm up

Sample = JointSample | PointSample


def warmed(cold: SerialArm, kelvin: float) -> SerialArm:
    """The same robot with grown links."""
    chosen = cold.parameters
    length = np.where(chosen.is_length, chosen.read(cold.mdh), 0.0)
    return cold.with_mdh(chosen.add(cold.mdh, length * 12e-6 * kelvin))


def visit(
    arm: SerialArm, q: np.ndarray, start_ns: int, seed: int, noise_m: float = NOISE_M / 2
) -> Iterator[Sample]:
    """One second at each pose: ten joint readings and a measurement at half time."""
    rng = np.random.default_rng(seed)
    names = load_robot(ROBOT).joint_names
    for i, pose in enumerate(q):
        for k in range(10):
            now_ns = start_ns + i * NS + k * NS // 10
            yield JointSample(now_ns, names, pose + 1e-7 * rng.normal(size=len(pose)))
            if k == 5:
                ball = (T_SENSOR_BASE @ arm.fk(pose) @ [*POINTS["ball"], 1.0])[:3]
                measured = ball + noise_m * rng.normal(size=3)
                yield PointSample(now_ns + 50_000_000, "sensor", "ball", measured)


def shift() -> list[list[Sample]]:
    """A cold visit, two warm ones and the beginning of a next, with pauses between."""
    cold = true_arm()
    q = postures(cold, POSES, 21)
    parts = [(cold, q), (warmed(cold, 20.0), q), (warmed(cold, 30.0), q), (cold, q[:1])]
    starts = [START_NS + i * BETWEEN_S * NS for i in range(len(parts))]
    return [
        list(visit(arm, poses, start_ns, seed))
        for seed, ((arm, poses), start_ns) in enumerate(zip(parts, starts, strict=True))
    ]


def message(sample: Sample) -> tuple[str, dict[str, Any]]:
    header: dict[str, Any] = {"stamp": ros_time(sample.stamp_ns)}
    if isinstance(sample, JointSample):
        return JOINTS, {"header": header, "name": list(sample.names), "position": sample.position}
    header["frame_id"] = f"{sample.frame}/{sample.target}"
    point = dict(zip("xyz", sample.position_m.tolist(), strict=True))
    return POINT, {"header": header, "point": point}


def write_samples(bag: BagWriter, samples: Iterable[Sample], **topics: str) -> None:
    for sample in samples:
        topic, content = message(sample)
        name = topics.get(topic.strip("/"), topic)
        bag.write(name, TYPES[topic], content, sample.stamp_ns + 3_000_000)


def plain_bag(path: Path, visits: Sequence[Sequence[Sample]], **topics: str) -> Path:
    """Samples alone, no session recorded; ``topics``: other names for them."""
    with BagWriter(path) as bag:
        for part in visits:
            write_samples(bag, part, **topics)
    return path


def with_events(
    bag: Path, events: Iterable[Any], path: Path, topic: str, inputs: Iterable[str] | None = None
) -> Path:
    """A bag, or these topics of it, as if its recorder had listened to a node's session too."""
    with BagReader(bag) as reader, BagWriter(path, latched=[topic]) as writer:
        for m in reader.messages(inputs):
            writer.write(m.topic, reader.info.topics[m.topic].msgtype, m.message, m.log_time_ns)
        for event in events:
            writer.write(topic, TYPES[EVENTS], event, m.log_time_ns)
    return path


def recorded_bag(
    path: Path,
    state: Path,
    visits: Sequence[Sequence[Sample]],
    *,
    configure: bool = True,
    robot: str = ROBOT,
) -> list[dict[str, Any]]:
    """A bag of a live session: captured, identified twice, once accepted; its documents."""
    nominal = load_robot(robot)
    documents = []
    with (
        CalibrationHistory.open("s1", model_hash=nominal.model_hash, state_dir=state) as history,
        BagWriter(path, latched=[EVENTS]) as bag,
    ):
        session = ThermalSession(nominal, history, ThermalConfig(sigma_m=NOISE_M / 2), "test")

        def record(command: Command, outcome: str, now_ns: int) -> None:
            content = {
                "stamp": ros_time(command.stamp_ns or 0),
                "command": command.name,
                "arguments": arguments_text(command),
                "outcome": outcome,
            }
            bag.write(EVENTS, TYPES[EVENTS], content, now_ns)

        def configured(now_ns: int) -> None:
            if configure:
                topics = {"joint_states": JOINTS, "measured_point": POINT}
                record(configuration(session, topics), "{}", now_ns)

        configured(START_NS)
        asked = [
            Command(events.CAPTURE_REFERENCE, {"by": "night shift"}),
            Command(events.IDENTIFY, {"cycle_id": "one"}),
            Command(events.IDENTIFY, {"cycle_id": "two"}),
        ]
        for part in visits:
            for sample in part:
                write_samples(bag, [sample])
                session.add(sample)
                for outcome in session.advance(wall_ns=7):
                    record(outcome.command, outcome_text(outcome), sample.stamp_ns + 5_000_000)
                    configured(sample.stamp_ns + 6_000_000)
                    if outcome.document is not None:
                        documents.append(dict(outcome.document))
                    if outcome.command.arguments.get("cycle_id") == "one":
                        who = {"by": "cell", "reason": "better"}
                        session.submit(
                            Command(events.ACCEPT, {"id": outcome.calibration_id, **who})
                        )
            if asked:
                session.submit(asked.pop(0))
    return documents
