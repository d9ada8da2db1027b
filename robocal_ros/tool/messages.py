"""Steps and tools as messages: pure mapping."""

import numpy as np
from geometry_msgs.msg import Quaternion, TransformStamped
from numpy.typing import NDArray
from robocal_msgs.msg import ToolFrame, ToolStep

from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros.conversions import header, pose_message, transform_message
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]

KINDS = {"circle": ToolStep.CIRCLE, "plunge": ToolStep.PLUNGE}


def step_message(step: PlannedStep, run: int, stamp_ns: int, frame: str) -> ToolStep:
    """A step that is awaited."""
    turn = frames.quat_xyzw(frames.transform(step.R_base_laser, np.zeros(3))).tolist()
    return ToolStep(
        header=header(stamp_ns, frame),
        run=run,
        number=step.number,
        of=step.of,
        kind=KINDS[step.kind],
        name=step.name,
        flange=pose_message(step.T_base_flange),
        laser=Quaternion(**dict(zip("xyzw", turn, strict=True))),
        radius=step.radius_m,
        speed=step.speed_m_s,
        direction=step.direction,
        start_angle=step.start_rad,
        depth=step.depth_m,
        text=step_words(step),
    )


def step_words(step: PlannedStep) -> str:
    """A step for a person who drives the robot."""
    where = ", ".join(f"{1e3 * x:.2f}" for x in step.T_base_flange[:3, 3])
    place = f"step {step.number} of {step.of}, {step.name}: flange at ({where}) mm"
    speed = f"{step.speed_m_s * 1e3:.0f} mm/s"
    if step.kind == "plunge":
        return f"{place}, down by {step.depth_m * 1e3:.1f} mm and up again at {speed}"
    way = "counter-clockwise" if step.direction > 0 else "clockwise"
    return f"{place}, once round it {way} at {step.radius_m * 1e3:.1f} mm and {speed}"


class ToolMessages:
    """Tools of one robot as messages.

    Parameters
    ----------
    flange, tool : names of the frames.
    """

    def __init__(
        self, nominal: SerialArm, serial: str, robot_file_hash: str, flange: str, tool: str
    ) -> None:
        self._nominal, self._serial = nominal, serial
        self._robot_file_hash = robot_file_hash
        self._flange, self._tool = flange, tool

    def frame(
        self, known: KnownTool, revision: int, thermal_revision: int, state: int, stamp_ns: int
    ) -> ToolFrame:
        """A tool with where it comes from."""
        flat = np.zeros(0) if known.covariance is None else known.covariance.ravel()
        return ToolFrame(
            header=header(stamp_ns, self._flange),
            child_frame_id=self._tool,
            robot=self._nominal.name,
            serial=self._serial,
            model_hash=self._nominal.model_hash,
            robot_file_hash=self._robot_file_hash,
            revision=revision,
            thermal_revision=thermal_revision,
            tool=transform_message(known.T_flange_tool),
            covariance=flat.tolist(),
            state=state,
        )

    def transform(self, known: KnownTool, stamp_ns: int) -> TransformStamped:
        """A tool as a transform below the flange."""
        return TransformStamped(
            header=header(stamp_ns, self._flange),
            child_frame_id=self._tool,
            transform=transform_message(known.T_flange_tool),
        )
