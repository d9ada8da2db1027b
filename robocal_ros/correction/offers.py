"""Which models and tools the correction takes over, and when."""

from dataclasses import replace

import numpy as np

from robocal_ros.correction.bounds import ROUNDING, CorrectionConfig, Survey, survey
from robocal_ros.correction.inputs import Array, OfferedModel, OfferedTool, Reason, RefusedError
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm


class CorrectionGate:
    """Judges offered models and tools, and keeps the last good ones."""

    def __init__(
        self, nominal: SerialArm, reference: SerialArm, serial: str, config: CorrectionConfig
    ) -> None:
        if nominal.joint_names != reference.joint_names or np.any(
            (nominal.sign != reference.sign) | (nominal.prismatic != reference.prismatic)
        ):
            raise ValueError("nominal and reference model have different joints")
        self._nominal = nominal
        self._reference = reference
        self._serial = serial
        self._config = config
        self._model: OfferedModel | None = None
        self.revision: int | None = None  # of the model taken over
        self.survey = Survey(0.0, 0.0, 0.0)  # its correction over the joint range
        self.waiting: OfferedModel | None = None  # refused, and to be taken over if looked at again
        self.stale = ""  # why the model is too old to be used
        self.tools = ToolGate(reference.T_flange_tool, config)

    @property
    def actual(self) -> SerialArm:
        """The actual arm with its tool, as far as they are known; else the reference's."""
        arm = self._reference
        if self._model is not None and not self.stale:
            arm = self._arm_of(self._model)
        tool = self.tools.T_flange_tool
        return arm if tool is None else replace(arm, T_flange_tool=tool)

    def take_model(self, model: OfferedModel, places: Array, *, again: bool = False) -> None:
        """Take over a model; ``places`` (k, n) are where the robot is, and goes.

        A revision lower than the one in use comes from a history that began again: it must be
        newer by its stamp, or be looked at (``again``). One that is refused for this, or for its
        size here, waits for `look_again`.

        Raises `RefusedError` when it is not accepted, made for another robot, older than the one
        in use, or would move the tool beyond the bounds where the robot is or goes.
        """
        if not model.accepted:
            raise RefusedError(Reason.NOT_ACCEPTED, f"revision {model.revision}")
        self._require_robot(model)
        if model.joint_names != self._nominal.joint_names:
            detail = f"joints {model.joint_names}, this has {self._nominal.joint_names}"
            raise RefusedError(Reason.WRONG_ROBOT, detail)
        self.waiting = None
        if self._model is not None and not again:
            if _same(model, self._model):
                self._model = model
                return
            if not _later(model, self._model):
                self.waiting = model
                raise RefusedError(
                    Reason.OLD_REVISION,
                    f"revision {model.revision} with other numbers after {self.revision}, and not "
                    "newer by its stamp; ~/take_over takes it over",
                )
        arm = self._arm_of(model)
        if len(places):
            self._require_small(model, arm, places)
        self._model, self.revision = model, model.revision
        self.survey = survey(self._reference, arm, self._config.thermal)

    def watch_age(self, now_ns: int) -> bool:
        """Compare the model's stamp with the clock; returns whether it became stale, or fresh."""
        was, limit_s = bool(self.stale), self._config.model_age_s
        self.stale = ""
        if self._model is not None and limit_s > 0.0:
            age_ns = now_ns - self._model.stamp_ns
            if abs(age_ns) > limit_s * 1e9:
                old = f"{abs(age_ns) * 1e-9:.1f} s " + ("old" if age_ns > 0 else "in the future")
                self.stale = (
                    f"model revision {self._model.revision} is {old}, allowed {limit_s:g} s"
                )
        return was != bool(self.stale)

    def look_again(self, places: Array) -> None:
        """Take over the model that waits for it, if there is one; raises as `take_model`."""
        if self.waiting is not None:
            self.take_model(self.waiting, places, again=True)

    @property
    def serial(self) -> str:
        """Of the model in use; empty without one."""
        return "" if self._model is None else self._model.serial

    def _require_robot(self, offered: OfferedModel | OfferedTool) -> None:
        expected = {
            "robot": (offered.robot, self._nominal.name),
            "serial": (offered.serial, self._serial),
            "nominal model's hash": (offered.model_hash, self._nominal.model_hash),
        }
        for what, (found, own) in expected.items():
            if found != own:
                raise RefusedError(Reason.WRONG_ROBOT, f"{what} {found}, this is {own}")
        own = self._config.robot_file_hash
        if own and offered.robot_file_hash != own:
            raise RefusedError(
                Reason.WRONG_ROBOT,
                f"no serial is set and the robot files differ (hash "
                f"{offered.robot_file_hash or 'not given'}, this is {own}): set the serial of each "
                "robot",
            )

    def _arm_of(self, model: OfferedModel) -> SerialArm:
        """The offered arm; the nominal one says that no drift is known: then the reference."""
        nominal = self._nominal
        # The root travels as a quaternion: equal up to rounding.
        if np.array_equal(model.mdh, nominal.mdh) and np.allclose(
            model.T_base_root, nominal.T_base_root, rtol=0.0, atol=1e-12
        ):
            return self._reference
        return replace(self._reference, mdh=model.mdh, T_base_root=model.T_base_root)

    def _require_small(self, model: OfferedModel, arm: SerialArm, places: Array) -> None:
        bound = self._config.thermal
        shift = JointCorrection.between(self._reference, arm).correct(places)
        if not np.all(bound.hold(shift)):
            self.waiting = model
            raise RefusedError(
                Reason.TCP_BOUND,
                f"{np.max(shift.tcp_shift_m) * 1e3:.3f} mm and "
                f"{np.degrees(np.max(shift.tcp_rotation_rad)):.3f} deg where the robot is or "
                f"goes, allowed {bound.tcp_m * 1e3:g} mm and {np.degrees(bound.tcp_rad):g} deg; "
                f"over its joint range {survey(self._reference, arm, bound)}",
            )

    def take_tool(self, tool: OfferedTool) -> None:
        """As `ToolGate.take`; raises `RefusedError` also when it was made for another robot."""
        self._require_robot(tool)
        self.tools.take(tool)


class ToolGate:
    """Judges the measured tools of this robot, and keeps the last good one until it may be used.

    One that is ``waiting`` is adopted when the robot stands or a trajectory begins; one that was
    ``refused`` is older than the one before by revision and stamp, and is to be looked at again.
    """

    def __init__(self, taught: Array, config: CorrectionConfig) -> None:
        self._taught = taught
        self._config = config
        self.in_use: OfferedTool | None = None
        self.waiting: OfferedTool | None = None
        self.refused: OfferedTool | None = None

    @property
    def T_flange_tool(self) -> Array | None:
        """The tool in use; None: the taught one."""
        return None if self.in_use is None else self.in_use.T_flange_tool

    def take(self, tool: OfferedTool, *, again: bool = False) -> None:
        """Let a tool wait for its adoption; one that is in use already only ends the wait.

        A revision that is not newer than the last one must be newer by its stamp, or be looked
        at (``again``).

        Raises `RefusedError` when it is not accepted, its frames are not the configured ones, it
        is older than the last one, or too far from the taught tool.
        """
        if not tool.accepted:
            raise RefusedError(Reason.NOT_ACCEPTED, f"tool revision {tool.revision}")
        self._require_frames(tool)
        if tool.T_flange_tool is not None:
            self._require_small(tool.T_flange_tool)
        self.refused = None
        last = self.waiting or self.in_use
        known = last is not None and _same_tool(tool, last)
        later = last is None or _later(tool, last)
        if not (known or later or again):
            self.refused = tool
            raise RefusedError(
                Reason.OLD_REVISION,
                f"tool revision {tool.revision} is another tool than the last one and not newer "
                "by its stamp; ~/take_over takes it over",
            )
        if self.in_use is not None and _same_tool(tool, self.in_use):
            self.in_use, self.waiting = tool, None
        else:
            self.waiting = tool

    def look_again(self) -> None:
        """Take the tool that was refused for its revision, if there is one."""
        if self.refused is not None:
            self.take(self.refused, again=True)

    def adopt(self) -> None:
        """Use the tool that waits, if there is one."""
        self.in_use, self.waiting = self.waiting or self.in_use, None

    def _require_frames(self, tool: OfferedTool) -> None:
        parent, child = self._config.flange_frame, self._config.tool_frame
        if child and tool.child != child:
            raise RefusedError(Reason.BAD_TOOL, f"child '{tool.child}', expected '{child}'")
        if tool.parent != parent:
            raise RefusedError(Reason.BAD_TOOL, f"parent '{tool.parent}', expected '{parent}'")

    def _require_small(self, T_flange_tool: Array) -> None:
        taught, bound = self._taught, self._config.tool
        shift = float(np.linalg.norm(T_flange_tool[:3, 3] - taught[:3, 3]))
        turn = float(np.linalg.norm(frames.log_rotation(T_flange_tool[:3, :3] @ taught[:3, :3].T)))
        if shift > bound.tcp_m + ROUNDING or turn > bound.tcp_rad + ROUNDING:
            raise RefusedError(
                Reason.TOOL_BOUND,
                f"{shift * 1e3:.3f} mm and {np.degrees(turn):.3f} deg from the taught tool, "
                f"allowed {bound.tcp_m * 1e3:g} mm and {np.degrees(bound.tcp_rad):g} deg",
            )


def _same(a: OfferedModel, b: OfferedModel) -> bool:
    return (
        a.revision == b.revision
        and np.array_equal(a.mdh, b.mdh)
        and np.array_equal(a.T_base_root, b.T_base_root)
    )


def _same_tool(a: OfferedTool, b: OfferedTool) -> bool:
    if a.T_flange_tool is None or b.T_flange_tool is None:
        return a.revision == b.revision and a.T_flange_tool is b.T_flange_tool
    return a.revision == b.revision and np.array_equal(a.T_flange_tool, b.T_flange_tool)


def _later(a: OfferedModel | OfferedTool, b: OfferedModel | OfferedTool) -> bool:
    return a.revision > b.revision or a.stamp_ns > b.stamp_ns
