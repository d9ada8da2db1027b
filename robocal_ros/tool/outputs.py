"""What the tool node says: its topics, and how results get onto them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile
from robocal_msgs.msg import CalibrationQuality, ToolFrame, ToolStep

from robocal_ros.ground.frames import Document
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import conversions, qos
from robocal_ros.ros.session_events import SessionEvents
from robocal_ros.ros.static_tf import StaticTf
from robocal_ros.session.events import Outcome
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.measuring_plan import PlannedStep
from robocal_ros.tool.messages import ToolMessages, step_message

AddOutput = Callable[[type, str, QoSProfile], Any]


class TcfOutputs:
    """Publishers of one tool's results.

    Parameters
    ----------
    add : creates a publisher.
    base : name of the base frame.

    Attributes
    ----------
    missing : what cannot be published on this machine; empty when everything can.
    """

    def __init__(
        self,
        add: AddOutput,
        nominal: SerialArm,
        serial: str,
        robot_file_hash: str,
        frames: tuple[str, str, str],
    ) -> None:
        self._base, flange, tool = frames
        self._nominal, self._serial = nominal, serial
        self._messages = ToolMessages(nominal, serial, robot_file_hash, flange, tool)
        self._step = add(ToolStep, "~/next_step", qos.LATCHED)
        self._candidate = add(ToolFrame, "~/candidate", qos.LATCHED)
        self._tool = add(ToolFrame, "~/tool", qos.LATCHED)
        self._frame = add(TransformStamped, "~/tool_frame", qos.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", qos.LATCHED)
        self.events = SessionEvents(add)
        self._tf = StaticTf(add)
        self.missing = self._tf.missing

    def step(self, step: PlannedStep | None, run: int, stamp_ns: int) -> ToolStep:
        """Say what is awaited; None: nothing is."""
        stamp = conversions.header(stamp_ns, self._base)
        message = (
            ToolStep(header=stamp, run=run)
            if step is None
            else step_message(step, run, stamp_ns, self._base)
        )
        self._step.publish(message)
        return message

    def tool(self, known: KnownTool, revision: int, thermal: int, stamp_ns: int) -> None:
        """Say what is in force."""
        state = ToolFrame.ACCEPTED if revision else ToolFrame.NONE
        self._tool.publish(self._messages.frame(known, revision, thermal, state, stamp_ns))
        transform = self._messages.transform(known, stamp_ns)
        self._frame.publish(transform)
        self._tf.publish([transform])

    def frame(self, model: Document, stamp_ns: int) -> ToolFrame:
        """A measured tool."""
        known, thermal = KnownTool.of_document(model), int(model["thermal_revision"])
        return self._messages.frame(known, 0, thermal, ToolFrame.CANDIDATE, stamp_ns)

    def candidate(self, model: Document, stamp_ns: int) -> None:
        """Show what was measured."""
        self._candidate.publish(self.frame(model, stamp_ns))

    def quality(self, outcome: Outcome) -> None:
        """Show the verdict on a run."""
        document = outcome.document or {}
        message = conversions.verdict_message(
            outcome,
            robot=self._nominal.name,
            serial=self._serial,
            stamp=conversions.header(outcome.command.stamp_ns or 0, self._base),
            cycle_id=str(document.get("cycle_id", "")),
        )
        if "misfit_mm" in document:
            message.candidate_rms_mm = float(document["misfit_mm"])
        if "sigma_mm" in document:
            message.predicted_rms_mm = float(np.max(document["sigma_mm"]))
        self._quality.publish(message)
