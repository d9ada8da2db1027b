"""What the simulated cell is made of."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.beam_calibration import laser_points
from robocal_ros.cell_sim.beams import BeamStation, RoundTool
from robocal_ros.cell_sim.heating import HeatPlan
from robocal_ros.cell_sim.joint_motion import LAG_S
from robocal_ros.cell_sim.profile_station import ProfileStation
from robocal_ros.cell_sim.robot import Effects, FlexibleBody, TrueRobot
from robocal_ros.cell_sim.sphere_station import SphereStation
from robocal_ros.cell_sim.thermal import Warmth
from robocal_ros.cell_sim.trajectory_goal import ControllerOptions
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm

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
