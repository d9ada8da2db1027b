# SPDX-License-Identifier: Apache-2.0
"""A UR10 that a laser tracker measures, and marked points of its target: shots as messages."""

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
from hand_eye_driver import ARM, Q_NEAR, Driver, Recorded, profile, tracker_point

from bench.laser_tracker import CUBE_M, TrackerCell, six_axis_cell, true_flange
from robocal_ros.estimation.surfaces import mirror
from robocal_ros.ground import frames
from robocal_ros.hand_eye.data import SCAN
from robocal_ros.hand_eye.targets import FACES, SPHERE, target_document
from robocal_ros.hand_eye.tracker_data import TrackerData
from robocal_ros.kinematics.arm import inverse
from robocal_ros.session import events

CELL: TrackerCell = six_axis_cell(ARM, Q_NEAR)
START = {
    "target": target_document("tracker", CELL.sizes.target),
    "method": "best",
    "mount": "in-hand",
    "feature": "edge",
}
CORNERS = [0, 2, 4, 6, 8]  # of nine points on a face


class Capture(NamedTuple):
    """Joints, mark, and what is seen then at a stamp."""

    q: np.ndarray
    mark: str
    shot: Callable[[int], Recorded]


@cache
def measured() -> TrackerData:
    """With all noise of the cell."""
    return CELL.measure(np.random.default_rng(11))


def _seen(point: np.ndarray) -> Callable[[int], Recorded]:
    return lambda stamp_ns: tracker_point(stamp_ns, point)


def captures(towards: bool = False) -> Iterator[Capture]:
    """Every other point of the arcs and third profile of the scan, and five points of each face.

    ``towards``: z of the profiles grows towards the sensor.
    """
    data = measured()
    for arc in data.arcs:
        for q, point in zip(arc.q[::2], arc.points[::2], strict=True):
            yield Capture(q, arc.name, _seen(point))
    still = data.arcs[0].q[0]
    for point in data.sphere:
        yield Capture(still, SPHERE, _seen(point))
    for name, points in zip(FACES, data.faces, strict=True):
        for point in points[CORNERS]:
            yield Capture(still, name, _seen(point))
    for q, shown in list(zip(data.q, data.profiles, strict=True))[::3]:
        points = shown.points * mirror(towards)
        yield Capture(q, SCAN, lambda stamp_ns, p=points: profile(stamp_ns, p))


def captured(driver: Driver, shots: Iterable[Capture]) -> None:
    """All of these by a session that begins with them."""
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **START).done
    for q, mark, shot in shots:
        driver.robot.move(q, 0.1)
        driver.robot.rest(0.1)
        assert driver.ask(events.CAPTURE, mark=mark).done
        driver.robot.rest(0.5, shot)


def marks() -> dict[str, np.ndarray]:
    """Places (3,) in base, m, of two marks on the cube's upper edge."""
    T = CELL.T_base_cube
    return {
        f"m{i}": frames.apply(T, np.array([x * CUBE_M, 0.0, 0.0])) for i, x in ((1, 0.3), (2, 0.6))
    }


def scans_of_marks(each: int) -> Iterator[Capture]:
    """The laser line through each mark, from poses about it; the sensor's noise is the cell's."""
    rng = np.random.default_rng(5)
    R_view, t_view = CELL.T_base_view[:3, :3], CELL.T_base_view[:3, 3]
    for name, place in marks().items():
        for _ in range(each):
            turn = rng.uniform(-0.25, 0.25, 3)
            R = R_view @ frames.exp_rotation(turn)
            x, z = rng.uniform([-0.008, 0.192], [0.008, 0.2])
            share = np.linspace(0.0, 1.0, 12)[:, None]
            way = frames.transform(
                R_view @ frames.exp_rotation(share * turn),
                (1.0 - share) * t_view + share * (place - R @ [x, 0.0, z]),
            )
            q = inverse(ARM, way @ frames.invert(CELL.T_flange_sensor), Q_NEAR)[-1:]
            T_base_sensor = true_flange(ARM, q)[0] @ CELL.T_flange_sensor
            seen = CELL.sensor.shoot(T_base_sensor, CELL.scene, rng)
            seen = seen[np.isfinite(seen).all(axis=1)]
            yield Capture(q[0], name, lambda stamp_ns, p=seen: profile(stamp_ns, p))
