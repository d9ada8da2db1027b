"""Tip and axis from two parallel beams, one above the other, along the base's y (the older way).

methods: flange z down and y_e along y_b; the tool sweeps along x_b through both beams: mid-places
x_up, x_down. Turned by 90 deg, so that x_e lies along y_b: x'_up, x'_down. The axis, flange to tip,
in the flange frame is ``(-(x_up - x_down), x'_up - x'_down, h_up - h_down)`` (thesis eq. 4-6).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.tool.flange_path import minimal_rotation

# ---- parallel beams -----------------------------------------------------------------------------


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


# ---- a tool by two parallel beams from named sweeps: flange poses at the edges ------------------


Height = Literal["up", "down"]

FIRST = ("straight", "turned")
AGAIN = ("upright", "upright_turned")
PLUNGE = "plunge"
SWEEPS = (*FIRST, *AGAIN, PLUNGE)
HEIGHTS: tuple[Height, Height] = ("up", "down")
# Flange z down; y_e along y_b, then x_e along y_b.
R_BASE_FLANGE = {
    "straight": np.diag([-1.0, 1.0, -1.0]),
    "turned": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
LARGEST_TURN_RAD = 1e-3  # off these: the axis is off by as much
Edges = Mapping[tuple[str, Height], Array]


@dataclass(frozen=True, eq=False)
class ParallelFit:
    """A tool by parallel beams: ``axis`` (3,) unit, and ``tip`` (3,), m, or None; flange frame."""

    axis: Array
    tip: Array | None


def fit_parallel(beams: ParallelBeams, x_beam_m: float | None, edges: Edges) -> ParallelFit:
    """Axis from the sweeps ``straight`` and ``turned``; the tip where it was straightened too.

    Parameters
    ----------
    x_beam_m : place of both beams along x_b, m; needed for the tip.
    edges : flange poses T_base_flange (m, 4, 4) at the edges, by sweep and beam: break and restore,
        or several of both; ``plunge`` of the upper beam has its first break.

    Raises
    ------
    TooFewSamplesError
        When a sweep is missing.
    InputError
        When edges are odd in number, the flange is turned otherwise than methods say, or the place
        of the beams is missing.
    ResidualError, RankDeficientError
        As `parallel_tip`.
    """
    more = [name for name, _ in edges if name not in FIRST]
    _require(edges, [*FIRST, *AGAIN] if more else FIRST)
    for name, R in R_BASE_FLANGE.items():
        _require_turn(name, edges, R)
    axis = sweep_axis(beams, *(_across(edges, name, beam) for name in FIRST for beam in HEIGHTS))
    if not more:
        return ParallelFit(axis, None)
    if (PLUNGE, "up") not in edges:
        raise TooFewSamplesError("there is no plunge: drive the upright tool into the upper beam")
    if x_beam_m is None:
        raise InputError("the tip needs the beams' place along the base's x: it is missing")
    first, second = (edges[name, "up"][0, :3, :3] for name in AGAIN)
    straight, turned = (
        (_across(edges, name, "up"), _across(edges, name, "down")) for name in AGAIN
    )
    z_m = float(edges[PLUNGE, "up"][:, 2, 3].mean())
    return ParallelFit(
        axis, parallel_tip(beams, x_beam_m, (first, second), (straight, turned), z_m)
    )


def _require(edges: Edges, names: Sequence[str]) -> None:
    for name in names:
        for beam in HEIGHTS:
            if (name, beam) not in edges:
                raise TooFewSamplesError(
                    f"sweep {name} has no edges of beam {beam}: sweep the tool through both beams"
                )
            if len(edges[name, beam]) % 2:
                raise InputError(
                    f"sweep {name}, beam {beam}: {len(edges[name, beam])} edges; each pass of the "
                    "tool has a break and a restore"
                )


def _require_turn(name: str, edges: Edges, R: Array) -> None:
    T = np.concatenate([edges[name, beam] for beam in HEIGHTS])
    off = np.linalg.norm(frames.log_rotation(T[:, :3, :3] @ R.T), axis=1).max()
    if off > LARGEST_TURN_RAD:
        how = "y along" if name == FIRST[0] else "x along"
        raise InputError(
            f"sweep {name}: the flange is turned by {np.degrees(off):.2f} deg from z down and "
            f"{how} the base's y (allowed {np.degrees(LARGEST_TURN_RAD):.2f} deg)"
        )


def _across(edges: Edges, name: str, beam: Height) -> Array:
    """(2,) flange x, base, m: lower and upper half of the edges, each with its mean."""
    x = np.sort(edges[name, beam][:, 0, 3])
    return np.asarray(x.reshape(2, -1).mean(axis=1))
