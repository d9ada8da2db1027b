# SPDX-License-Identifier: Apache-2.0
"""What goes in and out of the correction session: commands, refusals, and its status.

The builders accept any object with the attributes of the ROS message.
"""

import math
from dataclasses import dataclass, field, fields
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.history.history_records import Head
from robocal_ros.kinematics.joint_functions import ArmLoad, IdentifiedFrom, JointFunctions

if TYPE_CHECKING:  # who hears a status needs no compiled code
    from robocal_ros.correction.bounds import Policy, Survey


class Reason(StrEnum):
    """Why an input was refused; counted one by one."""

    NOT_FINITE = "a value is not finite"
    WRONG_SIZE = "numbers of names and values differ"
    NO_POSITION = "no positions"
    UNKNOWN_JOINT = "a joint is unknown"
    DOUBLED_JOINT = "a joint is named twice"
    MISSING_JOINT = "a joint is missing and its state is not known"
    STALE_JOINTS = "joint states are missing or too old"
    START_MISMATCH = "START_MISMATCH, the robot does not stand where the command begins"
    TIME_BACKWARDS = "time goes backwards"
    OWN_OUTPUT = "comes from a joint correction already"
    DEGREES = "positions look like degrees"
    BURST = "too many points"
    NO_POINTS = "a trajectory without points"
    TOO_SHORT = "too short for the offset to change"
    TWO_SOURCES = "two publishers at once"
    JOINT_LIMIT = "a joint limit is exceeded"
    VELOCITY_LIMIT = "a velocity limit is exceeded"
    TCP_BOUND = "the arm's correction at the tool exceeds its bound"
    JOINT_BOUND = "the correction of a joint exceeds its bound"
    NOT_SOLVED = "no solution near the taught joints"
    NOT_ACCEPTED = "the model is not accepted"
    WRONG_ROBOT = "made for another robot"
    OLD_REVISION = "older than the revision in use"
    TOOL_BOUND = "the tool's change exceeds its bound"
    BAD_TOOL = "the tool's frame is not usable"
    BAD_FUNCTIONS = "the model's joint functions or load are not usable"
    OTHER_COMMANDER = "somebody else commands the robot"
    LEASED = "the robot is leased for a measurement"
    STOPPED = "stopped"
    NO_SPEED_LIMITS = "the robot has no speed limits"
    OTHER_ROBOT = "the description on the graph is another robot"


_CODES = {
    Reason.JOINT_LIMIT: Code.LIMIT_EXCEEDED,
    Reason.VELOCITY_LIMIT: Code.LIMIT_EXCEEDED,
    Reason.TCP_BOUND: Code.LIMIT_EXCEEDED,
    Reason.JOINT_BOUND: Code.LIMIT_EXCEEDED,
    Reason.NOT_SOLVED: Code.LIMIT_EXCEEDED,
    Reason.TOOL_BOUND: Code.LIMIT_EXCEEDED,
    Reason.WRONG_ROBOT: Code.WRONG_ROBOT,
    Reason.OTHER_ROBOT: Code.WRONG_ROBOT,
    Reason.OLD_REVISION: Code.STALE,
    Reason.STALE_JOINTS: Code.STALE,
    Reason.START_MISMATCH: Code.CONFLICT,
    Reason.TWO_SOURCES: Code.CONFLICT,
    Reason.OTHER_COMMANDER: Code.CONFLICT,
    Reason.LEASED: Code.CONFLICT,
}


class RefusedError(RobocalError):
    """An input that is not acted on; nothing is published for it."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(f"refused, {reason.value}: {detail}")
        self.reason, self.detail = reason, detail
        self.code = _CODES.get(reason, Code.BAD_INPUT)


MOST_POINTS = 10_000  # of a trajectory: in some 50 ms at most, so that nothing waits longer
TAUGHT_TOOL = 0  # state of a robocal_msgs/ToolFrame: NONE


@dataclass(slots=True)  # frozen it would take three times as long to make, for each message
class JointCommand:
    """Joint targets or joint readings at one instant; not to be changed."""

    names: tuple[str, ...]  # in the message's order
    position: Array  # (k,) rad (prismatic: m)
    velocity: Array | None = None  # (k,)
    stamp_ns: int = 0  # of the source; 0 when not set
    mark: str = ""  # `frame_id` of the message's header


@dataclass(frozen=True)
class TrajectoryCommand:
    """A trajectory of m points; ``position`` (m, k), rates likewise or None, times (m,) in s."""

    names: tuple[str, ...]
    position: Array
    time_from_start_s: Array
    velocity: Array | None = None
    acceleration: Array | None = None
    stamp_ns: int = 0
    mark: str = ""

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True)
class OfferedCalibration:
    """What somebody published for a robot, and with what nominal model it was made."""

    robot: str
    serial: str
    model_hash: str
    revision: int
    accepted: bool
    stamp_ns: int = field(default=0, kw_only=True)
    robot_file_hash: str = field(default="", kw_only=True)


@dataclass(frozen=True)
class OfferedModel(OfferedCalibration):
    """A kinematic model; ``mdh`` (n, 5) absolute, SI."""

    joint_names: tuple[str, ...]
    mdh: Array
    T_base_root: Array = field(default_factory=lambda: np.eye(4))
    functions: JointFunctions | None = None
    load: ArmLoad | None = None  # with which it was identified


@dataclass(frozen=True)
class OfferedTool(OfferedCalibration):
    """A measured tool, absolute."""

    parent: str
    T_flange_tool: Array | None  # (4, 4); None: the taught tool again
    child: str

    @property
    def used_revision(self) -> int:
        """The one corrected with; 0: the taught tool, also where another one's is in force."""
        return 0 if self.T_flange_tool is None else self.revision


def _values(values: Any, names: tuple[str, ...], what: str) -> Array | None:
    if len(values) == 0:
        return None
    array = np.array(values, dtype=np.float64)
    if len(array) != len(names):
        detail = f"{len(names)} names but {len(array)} {what}"
        raise RefusedError(Reason.WRONG_SIZE, detail)
    return array


def joint_command(message: Any) -> JointCommand:
    """Build from a ``sensor_msgs/JointState``.

    Raises `RefusedError` when names and values differ in number, or there are no positions.
    """
    names = tuple(message.name)
    position = _values(message.position, names, "positions")
    if position is None:
        if names:
            raise RefusedError(Reason.NO_POSITION, f"of {', '.join(names)}")
        position = np.empty(0)
    velocity = _values(message.velocity, names, "velocities")
    _require_finite(position, "a position")
    header = message.header
    return JointCommand(names, position, velocity, stamp_ns(header.stamp), str(header.frame_id))


def finite_command(message: Any) -> JointCommand:
    """``joint_command`` of targets, whose efforts must be finite too: they go out as they came."""
    _require_finite(message.effort, "an effort")
    return joint_command(message)


def _require_finite(values: Any, what: str) -> None:
    if not np.all(np.isfinite(values)):
        raise RefusedError(Reason.NOT_FINITE, f"{what}: {np.asarray(values).tolist()}")


def require_finite(names: tuple[str, ...], values: Array | None) -> None:
    """Refuse values (m, k) of which one is NaN or infinite."""
    if values is None or np.isfinite(values).all():
        return
    point, column = np.argwhere(~np.isfinite(values))[0]
    name = names[column] if column < len(names) else f"column {column + 1}"
    raise RefusedError(Reason.NOT_FINITE, f"{name} (point {point + 1})")


def require_few(points: int) -> None:
    """Refuse a trajectory of so many points that nothing else would be heard meanwhile."""
    if points > MOST_POINTS:
        raise RefusedError(Reason.BURST, f"{points}, allowed {MOST_POINTS}")


def _pose(translation: Any, rotation: Any, reason: Reason) -> Array:
    xyz = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    quat = np.array([rotation.x, rotation.y, rotation.z, rotation.w], dtype=np.float64)
    if not (np.all(np.isfinite(xyz)) and abs(math.hypot(*quat) - 1.0) < 1e-3):
        raise RefusedError(reason, f"translation {xyz.tolist()}, quaternion {quat.tolist()}")
    return frames.transform_from_quat(xyz, quat)


def offered_model(message: Any, accepted_state: int) -> OfferedModel:
    """Build from a ``robocal_msgs/KinematicModel``; `RefusedError` for numbers that cannot be."""
    names = tuple(message.joint_names)
    columns = [message.d, message.theta, message.a, message.alpha, message.beta]
    if any(len(column) != len(names) for column in columns):
        raise RefusedError(Reason.WRONG_SIZE, f"model of {len(names)} joints")
    mdh = np.array(columns, dtype=np.float64).T
    if not np.all(np.isfinite(mdh)):
        raise RefusedError(Reason.NOT_FINITE, f"model of {message.robot}")
    root = message.base_root
    functions, load = _layer(message, len(names))
    return OfferedModel(
        **_offered(message, accepted_state),
        joint_names=names,
        mdh=mdh,
        T_base_root=_pose(root.translation, root.rotation, Reason.NOT_FINITE),
        functions=functions,
        load=load,
    )


def _offered(message: Any, *accepted_states: int) -> dict[str, Any]:
    """The fields of `OfferedCalibration`."""
    return {
        "robot": message.robot,
        "serial": message.serial,
        "model_hash": message.model_hash,
        "revision": int(message.revision),
        "accepted": int(message.state) in accepted_states,
        "stamp_ns": stamp_ns(message.header.stamp),
        "robot_file_hash": message.robot_file_hash,
    }


def _layer(message: Any, n: int) -> tuple[JointFunctions | None, ArmLoad | None]:
    """Joint functions and load of a ``robocal_msgs/KinematicModel``, None where it holds none."""
    functions, load = None, None
    try:
        if len(message.function_step) or len(message.compliance):
            table = np.array(message.function_coefficients, dtype=np.float64).reshape(n, -1)
            of_joints = message.function_first, message.function_step
            told = _identified_from(message, n) if len(message.identified_weight) else None
            functions = JointFunctions(*of_joints, table, message.compliance, told)
        if len(message.link_mass):
            centre, pull = (
                np.array([v.x, v.y, v.z]) for v in (message.payload_centre, message.gravity)
            )
            centres = np.array(message.link_centre, dtype=np.float64).reshape(n, 3)
            found = message.payload_mass == -1.0
            carried = 0.0 if found else message.payload_mass
            load = ArmLoad(message.link_mass, centres, carried, centre, pull, found)
            if len(load.mass) != n:
                raise ValueError(f"masses of {len(load.mass)} links, {n} joints")
        if functions is not None and load is None and np.any(functions.compliance):
            raise ValueError("compliances without masses of the links")
    except ValueError as error:
        raise RefusedError(Reason.BAD_FUNCTIONS, f"model of {message.robot}: {error}") from error
    return functions, load


def _identified_from(message: Any, n: int) -> IdentifiedFrom:
    values = {f.name: getattr(message, f"identified_{f.name}") for f in fields(IdentifiedFrom)}
    for name, width in (("q", n), ("p_flange", 3)):
        values[name] = np.array(values[name], dtype=np.float64).reshape(-1, width)
    return IdentifiedFrom(**values)


def offered_tool(message: Any, accepted_state: int) -> OfferedTool:
    """Build from a ``robocal_msgs/ToolFrame``; its state NONE says: the taught tool, as accepted.

    Raises `RefusedError` for numbers that are no pose.
    """
    taught = int(message.state) == TAUGHT_TOOL
    pose = message.tool
    T = None if taught else _pose(pose.translation, pose.rotation, Reason.BAD_TOOL)
    return OfferedTool(
        **_offered(message, accepted_state, TAUGHT_TOOL),
        parent=str(message.header.frame_id),
        T_flange_tool=T,
        child=str(message.child_frame_id),
    )


NODE = "joint_correction_node"


class CorrectionState(IntEnum):
    """What a joint correction does; the numbers of ``robocal_msgs/CorrectionStatus``."""

    OFF = 1
    BLENDING = 2
    ON = 3
    WITHOUT_MODEL = 4
    MISMATCH = 5
    OTHER_COMMANDER = 6
    LEASED = 7


@dataclass(frozen=True)
class Offset:
    """What is added to the taught joints at an instant: where they were commanded, or read, last.

    ``withheld``: offset less the one that model and tool ask for: the limiter is on its way.
    """

    offset: Array  # (n,) corrected less taught, rad (prismatic: m)
    withheld: Array  # (n,)
    revision: int | None  # of the model that is corrected with; None for none
    tool_revision: int | None


@dataclass(frozen=True, eq=False)
class CorrectionStatus:
    """What a correction session does; the figures are of the last message that was put out."""

    enabled: bool  # asked for
    active: bool  # commands differ from what came in, or will
    settled: bool  # the offset is the one that model and tool ask for
    revision: int | None  # of the model taken over
    serial: str  # the one it was made for; empty without one
    survey: "Survey"  # its correction over the joint range
    waiting_revision: int | None  # of a model that was refused, and that may be taken over
    new_tool: bool  # a tool other than the taught one was taken over
    tool_revision: int | None  # of the tool taken over
    waiting_tool: int | None  # revision of one that waits for standstill or the next trajectory
    stale: str  # why the model is not corrected with any more; empty when it is not stale
    payload: str  # what it may cost that the arm carries another load than the model's; else empty
    tcp_shift_m: float  # error at the tool that the drift would have made
    largest_shift: float  # largest offset that was asked for, rad (prismatic: m)
    remaining_m: float  # error that was left at the tool
    withheld: Array  # (n,) what the limiter withholds now
    withheld_most: Array  # (n,) and has at most since the start
    withheld_m: float  # the same at the tool
    withheld_most_m: float  # when that of all joints together was largest
    lag_s: float  # how far a stream's output lags what came in
    overtaken: int  # messages that came after a newer one
    mismatch: str  # why nothing is put out until it is acknowledged; empty: nothing is wrong
    held: dict[Reason, str]  # why no command is taken
    reduced: int  # points that were corrected in part, near a singularity
    clamped: dict[Reason, int]  # messages that were corrected in part, by what bound
    passed: dict[Reason, int]  # and those not at all
    policy: "Policy"
    reference: str  # name and hash of the model that the program was taught with
    shadow: bool  # commands pass as they came, and the correction is only shown
    refused: dict[Reason, int]  # how often
    last_refusal: str  # empty when there was none

    @property
    def state(self) -> CorrectionState:
        """All of it in one word."""
        if Reason.OTHER_COMMANDER in self.held:
            return CorrectionState.OTHER_COMMANDER
        if Reason.LEASED in self.held:
            return CorrectionState.LEASED
        if self.mismatch:
            return CorrectionState.MISMATCH
        if not self.settled:
            return CorrectionState.BLENDING
        if not self.enabled:
            return CorrectionState.OFF
        known = self.new_tool or self.has_model
        return CorrectionState.ON if known else CorrectionState.WITHOUT_MODEL

    @property
    def has_model(self) -> bool:
        """Whether there is a model that is not stale."""
        return self.revision is not None and not self.stale

    def in_words(self) -> str:
        """What the correction does now, in one line."""
        parts = [f"model revision {self.revision}"] if self.has_model else []
        parts += [f"tool revision {self.tool_revision}"] if self.new_tool else []
        settled = "on" if self.settled else "on, the offset changes with the next commands"
        if self.held:
            reason, detail = next(iter(self.held.items()))
            words = f"nothing goes out, {reason.value}: {detail}"
        elif self.mismatch:
            words = f"nothing goes out, {Reason.START_MISMATCH.value}: {self.mismatch}"
        elif not self.enabled:
            words = "off, the offset goes to zero with the next commands" if self.active else "off"
        elif parts:
            words = f"{settled}: {' and '.join(parts)}"
            words += f", without the model: {self.stale}" if self.stale else ""
        elif self.stale:
            words = f"on, but nothing is corrected: {self.stale}"
        else:
            words = "on, but there is no model and no tool yet: nothing is corrected"
        return f"shadow, nothing is changed; it would be {words}" if self.shadow else words


@dataclass(frozen=True, kw_only=True)
class ToldCorrection:
    """What a joint correction says of itself; revisions 0: the nominal model, the taught tool."""

    state: CorrectionState
    enabled: bool
    shadow: bool = False
    model_revision: int = 0
    tool_revision: int = 0
    waiting_tool_revision: int | None = None  # it waits for a standstill or a trajectory
    stale: str = ""
    mismatch: str = ""
    commanders: str = ""  # who else commands the robot; nothing goes out in OTHER_COMMANDER
    last_refusal: str = ""


def uncorrected(
    told: ToldCorrection | None, thermal: Head, tool: Head, *, follows: bool = False
) -> str:
    """Why commands are not corrected with model and tool in force, and what to do; empty: they are.

    Nominal model and taught tool need no correction. An offset that is still on its way counts as
    done. In the state LEASED the program's commands are refused: none goes out uncorrected.

    ``told``: None: the correction is silent.
    ``follows``: something came into force so lately that the correction may not know of it yet.
    """
    no_model = thermal.calibration_id is None
    needed = not (no_model and tool.calibration_id is None)
    if told is None:
        return f"{NODE} is silent: start it, it corrects nothing" if needed else ""
    idle = ""  # why nothing is corrected, whatever the revisions in use
    if told.shadow:
        idle = "is in shadow mode, nothing is corrected: start it with shadow false"
    elif told.state is CorrectionState.MISMATCH:
        idle = f"puts nothing out, {told.mismatch}: see where the robot stands, call ~/acknowledge"
    elif told.state is CorrectionState.OTHER_COMMANDER:
        idle = f"puts nothing out, {told.commanders}: end them"
    elif not told.enabled:
        idle = "is OFF: call ~/enable"
    elif told.stale and not no_model:
        idle = f"corrects without the model, {told.stale}: accept a newer one"
    elif told.state is CorrectionState.WITHOUT_MODEL:
        idle = "has heard of no model and no tool: wire its inputs kinematic_model and tool"
    if needed and idle:
        return f"{NODE} {idle}"
    silent = told.state in (CorrectionState.MISMATCH, CorrectionState.OTHER_COMMANDER)
    if follows or not told.enabled or told.shadow or silent:
        return ""
    pairs = [
        _other_revision("thermal model", "kinematic_model", told.model_revision, thermal, told),
        _other_revision("tool", "tool", told.tool_revision, tool, told),
    ]
    return "; ".join(filter(None, pairs))


def _other_revision(what: str, topic: str, used: int, head: Head, told: ToldCorrection) -> str:
    """Words where another revision is in use than in force; 0 is as good as any nominal one."""
    if used == head.revision or (used == 0 and head.calibration_id is None):
        return ""
    words = f"{NODE} corrects with {what} revision {used}, in force is revision {head.revision}"
    if topic == "tool" and told.waiting_tool_revision == head.revision:
        return f"{words}: that one waits until the robot stands or a trajectory begins"
    if told.last_refusal:
        return f"{words}: it refused last: {told.last_refusal}; mend that, or roll back"
    return f"{words}: wire its input {topic}"
