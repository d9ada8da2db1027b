# SPDX-License-Identifier: Apache-2.0
"""The touch test: marked points scanned with a mount and touched with the robot.

The sources' evaluation (sphere and step targets, section on experiments): accuracy is the distance
of scanned points from touched ones, stability three times the standard deviation of one point
scanned from several poses, along the worst axis of the base.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.estimation.assessment import ErrorSummary, Verdict, errors_document, summarise
from robocal_ros.estimation.edge import EdgeRule, fit_edge
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RobocalError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Index
from robocal_ros.hand_eye.files import ScannedPoints, SensorMount
from robocal_ros.hand_eye.mount_problem import same_pose
from robocal_ros.hand_eye.profiles import Profile

if TYPE_CHECKING:
    from robocal_ros.hand_eye.documents import TouchedPointsDocument

FEWEST_POSES = 3  # from which a point is scanned, for a standard deviation


@dataclass(frozen=True, eq=False)
class TouchTest:
    """What scanned points say of a mount.

    ``points``: names, p of them; ``place`` (p, 3): mean of each, base, m; ``count`` (p,).
    ``three_sigma_m`` (p,): along the worst axis; not a number of fewer than three poses.
    ``distance_m`` (m,): of each scan of a touched point from there; empty where none was touched.
    ``off_m``: by name, of the mean of a touched point from there. ``limit_m``: what is allowed.
    """

    points: tuple[str, ...]
    place: Array
    count: tuple[int, ...]
    three_sigma_m: Array
    distance_m: Array
    off_m: Mapping[str, float]
    limit_m: float

    @property
    def accuracy(self) -> ErrorSummary | None:
        """Of all scans of touched points."""
        return summarise(self.distance_m) if len(self.distance_m) else None

    @property
    def stability_m(self) -> float | None:
        """Largest of the three sigmas; None where no point was scanned often enough."""
        known = self.three_sigma_m[np.isfinite(self.three_sigma_m)]
        return float(known.max()) if len(known) else None

    @property
    def verdict(self) -> Verdict:
        """By what all scans are off by; where nothing was touched, by how they scatter."""
        accuracy, stability_m = self.accuracy, self.stability_m
        words = []
        if accuracy is not None:
            words.append(f"scanned points are off by {1e3 * accuracy.mean_m:.3f} mm on average")
        if stability_m is not None:
            words.append(f"three sigma of one point {1e3 * stability_m:.3f} mm at most")
        if accuracy is None:
            words.append("no point was touched, so what all scans share does not show")
        worst_m = stability_m if accuracy is None else accuracy.rms_m
        if worst_m is None:
            what = f"no point was touched, and none scanned from {FEWEST_POSES} poses or more"
            return Verdict(Code.TOO_FEW_SAMPLES, what)
        if worst_m > self.limit_m:
            words.append(f"allowed are {1e3 * self.limit_m:g} mm: the mount is not this one")
            return Verdict(Code.RESIDUAL_TOO_LARGE, "; ".join(words))
        return Verdict(Code.ACCEPT, "; ".join(words))

    def document(self) -> "TouchedPointsDocument":
        """In the units people read."""
        sigma = [1e3 * s if np.isfinite(s) else None for s in self.three_sigma_m.tolist()]
        rows = zip(self.points, self.count, self.place.tolist(), sigma, strict=True)
        stability_m, accuracy = self.stability_m, self.accuracy
        return {
            "points": [
                {
                    "point": name,
                    "scans": count,
                    "xyz_mm": [1e3 * x for x in place],
                    "three_sigma_mm": three,
                    "off_mm": 1e3 * self.off_m[name] if name in self.off_m else None,
                }
                for name, count, place, three in rows
            ],
            "accuracy_mm": None if accuracy is None else errors_document(accuracy),
            "three_sigma_mm": None if stability_m is None else 1e3 * stability_m,
        }


def scanned_points(
    points: Sequence[str], profiles: Sequence[Profile], T_base_flange: Array, rule: EdgeRule
) -> tuple[ScannedPoints, dict[str, str]]:
    """Marked points of an edge or groove where the laser line crosses it, one in each profile.

    ``points`` (m,): their names; ``T_base_flange`` (m, 4, 4). Beside them why a profile, by its
    name, shows none.

    Raises `TooFewSamplesError` when none shows one.
    """
    kept, seen = list[int](), list[Array]()
    rejected: dict[str, str] = {}
    for i, profile in enumerate(profiles):
        try:
            seen.append(fit_edge(profile.points, rule).point)
            kept.append(i)
        except RobocalError as error:
            rejected[profile.name] = str(error)
    if not kept:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(rejected.items())[:1])
        raise TooFewSamplesError(f"no profile shows a marked point: {why or 'none was captured'}")
    return ScannedPoints(
        tuple(points[i] for i in kept), np.array(seen), T_base_flange[kept]
    ), rejected


def touch_test(
    mount: SensorMount, scanned: ScannedPoints, touched: Mapping[str, Array], limit_m: float
) -> TouchTest:
    """Judge a mount by scanned points; ``touched``: places (3,) in base, m, of some or none.

    Raises `InputError` for a touched point that was not scanned.
    """
    if missing := [name for name in touched if name not in scanned.point]:
        raise InputError(
            f"point '{missing[0]}' was touched but not scanned; scanned are "
            f"{', '.join(dict.fromkeys(scanned.point))}"
        )
    seen = scanned.points
    if mount.linearity is not None:
        seen = mount.linearity.corrected(seen)
    p_sensor = np.column_stack([seen[:, 0], np.zeros(len(seen)), seen[:, 1]])
    p_base = frames.apply(scanned.T_base_flange @ mount.T_parent_sensor, p_sensor)
    names = tuple(dict.fromkeys(scanned.point))
    own = [np.array([name == one for one in scanned.point]) for name in names]
    place = np.array([p_base[rows].mean(axis=0) for rows in own])
    pose = same_pose(scanned.T_base_flange)
    three = np.array([_three_sigma_m(p_base[rows], pose[rows]) for rows in own])
    known = [i for i, name in enumerate(scanned.point) if name in touched]
    truth = np.array([touched[scanned.point[i]] for i in known]).reshape(-1, 3)
    distance = np.linalg.norm(p_base[known] - truth, axis=1)
    off = {n: float(np.linalg.norm(place[names.index(n)] - p)) for n, p in touched.items()}
    return TouchTest(names, place, tuple(int(r.sum()) for r in own), three, distance, off, limit_m)


def _three_sigma_m(place: Array, pose: Index) -> float:
    """Of places (n, 3) of one point along the worst axis, not a number from too few poses.

    Scans from one ``pose`` (n,) count with their mean: they agree, wherever the sensor sits.
    """
    seen = np.array([place[pose == one].mean(axis=0) for one in np.unique(pose)])
    return 3.0 * float(seen.std(axis=0, ddof=1).max()) if len(seen) >= FEWEST_POSES else np.nan


def compared(found: Mapping[str, TouchTest]) -> Verdict:
    """Of several places, by name, all judged by the same points: ACCEPT where each of them passed.

    Else the code of the first that did not. The best is the one whose scans are nearest to what was
    touched; where nothing was, the steadiest.
    """
    if len(found) == 1:
        return next(iter(found.values())).verdict
    passed = [name for name, test in found.items() if test.verdict.accept]
    words = f"{len(passed)} of {len(found)} pass"
    figures = {
        name: test.accuracy.rms_m if test.accuracy else test.stability_m
        for name, test in found.items()
    }
    known = {name: value for name, value in figures.items() if value is not None}
    if known:
        best = min(known, key=lambda name: known[name])
        what = "off" if found[best].accuracy else "three sigma"
        words += f"; best is {best}: {what} {1e3 * known[best]:.3f} mm"
        words += " rms" if found[best].accuracy else ""
    failed = next((test for name, test in found.items() if name not in passed), None)
    if failed is None:
        return Verdict(Code.ACCEPT, words)
    others_named = ", ".join(name for name in found if name not in passed)
    return Verdict(failed.verdict.code, f"{words}; not {others_named}: {failed.verdict.reason}")
