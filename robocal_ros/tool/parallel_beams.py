"""Tip and axis from two parallel beams, one above the other, along the base's y (the older way).

methods: flange z down and y_e along y_b; the tool sweeps along x_b through both beams: mid-places
x_up, x_down. Turned by 90 deg, so that x_e lies along y_b: x'_up, x'_down. The axis, flange to tip,
in the flange frame is ``(-(x_up - x_down), x'_up - x'_down, h_up - h_down)`` (thesis eq. 4-6).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError, RankDeficientError, ResidualError
from robocal_ros.tool.tool_axis import minimal_rotation

Array = NDArray[np.float64]

SMALLEST_HEIGHT_M = 2e-3
LARGEST_LEAN_M = 3e-4  # between both beams after straightening


@dataclass(frozen=True)
class ParallelBeams:
    """Heights of the upper and the lower beam in base, m."""

    up_m: float
    down_m: float

    def __post_init__(self) -> None:
        if self.up_m - self.down_m < SMALLEST_HEIGHT_M:
            raise RankDeficientError(
                f"the beams are {(self.up_m - self.down_m) * 1e3:.2f} mm apart in height: the tilt "
                "needs beams further apart, the upper one first",
                ("tilt of the tool",),
            )


def _middle(edges: ArrayLike, what: str) -> float:
    places = np.asarray(edges, dtype=np.float64)
    if places.shape != (2,) or not np.all(np.isfinite(places)):
        raise InputError(f"{what} needs the places of its break and its restore, got {places}")
    return float(places.mean())


def sweep_axis(
    beams: ParallelBeams,
    up: ArrayLike,
    down: ArrayLike,
    turned_up: ArrayLike,
    turned_down: ArrayLike,
) -> Array:
    """Unit tool axis (3,), flange to tip, flange frame.

    ``up``, ``down`` (2,): flange x_b at break and restore of each beam; ``turned_*`` the same after
    the turn by 90 deg. In m.

    Raises
    ------
    InputError
        When an edge is missing.
    """
    lean = _middle(up, "upper beam") - _middle(down, "lower beam")
    turned = _middle(turned_up, "upper beam, turned") - _middle(turned_down, "lower beam, turned")
    v = np.array([-lean, turned, beams.up_m - beams.down_m])
    return np.asarray(v / np.linalg.norm(v))


def straighten(R_base_flange: Array, v_flange: Array) -> Array:
    """R_base_flange (3, 3) that sets the axis straight down, by the smallest turn."""
    return np.asarray(minimal_rotation(R_base_flange @ v_flange, [0.0, 0.0, -1.0]) @ R_base_flange)


def parallel_tip(
    beams: ParallelBeams,
    x_beam_m: float,
    T_straight: tuple[Array, Array],
    x_straight: tuple[tuple[ArrayLike, ArrayLike], tuple[ArrayLike, ArrayLike]],
    z_first_break_m: float,
) -> Array:
    """Tip (3,) in the flange frame, m, with the straightened tool.

    Parameters
    ----------
    x_beam_m : place of both beams along x_b, m.
    T_straight : two flange rotations (3, 3) with the axis down, one turned by 90 deg about z.
    x_straight : flange x_b at break and restore, of the upper and the lower beam, at each of them.
    z_first_break_m : flange height at the first break of the upper beam, driving down: the tip is
        D = z - h_up below the flange (eq. 4-7).

    Raises
    ------
    ResidualError
        When the re-sweep shows a tool that still leans.
    RankDeficientError
        When both sweeps have one orientation.
    """
    rows, right = [np.array([0.0, 0.0, 1.0])], [beams.up_m - z_first_break_m]
    frame = T_straight[0]
    for R, (up, down) in zip(T_straight, x_straight, strict=True):
        x_up, x_down = _middle(up, "upper beam"), _middle(down, "lower beam")
        if abs(x_up - x_down) > LARGEST_LEAN_M:
            raise ResidualError(
                f"the straightened tool leans by {abs(x_up - x_down) * 1e3:.3f} mm between the "
                f"beams (allowed {LARGEST_LEAN_M * 1e3:.1f} mm): straighten it again"
            )
        rows.append(np.array([1.0, 0.0, 0.0]) @ R @ frame.T)
        right.append(x_beam_m - 0.5 * (x_up + x_down))
    A = np.array(rows)
    if np.linalg.cond(A) > 1e3:
        raise RankDeficientError(
            "both sweeps have one orientation: turn the flange by 90 deg about z in between",
            ("place along the beams",),
        )
    return np.asarray(frame.T @ np.linalg.solve(A, np.array(right)))
