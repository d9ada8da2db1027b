# SPDX-License-Identifier: Apache-2.0
"""Samples from messages: joints, images and clouds in the layouts that cameras and sensors send."""

from array import array
from types import SimpleNamespace as Message

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import (
    CHANNELS,
    CORRECTED,
    TAUGHT,
    Silence,
    cloud_points,
    image_array,
    joint_sample,
)


def reading(frame: str) -> Message:
    header = Message(stamp=Message(sec=1, nanosec=0), frame_id=frame)
    return Message(header=header, name=["a"], position=[0.5])


@pytest.mark.parametrize("mark", [CORRECTED, TAUGHT])
def test_joint_states_of_a_correction_are_refused(mark):
    """Else the model would be identified against itself and ratchet."""
    with pytest.raises(InputError, match="subscribe to the robot's own"):
        joint_sample(reading(mark))
    assert joint_sample(reading("")).position.tolist() == [0.5]


RGB = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
LUMA = [0.299, 0.587, 0.114]  # of red, green and blue, ITU-R BT.601


def image(encoding: str, pixels: np.ndarray, pad: int = 0) -> Message:
    """An image with padding after each row."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    step = rows.shape[1] + pad
    data = np.full((height, step), 77, dtype=np.uint8)
    data[:, : rows.shape[1]] = rows
    return Message(encoding=encoding, width=width, height=height, step=step, data=data.tobytes())


@pytest.mark.parametrize("pad", [0, 5])
def test_grey_pixels_come_back(pad):
    grey = RGB[:, :, 0]
    message = image("mono8", grey, pad)
    # as rclpy, recordings and others have them
    for data in (array("B", message.data), np.frombuffer(message.data, np.uint8), message.data):
        message.data = data
        found = image_array(message)
        assert np.array_equal(found, grey)
        assert not np.shares_memory(found, np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_colours_become_grey_by_their_own_order(encoding, pad):
    pixels = RGB if encoding == "rgb8" else RGB[:, :, ::-1]
    found = image_array(image(encoding, pixels, pad))
    assert found.dtype == np.uint8
    assert np.abs(found - RGB @ LUMA).max() <= 1.0  # rounded to whole steps


def test_all_encodings_that_are_named_are_read():
    for encoding, channels in CHANNELS.items():
        assert image_array(image(encoding, RGB[:, :, :channels])).shape == RGB.shape[:2]


POINTS = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 3))


def cloud(kind: str = "<f4", height: int = 1, pad: int = 0, row_pad: int = 0) -> Message:
    """An organised or plain cloud with padding after each point and row."""
    size = np.dtype(kind).itemsize
    step, width = 3 * size + pad, len(POINTS) // height
    grid = np.zeros((height, width * step + row_pad), dtype=np.uint8)
    values = POINTS.astype(kind).view(np.uint8).reshape(height, width, 3 * size)
    cells = np.zeros((height, width, step), dtype=np.uint8)
    cells[:, :, : 3 * size] = values
    grid[:, : width * step] = cells.reshape(height, -1)
    datatype = 7 if size == 4 else 8
    fields = [Message(name=n, offset=i * size, datatype=datatype) for i, n in enumerate("xyz")]
    return Message(
        fields=fields,
        width=width,
        height=height,
        point_step=step,
        row_step=width * step + row_pad,
        is_bigendian=kind.startswith(">"),
        data=grid.tobytes(),
    )


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4"])
@pytest.mark.parametrize(("height", "pad", "row_pad"), [(1, 0, 0), (1, 20, 0), (3, 4, 8)])
def test_points_come_back(kind, height, pad, row_pad):
    found = cloud_points(cloud(kind, height, pad, row_pad))
    assert found == pytest.approx(POINTS, abs=1e-7 if kind.endswith("4") else 0.0)


@pytest.mark.parametrize(
    ("read", "change", "words"),
    [
        (
            image_array,
            {"encoding": "mono16"},
            "encoding 'mono16' are not read.*8 bits as mono8, bgr8, rgb8",
        ),
        (image_array, {"encoding": "bayer_rggb8"}, "'bayer_rggb8'"),
        (image_array, {"encoding": ""}, "encoding ''"),
        (image_array, {"width": 0}, "0x5 px"),
        (image_array, {"width": 2**31, "height": 2**31}, "1 to 100000000 are read"),
        (image_array, {"data": b"abc"}, "3 bytes do not hold 5 rows"),
        (image_array, {"step": 6}, "with 7 pixels of 1 bytes"),
        (cloud_points, {"fields": []}, "no field x, y, z"),
        (cloud_points, {"data": b"abc"}, "3 bytes do not hold"),
        (cloud_points, {"width": 0}, "0 points"),
        (cloud_points, {"point_step": 4}, "outside its 4 bytes"),
        (
            cloud_points,
            {"fields": [Message(name=n, offset=0, datatype=99) for n in "xyz"]},
            "unknown type 99",
        ),
    ],
)
def test_what_is_no_such_message_is_said(read, change, words):
    message = image("mono8", RGB[:, :, 0]) if read is image_array else cloud()
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=words):
        read(message)


def test_a_clock_that_stands_is_silent():
    silence = Silence()
    silence.heard_if_new(7, 0.0)
    for tick in range(1, 101):
        silence.heard_if_new(7, tick * 0.01)
        silence.look(tick * 0.01)
    assert abs(silence.lasts_s - 1.0) < 1e-9
    silence.heard_if_new(8, 1.0)
    assert silence.look(1.0) == 0.0
