"""What the simulated cell is made of.

All figures are plausible, none measured. `kr150_cell.csv` holds its poses: ``home``, ``tool`` (the
pin's tip 120 mm above the beams), ``cycle`` (six that show the ball to the sensor, in their order),
``work`` (27, in the order of the programme) and ``profile`` (12 that show a ball on a stem to the
flange's line laser). From home to each of them, and from each to the next of its kind, the joints'
straight way keeps clear of everything that stands in the cell.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim import thermal_shift
from robocal_ros.cell_sim.beams import BeamStation, RoundTool, TrueInput, TrueNoise, beams_of
from robocal_ros.cell_sim.joint_motion import LAG_S
from robocal_ros.cell_sim.profile_sensor import ProfileSensor, ball_on_table
from robocal_ros.cell_sim.programs import JITTER_RAD, read_poses
from robocal_ros.cell_sim.robot import Effects, FlexibleBody, HeatPlan, TrueRobot, Warmth
from robocal_ros.cell_sim.stations import ProfileStation, SphereStation
from robocal_ros.cell_sim.thermal_shift import UNCORRECTED
from robocal_ros.cell_sim.tool_cell import laser_points
from robocal_ros.cell_sim.trajectory_controller import ControllerOptions
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.learning import THRESHOLD_M

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEAR = float(np.radians(8.0))  # corrections are smaller, working poses further apart


@dataclass(frozen=True, eq=False)
class CellPlan:
    """What the cell is made of.

    Attributes
    ----------
    robot : the true one; its ``nominal`` is what the program and the readings' users know.
    station : the true one; its ``noise`` is the robot's scatter there.
    tool : as it is mounted at the begin.
    q_start : (n,) where the robot stands then.
    fastest : (n,) or one for all: greatest speeds of its drives, rad/s (prismatic: m/s).
    limits, lag_s : whether its drives refuse what is faster; their lag: see `JointMotion`.
    controller : parameters of its trajectory controller.
    rate_hz, reading_noise_rad : of the joint readings; without noise they are exact.
    ripple : relative, of the speed of circles that the robot's program drives.
    heat : what warms it up; None: it stays cold.
    sphere : what it shows to a sensor; None: nothing.
    profile : what it looks at with a sensor of its own; None: nothing.
    working : (k, n) poses of its work, at which its tool is judged.
    """

    robot: TrueRobot
    station: BeamStation
    tool: RoundTool
    q_start: Array
    fastest: ArrayLike = np.inf
    limits: bool = False
    lag_s: float = LAG_S
    controller: ControllerOptions = field(default_factory=ControllerOptions)
    rate_hz: float = 125.0
    reading_noise_rad: float = 0.0
    ripple: float = 0.02
    heat: HeatPlan | None = None
    sphere: SphereStation | None = None
    profile: ProfileStation | None = None
    working: Array = field(default_factory=lambda: np.zeros((0, 0)))
    seed: int = 1

    @property
    def arm(self) -> SerialArm:
        """The nominal robot."""
        return self.robot.nominal

    def at_work(self, q: Array) -> tuple[Index, Index]:
        """Which working poses (k,) joints (m, n) go to, and the point of each; the last one counts.

        A point goes to the pose that it is nearest to, where no joint is further than `NEAR` away.
        """
        if not len(self.working):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        far = np.max(np.abs(q[:, None] - self.working[None]), axis=2)
        nearest, points = np.argmin(far, axis=1), np.flatnonzero(np.min(far, axis=1) < NEAR)
        last = {int(nearest[point]): int(point) for point in points}
        return np.array(list(last), dtype=np.int64), np.array(list(last.values()), dtype=np.int64)


def rigid_robot(nominal: SerialArm, error_m: float, rng: np.random.Generator) -> TrueRobot:
    """A true robot that neither bends nor warms up, with errors in all its parameters.

    ``error_m``: standard deviation of its lengths, m; its angles err by as much at 1 m.
    """
    n = nominal.n
    still = np.zeros((n, 5, n))
    return TrueRobot(
        nominal=nominal,
        static_error=error_m * rng.standard_normal((n, 5)),
        motor_gain=still,
        link_gain=still,
        body=FlexibleBody(np.zeros(n), np.zeros((n, 3)), np.ones(n), 0.0),
        eccentricity=np.zeros(n),
        phase=np.zeros(n),
        repeatability=0.0,
        effects=replace(Effects.none(), static=True),
    )


def known_laser(
    plan: CellPlan, T_base_laser: Array, q_there: Array, rng: np.random.Generator
) -> dict[str, Array]:
    """Flange positions (3,) A1 ... D4 with which this robot places the station's beams, base, m.

    They bear its scatter, the input's errors, and its geometric error as it is at joints
    ``q_there`` (n,), at the station: what it takes for upright is not.
    """
    true = plan.robot.flange(q_there, Warmth.cold(plan.arm.n))[0]
    T_known_true = plan.arm.fk(q_there) @ frames.invert(true)
    R, p = T_known_true[:3, :3], T_known_true[:3, 3]
    x, y = (
        replace(beam, start=R @ beam.start + p, end=R @ beam.end + p) for beam in plan.station.beams
    )
    return laser_points(replace(plan.station, beams=(x, y)), T_known_true @ T_base_laser, rng)


# ---- a whole cell: KR 150, sphere sensor, beams, line laser -------------------------------------


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
    robot = thermal_shift.true_robot(arm, np.random.default_rng([seed, 0]), effects)
    return CellPlan(
        robot=_as_published(robot, poses("work")),
        station=BeamStation(beams_of(T_BASE_LASER, BEAM_ANGLE_RAD, BEAM_GAP_M), INPUT, NOISE),
        tool=RoundTool.cylinder(TAUGHT, PIN_RADIUS_M),
        q_start=poses("home")[0],
        fastest=thermal_shift.FASTEST_RAD_S,
        limits=True,
        reading_noise_rad=JITTER_RAD if robot.effects.noise else 0.0,
        heat=HeatPlan(thermal_shift.WARM_UP, PROGRAMME_RAD_S / DUTY),
        sphere=SphereStation(thermal_shift.sphere_sensor(effects), FLOOR, points=points),
        profile=_line_laser() if profile else None,
        working=poses("work"),
        seed=seed,
    )


def worked_for(hours: float) -> Warmth:
    """As warm as the robot is after so long with its programme, from cold."""
    return thermal_shift.WARM_UP.step(Warmth.cold(len(DUTY)), DUTY, hours * HOUR_S)


def _line_laser() -> ProfileStation:
    scene = ball_on_table(TARGET, TARGET_RADIUS_M)
    return ProfileStation(ProfileSensor(), T_FLANGE_LASER, scene, TARGET)


def _as_published(robot: TrueRobot, working: Array) -> TrueRobot:
    """Scale the drift: what is small grows in proportion to it."""
    whole, state = replace(robot, effects=Effects()), Warmth.cold(robot.nominal.n)
    p = robot.nominal.T_flange_tool[:3, 3]
    cold, moved = whole.point(working, state, p), []
    for _ in range(round(2.0 * SHIFT_H)):
        state = thermal_shift.WARM_UP.step(state, DUTY, 1800.0)
        moved.append(np.abs(whole.point(working, state, p) - cold))
    factor = THRESHOLD_M / float(np.quantile(moved, UNCORRECTED))
    return replace(robot, motor_gain=factor * robot.motor_gain, link_gain=factor * robot.link_gain)
