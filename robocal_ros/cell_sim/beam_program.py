"""A robot's own program: goes to where a measuring step begins, and drives it."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beam_moves import Circle, Plunge
from robocal_ros.cell_sim.motion import Path
from robocal_ros.cell_sim.tool_cell import joints_at, raised
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]

PITCH_S = 8e-3  # between two points of the program's joint path
RUN_UP_S = 0.05  # short: at its begin the tool shall not be in a beam
ASIDE_M = 2e-3  # a tip that has to go further sideways goes over the station
OVER_M = 0.02  # so far above the higher one of both ends
SHORTEST_S = 0.3
FASTEST_RAD_S = 1.0
PEAK = 1.875  # of a minimum-jerk motion's speed, over its mean


def step_move(
    step: PlannedStep, start_s: float, ripple: float, phase_rad: float
) -> Circle | Plunge:
    """A step as a motion of the flange that leaves rest at ``start_s``.

    ``ripple``: relative amplitude of a circle's speed, with its phase at ``start_rad``.
    """
    if step.kind == "plunge":
        down = -step.R_base_laser[:, 2]
        return Plunge(step.T_base_flange, down, step.depth_m, step.speed_m_s, start_s)
    return Circle(
        T_base_centre=step.T_base_flange,
        R_base_laser=step.R_base_laser,
        radius=step.radius_m,
        period_s=2.0 * np.pi * step.radius_m / step.speed_m_s,
        start_s=start_s + RUN_UP_S,
        start_rad=step.start_rad,
        direction=step.direction,
        ripple=ripple,
        phase_rad=phase_rad,
        ramp_s=RUN_UP_S,
    )


def program(
    arm: SerialArm, step: PlannedStep, q_now: Array, ripple: float = 0.0, phase_rad: float = 0.0
) -> tuple[Array, Array, Array, Circle | Plunge]:
    """Joint path of a step from joints (n,) at rest: times (k,) from 0, q and qd (k, n).

    Also the motion itself, on the same clock.

    Raises
    ------
    LimitError
        When the robot does not reach it.
    """
    start = step_move(step, 0.0, ripple, phase_rad)
    try:
        way = _way(arm, step, q_now, start(np.array([start.span[0]]))[0])
        long = [
            max(SHORTEST_S, PEAK * np.max(np.abs(d)) / FASTEST_RAD_S) for d in np.diff(way, axis=0)
        ]
        arrive = np.cumsum([0.0, *long])
        move = step_move(step, float(arrive[-1]), ripple, phase_rad)
        end = move.span[1]
        time = np.linspace(0.0, end, int(np.ceil(end / PITCH_S)) + 1)
        driven = time > arrive[-1]
        q = Path(arrive, arrive, way).at(time)
        q[driven] = joints_at(arm, move(time[driven]), way[-1])
    except ValueError as error:
        raise LimitError(f"the robot does not reach step {step.name}: {error}") from error
    return time, q, _rates(time, q), move


def _way(arm: SerialArm, step: PlannedStep, q_now: Array, T_start: Array) -> Array:
    """Joints (k, n) of the way to a step's first pose, over the station where it goes aside."""
    here, up = arm.fk(q_now), step.R_base_laser[:, 2]
    along = (T_start - here) @ np.append(arm.T_flange_tool[:3, 3], 1.0)
    aside = along[:3] - (along[:3] @ up) * up
    poses = [T_start]
    if np.linalg.norm(aside) > ASIDE_M:
        rise = float((T_start - here)[:3, 3] @ up)
        lift = raised(here, (max(rise, 0.0) + OVER_M) * up)
        poses = [lift, raised(T_start, (max(-rise, 0.0) + OVER_M) * up), T_start]
    way = [q_now]
    for T in poses:
        way.append(joints_at(arm, T[None], way[-1])[0])
    return np.array(way)


def _rates(time: Array, q: Array) -> Array:
    """Velocities (k, n) of smooth cubics through the points, from rest to rest."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(time, q, bc_type="clamped")(time, 1))
