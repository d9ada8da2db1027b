"""What the simulated cell tells the graph."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, TransformStamped
from numpy.typing import NDArray
from robocal_msgs.msg import BeamEvent
from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_msgs.msg import String

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.cell import SimulatedCell
from robocal_ros.cell_sim.cell_outputs import Happened
from robocal_ros.cell_sim.cell_samples import station_name
from robocal_ros.cell_sim.messages import (
    beam_event,
    cloud,
    joint_state,
    point,
    profile,
    temperature,
)
from robocal_ros.ground.samples import REFERENCE_SPHERE, SPHERE_CLOUD
from robocal_ros.hand_eye.shots import PROFILE
from robocal_ros.ros import qos
from robocal_ros.ros.conversions import NS, header, transform_message
from robocal_ros.thermal.learning import THRESHOLD_M

Array = NDArray[np.float64]

TRUTH_S = 1.0  # between two states of the truth
CENTRE = "sphere_center"

Commanded = tuple[NDArray[np.int64], Array]


class CellOutputs:
    """Publishers of a cell.

    Attributes
    ----------
    told : number of messages sent on each topic.
    commanded : which (k,) working poses were commanded last, and the joints (k, n) for them; None
        before.
    """

    def __init__(
        self, add_output: Callable[..., Any], settings: Mapping[str, Any], cell: SimulatedCell
    ) -> None:
        self._settings, self._cell = settings, cell
        kinds = {"joint_states": JointState, "beam_events": BeamEvent}
        if cell.plan.sphere:
            clouds = cell.plan.sphere.points > 0
            kinds |= {SPHERE_CLOUD: PointCloud2} if clouds else {CENTRE: PointStamped}
            kinds |= {REFERENCE_SPHERE: PointStamped}
        if cell.plan.profile:
            kinds |= {PROFILE: PointCloud2}
        if cell.heating:
            kinds |= {"motor_temperatures": Temperature}
        self._outputs = {
            topic: add_output(kind, topic, qos.RELIABLE) for topic, kind in kinds.items()
        }
        self._tool = add_output(TransformStamped, "~/truth", qos.LATCHED)
        self._state = add_output(String, "~/truth/state", qos.LATCHED)
        self.told = dict.fromkeys(kinds, 0)
        self.commanded: Commanded | None = None
        self.forget()

    def forget(self) -> None:
        """Tell the truth anew."""
        self._shown: RoundTool | None = None
        self._next_state_s = 0.0
        self._reset_ns = 0  # when the robot's clock began anew, less a second

    def tell(self, came: Happened, stamp_ns: Callable[[float], int]) -> None:
        """Publish what came; ``stamp_ns`` of a time of the cell."""
        settings, faults = self._settings, self._cell.faults
        names, missing = self._cell.plan.arm.joint_names, round(faults.size("odd_lengths"))
        for t, q, qd in zip(came.time_s.tolist(), came.q, came.qd, strict=True):
            at = stamp_ns(t)
            if "clock_reset" in faults:
                self._reset_ns = self._reset_ns or at - NS
                at -= self._reset_ns
            else:
                self._reset_ns = 0
            speed = qd if settings["velocities"] else None
            self._send("joint_states", joint_state(names, at, q, speed, missing))
        station = station_name(settings["station"], self._cell.faults)
        for edge in came.edges:
            self._send("beam_events", beam_event(edge, stamp_ns(edge.time_s), station))
        ball, floor = f"{settings['sensor_frame']}/ball", f"{settings['sensor_frame']}/floor"
        for shot in came.shots:
            at = stamp_ns(shot.time_s)
            if len(shot.points):
                self._send(SPHERE_CLOUD, cloud(at, ball, shot.points))
            else:
                self._send(CENTRE, point(at, ball, shot.centre))
            self._send(REFERENCE_SPHERE, point(at, floor, shot.floor))
        for view in came.profiles:
            frame = settings["profile_frame"]
            self._send(PROFILE, profile(stamp_ns(view.time_s), frame, view.points))
        for told in came.temperatures:
            for name, celsius in zip(names, told.celsius.tolist(), strict=True):
                message = temperature(stamp_ns(told.time_s), name, celsius)
                self._send("motor_temperatures", message)

    def tell_truth(self, now_ns: int) -> None:
        """The true tool when it changed, and how warm and how far off the robot is."""
        cell = self._cell
        tool = cell.tool
        if self._shown is None or not np.array_equal(tool.T_flange_tool, self._shown.T_flange_tool):
            self._shown = tool
            message = TransformStamped(
                header=header(now_ns, self._settings["flange_frame"]),
                child_frame_id=self._settings["tool_frame"],
                transform=transform_message(tool.T_flange_tool),
            )
            self._tool.publish(message)
        if cell.now_s >= self._next_state_s:
            self._next_state_s = cell.now_s + TRUTH_S
            self._state.publish(String(data=json.dumps(truth_of(cell, self.commanded))))

    def _send(self, topic: str, message: Any) -> None:
        self._outputs[topic].publish(message)
        self.told[topic] += 1


def truth_of(cell: SimulatedCell, commanded: Commanded | None) -> dict[str, Any]:
    """What is true now, for judging alone; K, m, and the size of each fault in SI.

    The share is of the drives' greatest speeds, as commanded since the begin.
    """
    warmth, working = cell.warmth, cell.plan.working
    told = {
        "simulated": True,
        "cell_time_s": cell.now_s,
        "faults": dict(cell.faults.sizes),
        "drive_faults": cell.motion.faults,
        "peak_speed_share": cell.motion.peak_share,
        "motor_k": warmth.motor.tolist(),
        "link_k": warmth.link.tolist(),
    }
    if len(working):
        told |= _error("", cell.tcp_error(working))
    if commanded is not None:
        which, q = commanded
        told |= _error("commanded_", cell.tcp_error(q, which))
        told |= _error("visited_", cell.tcp_error(working[which], which))  # the same, as taught
    return told


def _error(which: str, error: Array) -> dict[str, float]:
    """Of the tool at working poses (k, 3), m; the share is of its coordinates."""
    far = np.linalg.norm(error, axis=1)
    return {
        f"{which}tcp_error_rms_m": float(np.sqrt(np.mean(far**2))),
        f"{which}tcp_error_p95_m": float(np.quantile(far, 0.95)),
        f"{which}within_share": float(np.mean(np.abs(error) <= THRESHOLD_M)),
    }
