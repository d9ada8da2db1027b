"""A whole cell: a KR 150 with a pin and a ball, a sphere sensor on its right, beams on its left.

All figures are plausible, none measured. `kr150_cell.csv` holds its poses: ``home``, ``tool`` (the
pin's tip 120 mm above the beams), ``cycle`` (six that show the ball to the sensor, in their order),
``work`` (27, in the order of the programme) and ``profile`` (12 that show a ball on a stem to the
flange's line laser). From home to each of them, and from each to the next of its kind, the joints'
straight way keeps clear of everything that stands in the cell.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import BeamStation, RoundTool, TrueInput, TrueNoise, beams_of
from robocal_ros.cell_sim.cell_plan import CellPlan
from robocal_ros.cell_sim.drift import UNCORRECTED
from robocal_ros.cell_sim.heating import HeatPlan
from robocal_ros.cell_sim.motion import JITTER_RAD
from robocal_ros.cell_sim.poses import read_poses
from robocal_ros.cell_sim.profile_sensor import ProfileSensor
from robocal_ros.cell_sim.profile_station import ProfileStation
from robocal_ros.cell_sim.profile_targets import ball_on_table
from robocal_ros.cell_sim.robot import Effects, TrueRobot
from robocal_ros.cell_sim.sphere_station import SphereStation
from robocal_ros.cell_sim.thermal import Warmth
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.learning import THRESHOLD_M

Array = NDArray[np.float64]

TAUGHT = frames.transform(np.eye(3), [0.0, 0.0, 0.40])  # the pin, longer than the ball's stem
PIN_RADIUS_M = 2.5e-3
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.03, 0.01]), [1.25, 1.00, 0.60])
SPIN_RAD = float(np.radians(-135.0))  # of the flange about the laser's z, where the robot measures
BEAM_ANGLE_RAD = float(np.radians(91.4))
BEAM_GAP_M = 5.8e-5
INPUT = TrueInput(latency_s=0.004)
NOISE = TrueNoise(step_m=0.0, edge_m=1e-5)  # the scatter of a motion is in the joints
T_FLANGE_LASER = frames.transform(np.eye(3), [-0.12, 0.0, 0.10])
TARGET = np.array([1.15, -0.60, 0.50])  # a ball on a stem
TARGET_RADIUS_M = 0.0125
FLOOR = np.array([-0.28, 0.22, 0.84])  # sphere on a post, in the sensor's frame
DUTY = np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])  # of the programme at its usual speed
PROGRAMME_RAD_S = np.array([0.296, 0.216, 0.172, 0.358, 0.300, 0.466])  # its mean joint speeds
SHIFT_H = 8.0
HOUR_S = 3600.0


def poses(kind: str) -> Array:
    """Poses (m, 6) of a kind, rad."""
    return read_poses(Path(__file__).with_name("kr150_cell.csv"), kind)


def kr150_cell(
    nominal: SerialArm,
    seed: int = 1,
    effects: Effects | None = None,
    points: int = 2000,
    profile: bool = False,
) -> CellPlan:
    """The cell with an individual robot, at home.

    ``nominal``: the type's arm; ``points`` of a sphere's cloud, 0: centres alone;
    ``profile``: with a line laser on the flange. With ``effects.noise`` the encoders are noisy too,
    and show whole counts. The robot's drift has the published size: with the programme all day,
    45 % of the tip's coordinates at the working poses stay within 0.1 mm.
    """
    arm = replace(nominal, T_flange_tool=TAUGHT)
    robot = kr150.true_robot(arm, np.random.default_rng([seed, 0]), effects)
    return CellPlan(
        robot=_as_published(robot, poses("work")),
        station=BeamStation(beams_of(T_BASE_LASER, BEAM_ANGLE_RAD, BEAM_GAP_M), INPUT, NOISE),
        tool=RoundTool.cylinder(TAUGHT, PIN_RADIUS_M),
        q_start=poses("home")[0],
        fastest=kr150.FASTEST_RAD_S,
        limits=True,
        reading_noise_rad=JITTER_RAD if robot.effects.noise else 0.0,
        heat=HeatPlan(kr150.WARM_UP, PROGRAMME_RAD_S / DUTY),
        sphere=SphereStation(kr150.sphere_sensor(effects), FLOOR, points=points),
        profile=_line_laser() if profile else None,
        working=poses("work"),
        seed=seed,
    )


def worked_for(hours: float) -> Warmth:
    """As warm as the robot is after so long with its programme, from cold."""
    return kr150.WARM_UP.step(Warmth.cold(len(DUTY)), DUTY, hours * HOUR_S)


def _line_laser() -> ProfileStation:
    scene = ball_on_table(TARGET, TARGET_RADIUS_M)
    return ProfileStation(ProfileSensor(), T_FLANGE_LASER, scene, TARGET)


def _as_published(robot: TrueRobot, working: Array) -> TrueRobot:
    """Scale the drift: what is small grows in proportion to it."""
    whole, state = replace(robot, effects=Effects()), Warmth.cold(robot.nominal.n)
    p = robot.nominal.T_flange_tool[:3, 3]
    cold, moved = whole.point(working, state, p), []
    for _ in range(round(2.0 * SHIFT_H)):
        state = kr150.WARM_UP.step(state, DUTY, 1800.0)
        moved.append(np.abs(whole.point(working, state, p) - cold))
    factor = THRESHOLD_M / float(np.quantile(moved, UNCORRECTED))
    return replace(robot, motor_gain=factor * robot.motor_gain, link_gain=factor * robot.link_gain)
