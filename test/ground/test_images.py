"""Pixels of images in the layouts that cameras send."""

from array import array
from types import SimpleNamespace as Message

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import CHANNELS, image_array

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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"encoding": "mono16"}, "encoding 'mono16' are not read.*8 bits as mono8, bgr8, rgb8"),
        ({"encoding": "bayer_rggb8"}, "'bayer_rggb8'"),
        ({"encoding": ""}, "encoding ''"),
        ({"width": 0}, "0x5 px"),
        ({"width": 2**31, "height": 2**31}, "1 to 100000000 are read"),
        ({"data": b"abc"}, "3 bytes do not hold 5 rows"),
        ({"step": 6}, "with 7 pixels of 1 bytes"),
    ],
)
def test_what_is_no_such_image_is_said(change, words):
    message = image("mono8", RGB[:, :, 0])
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=words):
        image_array(message)


def test_all_encodings_that_are_named_are_read():
    for encoding, channels in CHANNELS.items():
        assert image_array(image(encoding, RGB[:, :, :channels])).shape == RGB.shape[:2]
