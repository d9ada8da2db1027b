# SPDX-License-Identifier: Apache-2.0
"""Tables of a simulated tool: the source's beam points, one circle, touches."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from bench.measured_runs import NO_NOISE, PERFECT
from robocal_ros.cell_sim.beams import BeamStation, Circle, RoundTool, beams_of
from robocal_ros.ground import frames

PUBLISHED_MM = {  # thesis table 5-3
    "A1": (793.67, -128.61, 207.45), "A2": (793.68, -123.65, 207.46),
    "A3": (793.66, -139.26, 196.72), "A4": (793.68, -139.23, 191.76),
    "B1": (805.58, -128.96, 207.46), "B2": (805.56, -124.01, 207.47),
    "B3": (805.57, -139.27, 197.19), "B4": (805.55, -139.25, 192.24),
    "C1": (796.99, -132.40, 207.44), "C2": (801.95, -132.43, 207.45),
    "C3": (786.35, -132.42, 196.86), "C4": (786.31, -132.44, 191.92),
    "D1": (796.87, -120.35, 207.47), "D2": (801.84, -120.34, 207.47),
    "D3": (786.32, -120.36, 197.13), "D4": (786.35, -120.37, 192.19),
}  # fmt: skip
RADIUS_MM, PERIOD_S, START_DEG = 12.0, 2.0, 45.0
CENTRE_MM = (3.0, -4.0)
RHO_MM = 2.5
POINT_COLUMNS = "point,x_mm,y_mm,z_mm"
TIP_MM = np.array([12.0, -34.0, 210.0])


def write(path: Path, header: str, rows: Iterable[Sequence[object]]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header.split(","))
        writer.writerows(rows)
    return path


def circle_rows(
    latency_s: float = 0.0,
    centre_mm: tuple[float, float] = CENTRE_MM,
    ripple: float = 0.0,
    ripples: int = 1,
) -> list:
    """Stamps, beams and states of a thick tool on one circle, by the simulated station."""
    station = BeamStation(beams_of(np.eye(4), np.pi / 2.0), PERFECT, NO_NOISE)
    upright = np.diag([1.0, -1.0, -1.0])
    T = frames.transform(upright, [*(1e-3 * np.array(centre_mm)), 0.13])
    start = np.radians(START_DEG)
    move = Circle(
        T, np.eye(3), 1e-3 * RADIUS_MM, PERIOD_S, start_rad=start, ripple=ripple, ripples=ripples
    )
    tool = RoundTool.cylinder(frames.transform(np.eye(3), [0.0, 0.0, 0.15]), 1e-3 * RHO_MM)
    edges = station.edges(tool, move, move.window, np.random.default_rng(0))
    return [(f"{e.time_s + latency_s:.9f}", e.beam, int(e.blocked)) for e in edges]


def touch_rows(count: int, noise_mm: float = 0.0) -> list:
    """Flange poses that bring the tip to one point; then two moves without a turn."""
    rng = np.random.default_rng(3)
    turns = rng.uniform(-0.7, 0.7, (count, 3)) + np.array([np.pi, 0.0, 0.0])
    R = frames.exp_rotation(turns)
    t = np.array([900.0, 200.0, 500.0]) - R @ TIP_MM + noise_mm * rng.standard_normal((count, 3))
    T = frames.transform(R, t)
    quat = frames.quat_xyzw(T)
    return [[*p, *q] for p, q in zip(t.tolist(), quat.tolist(), strict=True)]


def tool_tables(folder: Path) -> None:
    points = [(name, *place) for name, place in PUBLISHED_MM.items()]
    write(folder / "beams.csv", POINT_COLUMNS, points)
    write(folder / "some_beams.csv", POINT_COLUMNS, points[:-1])
    write(folder / "edges.csv", "stamp_s,beam,blocked", circle_rows())
    write(folder / "lost_edge.csv", "stamp_s,beam,blocked", circle_rows()[1:-2])
    header = "x_mm,y_mm,z_mm,qx,qy,qz,qw"
    write(folder / "touches.csv", header, touch_rows(6))
    write(folder / "few_touches.csv", header, touch_rows(3))
