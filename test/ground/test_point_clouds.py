"""Points of clouds in the layouts that sensors send."""

from types import SimpleNamespace as Message

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import cloud_points

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
    ("change", "words"),
    [
        ({"fields": []}, "no field x, y, z"),
        ({"data": b"abc"}, "3 bytes do not hold"),
        ({"width": 0}, "0 points"),
        ({"point_step": 4}, "outside its 4 bytes"),
        ({"fields": [Message(name=n, offset=0, datatype=99) for n in "xyz"]}, "unknown type 99"),
    ],
)
def test_what_is_no_cloud_is_said(change, words):
    message = cloud()
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=words):
        cloud_points(message)
