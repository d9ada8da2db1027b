"""Pixels of a ``sensor_msgs/Image``, whatever brought the message."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError

Image = NDArray[np.uint8]

CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3}
"""Encodings that are read, and their bytes of a pixel."""
MOST_PIXELS = 100_000_000


def image_array(message: Any) -> Image:
    """Grey image (h, w), a copy; colours are weighted as ITU-R BT.601 does.

    Raises
    ------
    InputError
        When it is of another encoding, or the data do not have the size that the message tells.
    """
    encoding = str(message.encoding)
    if encoding not in CHANNELS:
        raise InputError(
            f"images of encoding '{encoding}' are not read: have the camera publish 8 bits as "
            f"{', '.join(CHANNELS)}"
        )
    channels = CHANNELS[encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    if not 0 < width * height <= MOST_PIXELS:
        raise InputError(f"the image has {width}x{height} px: 1 to {MOST_PIXELS} are read")
    data = np.frombuffer(message.data, dtype=np.uint8)
    if step < width * channels or len(data) < step * height:
        raise InputError(
            f"the image's {len(data)} bytes do not hold {height} rows of {step} bytes with "
            f"{width} pixels of {channels} bytes"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * channels]
    if channels == 1:
        return rows.copy()
    import cv2

    colours = np.ascontiguousarray(rows).reshape(height, width, channels)
    code = cv2.COLOR_BGR2GRAY if encoding == "bgr8" else cv2.COLOR_RGB2GRAY
    return np.asarray(cv2.cvtColor(colours, code), dtype=np.uint8)
