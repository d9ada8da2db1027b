"""A tool by two parallel beams from named sweeps: flange poses at the edges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.tool.parallel_beams import ParallelBeams, parallel_tip, sweep_axis

Array = NDArray[np.float64]
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
