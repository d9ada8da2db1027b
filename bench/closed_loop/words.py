# SPDX-License-Identifier: Apache-2.0
"""What the sessions tell each other, as their nodes put it."""

import numpy as np

from bench.closed_loop import setting
from robocal_ros.correction.interface import OfferedModel, OfferedTool, ToldCorrection
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.session.events import Outcome
from robocal_ros.thermal.session import ThermalSession
from robocal_ros.tool.session import ToolSession


def model_of(session: ThermalSession, now_ns: int) -> OfferedModel:
    """The model in force."""
    arm, nominal = session.current.arm, session.nominal
    return OfferedModel(
        nominal.name,
        setting.SERIAL,
        nominal.model_hash,
        session.in_force.revision,
        True,
        nominal.joint_names,
        arm.mdh,
        arm.T_base_root,
        stamp_ns=now_ns,
        functions=arm.functions,
        load=arm.load,
    )


def tool_of(session: ToolSession, now_ns: int) -> OfferedTool:
    """The tool in force; without a transform where that is the taught one."""
    head, nominal = session.in_force, session.nominal
    return OfferedTool(
        nominal.name,
        setting.SERIAL,
        nominal.model_hash,
        head.revision,
        True,
        setting.FLANGE,
        None if head.model is None else session.current.tool.T_flange_tool,
        setting.TOOL,
        stamp_ns=now_ns,
    )


def tool_answer(outcome: Outcome) -> DriverAnswer:
    """What a tool measurement tells the maintenance."""
    document = outcome.document
    if document is None:
        return DriverAnswer(outcome.status, outcome.message, left_plan=outcome.left_plan)
    return DriverAnswer(
        outcome.status,
        outcome.message,
        outcome.calibration_id,
        has_result=True,
        answer=str(document.get("answer", "")),
        deviation_mm=float(document["change"]["tip_mm"]),
        sigma_mm=float(np.max(document["sigma_mm"])),
    )


def told_by(session: CorrectionSession) -> ToldCorrection:
    """What the joint correction tells the maintenance of itself."""
    status = session.status()
    return ToldCorrection(
        state=status.state,
        enabled=status.enabled,
        shadow=status.shadow,
        model_revision=status.revision or 0,
        tool_revision=status.tool_revision or 0,
        waiting_tool_revision=status.waiting_tool,
        stale=status.stale,
        mismatch=status.mismatch,
        last_refusal=status.last_refusal,
    )
