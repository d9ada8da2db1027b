"""Data files of a hand-eye calibration: what was captured, as an indexed MCAP of common messages.

``joint_states`` holds the mean joint readings of each standstill, ``profile`` (clouds),
``target_pose`` or ``image`` (its size and the board's corners, px) what the sensor saw there, both
stamped with the time of the shot, and ``data_set`` (a JSON text) target, method, mount, robot and
the samples' names.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bag_writer import BagWriter, ros_time
from robocal_ros.bags.bags import BagInfo, BagMessage, BagReader
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.files import draft_beside
from robocal_ros.ground.samples import cloud_points, joint_sample
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
Document = dict[str, Any]

DATA_SET, JOINTS, PROFILE, POSE = "data_set", "joint_states", "profile", "target_pose"
IMAGE = "image"
_TYPE = {
    PROFILE: "sensor_msgs/msg/PointCloud2",
    POSE: "geometry_msgs/msg/PoseStamped",
    IMAGE: "std_msgs/msg/Float64MultiArray",
}
_DOUBLE = 8  # of sensor_msgs/PointField
_BYTES = 24  # of a point


def write_data_set(
    path: Path, document: Mapping[str, Any], topic: str, frame: str, arm: SerialArm
) -> None:
    """Write a data set; the file appears whole or not at all.

    Parameters
    ----------
    document : of the data set, with its ``samples`` in SI.
    topic : ``profile``, ``target_pose`` or ``image``; ``frame``: the sensor's.

    Raises
    ------
    InputError
        When the file is there already, or cannot be written.
    """
    if path.exists():
        raise InputError("is there already: name another file", file=str(path))
    if not path.parent.is_dir():
        raise InputError(f"cannot be written: no folder {path.parent}", file=str(path))
    samples = sorted(document["samples"], key=lambda row: (row["stamp_ns"], row["handle"]))
    apart = ("q", "values")  # messages of their own
    rows = [{name: row[name] for name in row if name not in apart} for row in samples]
    made_with = {"robot": arm.name, "model_hash": arm.model_hash, "sensor_frame": frame}
    text = json.dumps({**document, **made_with, "samples": rows}, allow_nan=False)
    draft = draft_beside(path)
    try:
        with BagWriter(draft) as writer:
            start_ns = rows[0]["stamp_ns"] if rows else 0
            writer.write(DATA_SET, "std_msgs/msg/String", {"data": text}, start_ns)
            for row in samples:
                at_ns = row["stamp_ns"]
                header = {"stamp": ros_time(at_ns), "frame_id": frame}
                joints = {
                    "header": header | {"frame_id": ""},
                    "name": list(arm.joint_names),
                    "position": row["q"],
                }
                writer.write(JOINTS, "sensor_msgs/msg/JointState", joints, at_ns)
                writer.write(topic, _TYPE[topic], _shot(topic, header, row["values"]), at_ns)
        draft.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=str(path)) from error
    finally:
        draft.unlink(missing_ok=True)


def _shot(topic: str, header: Document, values: Sequence[Sequence[float]]) -> Document:
    if topic == IMAGE:
        return _corners(values)
    return {"header": header} | (_cloud(values) if topic == PROFILE else _pose(values))


def _corners(values: Sequence[Sequence[float]]) -> Document:
    """Rows of two: width and height of the image, then each corner."""
    size = 2 * len(values)
    layout = [("size and corners", len(values), size), ("x, y", 2, 2)]
    dim = [{"label": label, "size": n, "stride": stride} for label, n, stride in layout]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": np.ravel(values)}


def _cloud(points: Sequence[Sequence[float]]) -> Document:
    data = np.insert(np.array(points, dtype="<f8").reshape(-1, 2), 1, 0.0, axis=1)
    fields = [
        {"name": name, "offset": 8 * i, "datatype": _DOUBLE, "count": 1}
        for i, name in enumerate("xyz")
    ]
    size = len(data) * _BYTES
    return {
        "height": 1, "width": len(data), "fields": fields, "point_step": _BYTES,
        "row_step": size, "data": data.tobytes(), "is_dense": True,
    }  # fmt: skip


def _pose(values: Sequence[Sequence[float]]) -> Document:
    x, y, z, *quat = values[0]
    turn = dict(zip("xyzw", quat, strict=True))
    return {"pose": {"position": {"x": x, "y": y, "z": z}, "orientation": turn}}


def read_data_set(path: Path, arm: SerialArm) -> Document:
    """Read what `write_data_set` wrote: the same numbers to the last bit.

    Raises
    ------
    InputError
        When it is no such file, or a part of it is missing.
    WrongRobotError
        It was made with another nominal model.
    """
    with BagReader(path) as reader:
        found = list(reader.messages([DATA_SET, JOINTS, *_TYPE]))
        _require_whole(reader.info, path)
    texts = [m.message.data for m in found if m.topic == DATA_SET]
    if len(texts) != 1:
        raise InputError(f"is no data file of hand_eye_node: no topic {DATA_SET}", file=str(path))
    try:
        document = json.loads(texts[0])
        made_with, rows = document["model_hash"], document["samples"]
        if made_with != arm.model_hash:
            raise WrongRobotError(
                f"{path} was made with robot '{document['robot']}' of nominal model {made_with}; "
                f"'{arm.name}' is {arm.model_hash}"
            )
        joints = [joint_sample(m.message) for m in found if m.topic == JOINTS]
        shots = [_values(m) for m in found if m.topic in _TYPE]
        document["samples"] = [
            row | {"q": q.position[q.order(arm.joint_names)].tolist(), "values": values.tolist()}
            for row, q, values in zip(rows, joints, shots, strict=True)
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the data set cannot be read: {error}", file=str(path)) from error
    return dict(document)


def _require_whole(info: BagInfo, path: Path) -> None:
    """Refuse a file that was cut off or damaged: what is missing cannot be told from the rest."""
    if info.notes or info.lost:
        told = "; ".join([*info.notes, *(part.why for part in info.lost)])
        raise InputError(f"is truncated or damaged: copy it again ({told})", file=str(path))


def _values(recorded: BagMessage) -> Array:
    """Points (n, 2) of a cloud; pose (1, 7); size and corners (1 + n, 2) of an image."""
    if recorded.topic == IMAGE:
        return np.asarray(recorded.message.data, dtype=np.float64).reshape(-1, 2)
    if recorded.topic == PROFILE:
        return cloud_points(recorded.message)[:, [0, 2]]
    p, o = recorded.message.pose.position, recorded.message.pose.orientation
    return np.array([[p.x, p.y, p.z, o.x, o.y, o.z, o.w]])
