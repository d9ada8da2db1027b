"""Points of a ``sensor_msgs/PointCloud2``, whatever brought the message."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's name of each ``sensor_msgs/PointField`` datatype."""
MOST_POINTS = 5_000_000


def cloud_points(message: Any) -> Array:
    """Points (n, 3), m, of the fields x, y, z; missing points stay not-a-number.

    Raises
    ------
    InputError
        When a field is missing or the data do not have the size that the message tells.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError(
            f"the cloud has no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}"
        )
    width, height = int(message.width), int(message.height)
    step, row = int(message.point_step), int(message.row_step)
    count = width * height
    if not 0 < count <= MOST_POINTS:
        raise InputError(f"the cloud has {count} points: 1 to {MOST_POINTS} are read")
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    if step <= 0 or row < width * step or len(data) < row * height:
        raise InputError(
            f"the cloud's {len(data)} bytes do not hold {height} rows of {row} bytes with "
            f"{width} points of {step} bytes"
        )
    order = ">" if message.is_bigendian else "<"
    grid = data[: row * height].reshape(height, row)[:, : width * step].reshape(count, step)
    points = np.empty((count, 3))
    for axis, name in enumerate("xyz"):
        field = fields[name]
        if field.datatype not in TYPES:
            raise InputError(f"field {name} of the cloud has the unknown type {field.datatype}")
        kind = np.dtype(order + TYPES[field.datatype])
        start = int(field.offset)
        if not 0 <= start <= step - kind.itemsize:
            raise InputError(f"field {name} of the cloud lies outside its {step} bytes")
        column = np.ascontiguousarray(grid[:, start : start + kind.itemsize])
        points[:, axis] = column.view(kind)[:, 0]
    return points
