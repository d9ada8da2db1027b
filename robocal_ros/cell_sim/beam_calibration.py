"""Calibration of a beam station by a robot that carries a cylinder: the edges A1 to D4."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beam_moves import Sweep
from robocal_ros.cell_sim.beams import BeamStation, RoundTool
from robocal_ros.ground import frames
from robocal_ros.tool.edges import BEAMS

Array = NDArray[np.float64]

DOWN = np.array([0.0, 0.0, -1.0])
SWEEP_M = 1e-2
SWEEP_S = 1.0
CYLINDER_M = 2.5e-3  # radius


def calibration_tool(reach: float = 0.15) -> RoundTool:
    """A cylinder along the flange's z."""
    T = np.eye(4)
    T[2, 3] = reach
    return RoundTool.cylinder(T, CYLINDER_M)


def laser_points(
    station: BeamStation, T_base_laser: Array, rng: np.random.Generator, along: float = 6e-3
) -> dict[str, Array]:
    """Flange positions A1 ... D4 at the edges of a calibration tool in base.

    Each point is swept back and forth, so that a constant latency cancels.

    ``T_base_laser`` is roughly known; ``along`` is the way of the points from the crossing.
    """
    return {
        name: place
        for b, ends in ((0, "AB"), (1, "CD"))
        for end, sign in zip(ends, (-1.0, 1.0), strict=True)
        for name, place in _points_of(station, b, T_base_laser, sign * along, end, rng).items()
    }


def _points_of(
    station: BeamStation,
    b: int,
    T_base_laser: Array,
    along: float,
    name: str,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """Two sweeps of one point: upright across the beam, then level in z."""
    tool = calibration_tool()
    e = np.eye(3)[b]  # base axis nearest to the beam
    side = np.cross([0.0, 0.0, 1.0], e)
    beam = station.beams[b]
    u = (beam.end - beam.start) / np.linalg.norm(beam.end - beam.start)
    to = (T_base_laser[:3, 3] + along * e - beam.start) @ e / (u @ e)
    target = beam.start + to * u
    reach = tool.T_flange_tool[2, 3] - 0.02
    found: dict[str, Array] = {}
    for first, pointing, way in ((1, DOWN, side), (3, -side, DOWN)):
        R = np.column_stack([e, np.cross(pointing, e), pointing])
        start = frames.transform(R, target - reach * pointing - 0.5 * SWEEP_M * way)
        places = []
        for sweep in (Sweep(start, SWEEP_M * way, SWEEP_S), Sweep(start, SWEEP_M * way, -SWEEP_S)):
            edges = station.edges(tool, sweep, sweep.window, rng)
            own = [edge.time_s for edge in edges if edge.beam == BEAMS[b]]
            places.append(sweep(np.array(own))[:, :3, 3])
        both = 0.5 * (places[0] + places[1][::-1])
        found[f"{name}{first}"], found[f"{name}{first + 1}"] = both
    return found


def point_sigma(station: BeamStation) -> float:
    """Standard deviation of a coordinate of A ... D across its beam, m."""
    source, noise, speed = station.input, station.noise, SWEEP_M / SWEEP_S
    stamp = np.hypot(source.jitter_s, source.sample_period_s / np.sqrt(12.0))
    edge = np.hypot(noise.edge_m, speed * stamp)
    return float(np.sqrt(noise.step_m**2 / 2.0 + edge**2 / 4.0))
