"""The edges of a whole run as a maximum likelihood problem over the tool in the flange frame.

A circle's edge: the line of the tool's axis passes the line of the beam at a signed distance
``s = n . (tip - A)`` (n the common normal of both), which is +r or -r of the tool there. A plunge's
edge: the tip's plane reaches the beam, ``w . (tip - A) = 0`` (w the part of the axis across the
beam; less the beam's reach). Both hold for any flange pose and any tilt; for a cylinder exactly.

A receiver switches back at more light than it switched off at: both edges come late by a depth,
which differs from a latency by the speed. The robot's repeatability is an unknown shift of each
step with its own prior, and so is each point of the laser frame, so that the covariance of the
tool is that of all of them together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.tool.beam_edges import BEAMS, BeamEdge
from robocal_ros.tool.flange_path import FlangePath
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.tool_axis import minimal_rotation

Array = NDArray[np.float64]
StepKind = Literal["circle", "plunge"]

TOOL_NAMES = ("tip_x", "tip_y", "tip_z", "tilt_x", "tilt_y")
START_RADIUS_M = 2e-3
HYSTERESIS_M = 2e-4  # sigma of a receiver's: light of a beam of half a millimetre
EXACT_M = 1e-9  # prior of what is taken as exact, against edges of micrometres


@dataclass(frozen=True)
class RobotNoise:
    """How well the robot repeats, m, one standard deviation of each axis.

    Attributes
    ----------
    step_m : common to a circle or a plunge.
    edge_m : further at each edge.
    """

    step_m: float = 3e-5
    edge_m: float = 1e-5


@dataclass(frozen=True)
class BeamStep:
    """A circle or a plunge and its edges."""

    name: str
    kind: StepKind
    edges: Sequence[BeamEdge]


@dataclass(frozen=True, eq=False)
class ToolState:
    """Unknowns of a run.

    Attributes
    ----------
    tip : (3,) in the flange frame, m; ``axis`` (3,) unit vector from flange to tip there.
    latency_s : of the edges behind the robot's readings.
    depth : of an edge behind the mean of break and restore, m: the receiver's hysteresis.
    radius : (circles, 2) of the tool as each circle and beam sees it, m.
    shift : (steps, 3) of the flange in each step, base, m.
    bend : (4, 2) of the laser's points A ... D, horizontally across the beam and upwards, m.
    """

    tip: Array
    axis: Array
    latency_s: float
    depth: float
    radius: Array
    shift: Array
    bend: Array

    @classmethod
    def taught(cls, T_flange_tool: Array, circles: int, steps: int) -> "ToolState":
        """Where the search begins."""
        return cls(
            tip=T_flange_tool[:3, 3],
            axis=T_flange_tool[:3, 2],
            latency_s=0.0,
            depth=0.0,
            radius=np.full((circles, 2), START_RADIUS_M),
            shift=np.zeros((steps, 3)),
            bend=np.zeros((4, 2)),
        )


def across(axis: Array) -> Array:
    """(3, 2) the two directions in which an axis can tilt: columns across it, near x and y."""
    return minimal_rotation([0.0, 0.0, 1.0], axis)[:, :2]


@dataclass(frozen=True)
class Held:
    """What a run need not determine: how far it may be from the taught tool (sigma); None: free.

    ``tilt_rad`` of the axis, each way; ``along_m`` of the tip along the axis.
    """

    tilt_rad: float | None = None
    along_m: float | None = None


@dataclass(frozen=True, eq=False)
class RunProblem:
    """Residuals of all edges; built by `run_problem`.

    ``taper``: growth of the tool's radius per length above the tip; ``height`` (circles,): of each
    circle above the tip, where its radius counts.
    """

    laser: LaserFrame
    path: FlangePath
    beam: NDArray[np.int64]
    step: NDArray[np.int64]
    circle: NDArray[np.int64]  # -1 in a plunge
    side: Array
    way: Array  # +1 where the gap grows, -1 where it shrinks
    time_s: Array
    sigma_m: Array
    circles: int
    steps: int
    taper: float
    height: Array
    taught: ToolState
    noise: RobotNoise
    held: Held
    scale_components: int = field(default=1, init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        radii = [f"radius_{b}_{c}" for c in range(self.circles) for b in BEAMS]
        shifts = [f"shift_{a}_{s}" for s in range(self.steps) for a in "xyz"]
        bends = [f"laser_{p}_{a}" for p in "ABCD" for a in ("across", "up")]
        return (*TOOL_NAMES, "latency", "depth", *radii, *shifts, *bends)

    @property
    def undetermined(self) -> int:
        """How many unknowns have no prior."""
        held = 2 * (self.held.tilt_rad is not None) + (self.held.along_m is not None)
        return 6 + 2 * self.circles - held

    @property
    def _starts(self) -> tuple[int, int, int]:
        """First columns of radii, shifts and bends."""
        shifts = 7 + 2 * self.circles
        return 7, shifts, shifts + 3 * self.steps

    @property
    def prior(self) -> Array:
        """Information matrix of shifts, bends and what is held; none for the rest."""
        _, shifts, bends = self._starts
        diagonal = np.zeros(len(self.names))
        diagonal[6] = 1.0 / HYSTERESIS_M**2
        diagonal[shifts:bends] = 1.0 / max(self.noise.step_m, EXACT_M) ** 2
        diagonal[bends:] = 1.0 / max(self.laser.sigma_m, EXACT_M) ** 2
        if self.held.tilt_rad is not None:
            diagonal[3:5] = 1.0 / self.held.tilt_rad**2
        information = np.diag(diagonal)
        if self.held.along_m is not None:
            axis = self.taught.axis
            information[:3, :3] += np.outer(axis, axis) / self.held.along_m**2
        return information

    def deviation(self, state: ToolState) -> Array:
        """Distance from the prior's mean."""
        _, shifts, bends = self._starts
        away = np.zeros(len(self.names))
        away[:3] = state.tip - self.taught.tip
        away[3:5] = across(state.axis).T @ (state.axis - self.taught.axis)
        away[6] = state.depth
        away[shifts:bends], away[bends:] = state.shift.ravel(), state.bend.ravel()
        return away

    def retract(self, state: ToolState, step: Array) -> ToolState:
        """Move by an increment; the axis stays a unit vector."""
        radii, shifts, bends = self._starts
        tilt = across(state.axis) @ step[3:5]
        turn = frames.exp_rotation(np.cross(state.axis, tilt))
        return ToolState(
            tip=state.tip + step[:3],
            axis=turn @ state.axis,
            latency_s=state.latency_s + float(step[5]),
            depth=state.depth + float(step[6]),
            radius=state.radius + step[radii:shifts].reshape(-1, 2),
            shift=state.shift + step[shifts:bends].reshape(-1, 3),
            bend=state.bend + step[bends:].reshape(4, 2),
        )

    def linearise(self, state: ToolState) -> tuple[Array, Array]:
        """Residual (m, 1) and Jacobian (m, 1, k)."""
        T, twist = self.path.at(self.time_s - state.latency_s)
        R = T[:, :3, :3]
        arm, axis = R @ state.tip, R @ state.axis
        tip = arm + T[:, :3, 3] + state.shift[self.step]
        touch = self.touch(tip, axis, state.bend)
        circle = self.circle >= 0
        own = np.maximum(self.circle, 0)
        radius = state.radius[own, self.beam] + self.taper * (touch.height - self.height[own])
        wanted = np.where(circle, self.side * radius, -self.laser.reach[self.beam])
        residual = touch.gap - wanted - self.way * state.depth
        taper = np.where(circle, self.side * self.taper, 0.0)[:, None]
        by_tip = touch.normal - taper * touch.height_by_tip
        by_axis = touch.by_axis - taper * touch.height_by_axis
        radii, shifts, bends = self._starts
        rows = np.arange(len(residual))
        J = np.zeros((len(residual), len(self.names)))
        J[:, :3] = np.einsum("mi,mij->mj", by_tip, R)
        J[:, 3:5] = np.einsum("mi,mij->mj", by_axis, R) @ across(state.axis)
        velocity = twist[:, :3] + np.cross(twist[:, 3:], arm)
        turning = np.cross(twist[:, 3:], axis)  # a held orientation shakes as its readings do
        J[:, 5] = -np.sum(by_tip * velocity + by_axis * turning, axis=1)
        J[:, 6] = -self.way
        J[rows, radii + 2 * own + self.beam] = np.where(circle, -self.side, 0.0)
        for i in range(3):
            J[rows, shifts + 3 * self.step + i] = by_tip[:, i]
        for end, share in ((0, 1.0 - touch.share), (1, touch.share)):
            first = bends + 4 * self.beam + 2 * end
            J[rows, first] = -share * np.sum(by_tip * self.laser.normals[self.beam], axis=1)
            J[rows, first + 1] = -share * (by_tip @ self.laser.T_base_laser[:3, 2])
        return (residual / self.sigma_m)[:, None], (J / self.sigma_m[:, None])[:, None, :]

    def touch(self, tip: Array, axis: Array, bend: Array) -> "Touch":
        """How tips and axes (m, 3), base, lie to each edge's beam."""
        laser = self.laser
        up = laser.T_base_laser[:3, 2]
        normals = np.repeat(laser.normals, 2, axis=0)
        points = laser.points + bend[:, :1] * normals + bend[:, 1:] * up
        start, end = points[2 * self.beam], points[2 * self.beam + 1]
        return touch_of(tip, axis, start, end, self.circle >= 0, self.beam)


@dataclass(frozen=True, eq=False)
class Touch:
    """How an axis and a beam lie to each other, and the derivatives by tip and axis, base.

    ``gap`` (m,) along ``normal`` (m, 3); ``height`` (m,) of the touch above the tip, and its
    derivatives; ``share`` (m,) of the way from the beam's first to its second point.
    """

    gap: Array
    normal: Array
    by_axis: Array
    height: Array
    height_by_tip: Array
    height_by_axis: Array
    share: Array


def touch_of(
    tip: Array,
    axis: Array,
    start: Array,
    end: Array,
    circle: NDArray[np.bool_],
    beam: NDArray[np.int64],
) -> Touch:
    """Geometry of axes and beams (m, 3) each, base; see `Touch`."""
    length = np.linalg.norm(end - start, axis=1)
    u = (end - start) / length[:, None]
    cosine = np.sum(u * axis, axis=1)[:, None]
    sine2 = 1.0 - cosine**2
    apart = tip - start
    along = np.sum(u * apart, axis=1)[:, None]
    # Nearest points of the two lines: tip - height axis, start + reach u.
    height = (np.sum(axis * apart, axis=1)[:, None] - cosine * along) / sine2
    reach = along - height * cosine
    height_by_tip = (axis - cosine * u) / sine2
    height_by_axis = (apart - u * along + 2.0 * height * cosine * u) / sine2
    n = np.cross(u, axis) / np.sqrt(sine2)
    n = np.where((beam == 0)[:, None], n, -n)
    w = (axis - cosine * u) / np.sqrt(sine2)
    level = np.sum(w * apart, axis=1)[:, None]
    rest = apart - w * level
    w_by_axis = (rest - u * np.sum(u * rest, axis=1)[:, None]) / np.sqrt(sine2)
    upright = circle[:, None]
    normal = np.where(upright, n, w)
    share = np.where(circle, reach[:, 0], along[:, 0]) / length
    return Touch(
        gap=np.sum(normal * apart, axis=1),
        normal=normal,
        by_axis=np.where(upright, -height * n, w_by_axis),
        height=height[:, 0],
        height_by_tip=height_by_tip,
        height_by_axis=height_by_axis,
        share=share,
    )
