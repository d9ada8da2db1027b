# SPDX-License-Identifier: Apache-2.0
"""Models and tools that are corrected with, the correction's bounds, and the offset it asks for.

What becomes of a correction beyond its bounds says the policy; the limiter comes after it.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.interface import (
    OfferedCalibration,
    OfferedModel,
    OfferedTool,
    Reason,
    RefusedError,
)
from robocal_ros.correction.joint_correction import (
    CorrectionResult,
    JointCorrection,
    StagedCorrection,
    StagedResult,
    pack_model,
    same_models,
)
from robocal_ros.correction.limiter import (
    ADDS,
    FIGURES,
    LARGEST,
    NOT_WITHIN,
    OFFSET,
    OFFSET_RATE,
    OUT,
    REDUCED,
    REMAINING,
    SHIFT,
    SLIDING,
    TAUGHT,
    TOO_FAST,
    TURNING,
    VELOCITY,
    OffsetLimiter,
    OffsetLimits,
    put_out,
    step_out,
)
from robocal_ros.correction.solution import MOST_STEPS, VELOCITY_EXACT
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array
from robocal_ros.history.history_records import Past
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import payload_note, random_postures

# What floating point adds to a value that lies on its bound.
ROUNDING = 1e-9
DEGREE = np.pi / 180.0
# Weak directions are damped for this share of the bound: the solution may bend a little beyond
# the first order.
FADES_FROM = 0.8
# What a survey looks at: +-3 sigma of the share are 5 % at most.
POSTURES = 1000


@dataclass(frozen=True)
class ShiftBounds:
    """Largest correction: at the tool (m, rad) and of one joint (rad; prismatic: ``tcp_m``)."""

    tcp_m: float
    tcp_rad: float
    joint_rad: float

    def of_joints(self, arm: SerialArm) -> Array:
        """(n,) largest shift of each joint."""
        return np.where(arm.prismatic, self.tcp_m, self.joint_rad)

    def hold(self, result: CorrectionResult) -> NDArray[np.bool_]:
        """Whether corrections keep within them at the tool."""
        return np.asarray(
            (result.tcp_shift_m <= self.tcp_m + ROUNDING)
            & (result.tcp_rotation_rad <= self.tcp_rad + ROUNDING)
        )

    def beyond(self, shift_m: float, turn_rad: float, where: str) -> str:
        """What is more, in words."""
        return (
            f"{shift_m * 1e3:.3f} mm and {np.degrees(turn_rad):.3f} deg {where}, allowed "
            f"{self.tcp_m * 1e3:g} mm and {np.degrees(self.tcp_rad):g} deg"
        )


class Policy(StrEnum):
    """What is done with a command whose correction would exceed a bound or a limit."""

    REFUSE = "refuse"
    CLAMP = "clamp"
    PASS = "pass"


@dataclass(frozen=True)
class CorrectionConfig:
    """Settings of a correction session, SI."""

    # Bounds of the arm's drift, and of the tool's change, whose tilt is that of a tip 10 mm aside
    # by a bend 150 mm above it.
    thermal: ShiftBounds = ShiftBounds(1e-3, 0.1 * DEGREE, 0.3 * DEGREE)
    tool: ShiftBounds = ShiftBounds(10e-3, 4.0 * DEGREE, 5.0 * DEGREE)
    turning: OffsetLimits = TURNING  # fastest change of the offset of a joint, by its kind
    sliding: OffsetLimits = SLIDING
    # (n,) rad/s, rad/s^2 (prismatic: m); a stream that ends slows down with the accelerations
    velocity_limits: Array = field(default_factory=lambda: np.array([np.inf]), compare=False)
    acceleration_limits: Array = field(default_factory=lambda: np.array([np.inf]), compare=False)
    # After a pause longer than this, and than two of its periods, a stream goes on only where the
    # robot can be there soon.
    stream_gap_s: float = 0.1
    start_rad: float = 0.02 * DEGREE  # how far from where a command begins the robot may stand
    start_m: float = 5e-5
    joint_state_age_s: float = 0.2  # older readings do not tell where the robot is
    flange_frame: str = "tool0"
    tool_frame: str = ""  # child of an acceptable tool frame; empty: any
    policy: Policy = Policy.REFUSE
    model_age_s: float = 0.0  # a model with an older stamp is not corrected with; 0: any age
    free_axis: bool = False  # the tool may turn about its z
    # Where no serial tells robots of one model apart: of the file that a model or tool must have
    # been made with.
    robot_file_hash: str = ""
    shadow: bool = False


@dataclass(frozen=True)
class Survey:
    """An arm's correction at the tool over postures that fill its joint range."""

    beyond: float  # share of postures in which it exceeds its bounds
    worst_m: float
    worst_rad: float

    def __str__(self) -> str:
        return (
            f"{self.worst_m * 1e3:.3f} mm and {np.degrees(self.worst_rad):.3f} deg at worst, "
            f"beyond the bounds in {self.beyond:.1%} of the postures"
        )


def survey(reference: SerialArm, actual: SerialArm, bounds: ShiftBounds) -> Survey:
    """Look at the correction in `POSTURES` postures over the joint range, always the same ones."""
    q = random_postures(reference, POSTURES)
    found = JointCorrection.between(reference, actual).correct(q)
    fine = bounds.hold(found)
    return Survey(
        1.0 - float(np.mean(fine)),
        float(np.max(found.tcp_shift_m)),
        float(np.max(found.tcp_rotation_rad)),
    )


def require_within(result: StagedResult, config: CorrectionConfig, arm: SerialArm) -> None:
    """Refuse a correction that is beyond its bounds; names the first point that is.

    Near a singularity the weak direction is corrected in part; what remains is reported.
    """
    drift, bound = result.arm, config.thermal
    fine = bound.hold(drift)
    if not np.all(fine):
        words = bound.beyond(np.max(drift.tcp_shift_m), np.max(drift.tcp_rotation_rad), "at most")
        raise RefusedError(Reason.TCP_BOUND, f"{words} (point {int(np.argmin(fine)) + 1})")
    for part, bounds in zip(result.parts, (bound, config.tool), strict=False):
        largest = bounds.of_joints(arm)
        over = np.abs(part.joint_shift) > largest + ROUNDING
        if over.any():
            point, joint = np.argwhere(over)[0]
            raise RefusedError(
                Reason.JOINT_BOUND,
                f"{arm.joint_names[joint]} by {part.joint_shift[point, joint]:.6f}, allowed "
                f"{largest[joint]:.6f} (point {point + 1})",
            )


def require_limits(q: Array, arm: SerialArm) -> None:
    """Refuse joints (m, n) beyond the arm's limits, and what is no number."""
    inside = (q >= arm.lower - ROUNDING) & (q <= arm.upper + ROUNDING)
    if not inside.all():
        point, joint = np.argwhere(~inside)[0]
        raise RefusedError(
            Reason.JOINT_LIMIT,
            f"{arm.joint_names[joint]} would be at {q[point, joint]:.6f}, allowed "
            f"{arm.lower[joint]:.6f} to {arm.upper[joint]:.6f} (point {point + 1})",
        )


# ---- correction of which no more is made than its bounds and the joint limits allow -------------
#
# With d(q) the whole shift of the joints, the shift made is k(q) d(q), with one share for all
# joints:
#
#     k = min(1, b_tool / e_tool, b_j / |d_j|, m_j / (FADES_WITHIN D_j))                        (1)
#
# where e_tool is the drift's error at the tool and b_tool its bound, b_j the bound of joint j, m_j
# its distance from the nearer limit, and D_j = b_j max_i |d_i| / b_i. A quotient by |d_j| in place
# of D_j would jump where a joint's shift changes its sign at its limit. Every term is continuous
# in q wherever d is not zero, so k d is continuous everywhere; and since the last one changes by
# at most 1 / FADES_WITHIN per unit of motion, taught joints follow from corrected ones.


TINY = 1e-300
FADES_WITHIN = 3.0  # of a joint limit


@dataclass(frozen=True)
class ClampedResult(StagedResult):
    """Corrected joints (m, n), the part that was made of the shift (m,), and what bound it."""

    kept: Array
    reason: Reason | None

    @property
    def whole(self) -> NDArray[np.bool_]:
        """(m,) True where all of the correction was made."""
        return np.asarray(super().whole & (self.kept == 1.0))

    @property
    def remaining_m(self) -> Array:
        """(m,) position error that remains at the tool, at most."""
        shift = np.sum([part.tcp_shift_m for part in self.parts], axis=0)
        return np.asarray(super().remaining_m + (1.0 - self.kept) * shift)


class ClampedCorrection(StagedCorrection):
    """A `StagedCorrection` that makes as much of the shift as the bounds allow (equation 1)."""

    def __init__(
        self, reference: Array, actual: Array, arm: SerialArm, config: CorrectionConfig
    ) -> None:
        thermal, tool = config.thermal.of_joints(arm), config.tool.of_joints(arm)
        super().__init__(reference, actual, FADES_FROM * thermal, tool, config.free_axis)
        self._thermal, self._joint_bounds = config.thermal, (thermal, tool)
        self._lower, self._upper = arm.lower, arm.upper

    def correct(self, q: Array) -> ClampedResult:
        """Correct joints (m, n)."""
        full = super().correct(q)
        shares = self._shares(q, full)
        worst = min(shares, key=lambda reason: float(np.min(shares[reason])))
        kept = np.minimum(1.0, np.min(list(shares.values()), axis=0))
        part = q + kept[:, None] * (full.q - q)
        made = np.where((kept == 1.0)[:, None], full.q, part)
        reason = worst if np.any(kept < 1.0) else None
        return ClampedResult(made, full.arm, full.tool, kept, reason)

    def uncorrect_one(self, corrected: Array) -> Array:
        """Taught joints (n,) of one point's corrected ones."""
        return np.asarray(self.uncorrect(corrected[None])[0])

    def velocity_one(self, q: Array, velocity: Array, corrected: Array) -> Array:
        """Velocities (n,) of one point's corrected joints."""
        rates, _ = self._path_rates(q[None], velocity[None], None, (corrected - q)[None])
        return rates[0]

    def taught_velocity_one(self, corrected: Array, velocity: Array, q: Array) -> Array:
        """Velocities (n,) of one point's taught joints, of those of the corrected ones."""
        found, corrected = velocity, self.correct(q[None]).q[0]
        for _ in range(MOST_STEPS):
            miss = velocity - self.velocity_one(q, found, corrected)
            found = found + miss
            if not np.max(np.abs(miss)) > VELOCITY_EXACT:
                break
        return np.asarray(found)

    def _shares(self, q: Array, full: StagedResult) -> dict[Reason, Array]:
        """Largest share (m,) of the shift by each bound; equation 1."""
        arm, bounds = full.arm, self._joint_bounds
        at_tool = np.minimum(
            self._thermal.tcp_m / np.maximum(arm.tcp_shift_m, TINY),
            self._thermal.tcp_rad / np.maximum(arm.tcp_rotation_rad, TINY),
        )
        shifts = [np.maximum(np.abs(part.joint_shift), TINY) for part in full.parts]
        joints = np.min([np.min(b / x, axis=1) for b, x in zip(bounds, shifts, strict=False)], 0)
        bound = bounds[0] + bounds[1]
        size = np.max(np.abs(full.q - q) / bound, axis=1)
        room = np.maximum(np.minimum(q - self._lower, self._upper - q), 0.0)
        limit = np.min(room / bound, axis=1) / np.maximum(FADES_WITHIN * size, TINY)
        return {Reason.TCP_BOUND: at_tool, Reason.JOINT_BOUND: joints, Reason.JOINT_LIMIT: limit}


def correction_between(
    reference: Array, actual: Array, arm: SerialArm, config: CorrectionConfig
) -> StagedCorrection:
    """The correction from one model to another that the policy asks for."""
    if config.policy is not Policy.REFUSE:
        return ClampedCorrection(reference, actual, arm, config)
    thermal, tool = config.thermal.of_joints(arm), config.tool.of_joints(arm)
    return StagedCorrection(reference, actual, FADES_FROM * thermal, tool, config.free_axis)


SAME_MODEL = 1e-12  # of packed models that are the same


class DesiredOffset:
    """Corrected less taught joints, as the model and the tool in use want it.

    ``limiter``: brings it in. ``stage``: the correction in use, None while nothing is to be
    corrected; ``known``: the same as if it were on, a robot may show it that was corrected before.
    ``clamped``, ``passed``: how many messages were corrected in part, or not at all, for what
    bound. ``whole_step``: the last arguments of `step_out`, None where it does not serve.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm, self._config = reference, config
        self.limiter = OffsetLimiter(reference.prismatic, config.turning, config.sliding)
        self._reference = pack_model(reference)
        self._actual = self._reference
        self.stage: StagedCorrection | None = None
        self.known: StagedCorrection | None = None
        self.figures = np.zeros(FIGURES)  # what is said of the messages, see `limiter`
        self.clamped: Counter[Reason] = Counter()
        self.passed: Counter[Reason] = Counter()
        self.made = False  # whether the last message was corrected with ``stage``
        self._bound: Reason | None = None  # what bound the offsets that were wanted last
        self._weak = 0  # of how many of these a part was given up
        self._span = np.array([reference.lower, reference.upper], dtype=np.float64)
        bounds = config.thermal.of_joints(reference), config.tool.of_joints(reference)
        self._bounds = np.array(bounds, dtype=np.float64)
        self._nothing = np.zeros(reference.n)
        self._tcp = np.array([config.thermal.tcp_m, config.thermal.tcp_rad])
        self.whole_step: tuple[Any, ...] | None = None

    def want(self, actual: SerialArm, on: bool) -> None:
        """Correct for an arm with its tool from the next command on, or for nothing."""
        packed = pack_model(actual)
        if not same_models(packed, self._actual, SAME_MODEL):
            self._actual = packed
            same = same_models(packed, self._reference, SAME_MODEL)
            self.known = None
            if not same:
                self.known = correction_between(self._reference, packed, self._arm, self._config)
        self.stage, self.whole_step = self.known if on else None, None
        if self.stage is not None and self._config.policy is Policy.REFUSE:
            stage = self.stage
            given = stage.largest, stage.free_axis, stage.works, stage.reports, self.figures
            self.whole_step = self._span, self._bounds, self._tcp, *given

    def at(self, q: Array) -> tuple[Array, StagedResult | None]:
        """Wanted offsets (m, n) at taught joints; raises `RefusedError` as the policy says.

        Nothing is counted: see `count`.
        """
        self.made, self._bound, self._weak = False, None, 0
        self.figures[SHIFT : REMAINING + 1] = 0.0
        if self.stage is None:
            return np.zeros_like(q), None
        result = self.stage.correct(q)
        if not result.converged.all():
            point = int(np.argmin(result.converged)) + 1
            detail = f"the pose is at the edge of the reach (point {point})"
            raise RefusedError(Reason.NOT_SOLVED, detail)
        policy = self._config.policy
        if policy is Policy.REFUSE:
            require_within(result, self._config, self._arm)
        elif isinstance(result, ClampedResult) and result.reason is not None:
            self._bound = result.reason
            if policy is Policy.PASS:
                return np.zeros_like(q), None
        offset, self.made = result.q - q, True
        self._weak = int(np.count_nonzero(result.weak))
        self.figures[SHIFT] = result.arm.tcp_shift_m.max()
        self.figures[LARGEST] = np.abs(offset).max()
        self.figures[REMAINING] = result.remaining_m.max()
        return offset, result

    def count(self) -> None:
        """Count what bound the offsets that were wanted last: they go out."""
        if self._bound is not None:
            passes = self._config.policy is Policy.PASS
            (self.passed if passes else self.clamped)[self._bound] += 1
        self.figures[REDUCED] += self._weak

    def put_out(
        self,
        q: Array,
        velocity: Array,
        elapsed: float,
        longest: float,
        active: Array,
        speeds: Array,
    ) -> float:
        """Put one target (n,) with its velocities out by the limiter; see `limiter.step_out`.

        In one piece where nothing is out of the ordinary. Else raises `RefusedError` as `at`.
        """
        limiter, given = self.limiter, self.whole_step
        memory, limits = limiter.memory, limiter.limits
        if given is not None:
            share = step_out(q, velocity, elapsed, longest, memory, limits, active, speeds, *given)
            if share != NOT_WITHIN:
                self.made = True
                return share
        stage, span = self.stage, self._span
        if stage is None:
            self.made, desired = False, self._nothing
            self.figures[SHIFT : REMAINING + 1] = 0.0
        else:
            desired = self.at(q[None])[0][0]
        share = put_out(memory, q, desired, elapsed, longest, limits, active, speeds[0], span)
        if stage is not None and 0.0 <= share <= 1.0 + ROUNDING:
            self.count()
        if isinstance(stage, ClampedCorrection) and self.made and not limiter.withheld.any():
            memory[VELOCITY] = stage.velocity_one(memory[TAUGHT], velocity, memory[OUT])
        else:
            memory[VELOCITY] = velocity + memory[OFFSET_RATE]
        self.figures[ADDS] = memory[OFFSET].any()
        self.figures[TOO_FAST] = 1.0  # as far as is known here
        return share

    def begins(self, q: Array) -> Array:
        """Offsets (3, n) at taught joints (n,) that a robot may show: wanted, known, none.

        Nothing is counted: the command itself is looked at after its begin.
        """
        rows = np.zeros((3, len(q)))
        for row, stage in zip(rows, (self.stage, self.known), strict=False):
            if stage is not None:
                row[:] = stage.correct(q[None]).q[0] - q
        return rows


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
        self._arm = reference  # that it says; the reference where it knows no drift
        self.revision: int | None = None  # of the model taken over
        self._head = 0  # revision in force by the history
        self._newest_ns = 0  # stamp of all that were taken over, or were in force before
        self.survey = Survey(0.0, 0.0, 0.0)  # its correction over the joint range
        self.waiting: OfferedModel | None = None  # refused, and to be taken over if looked at again
        self._now_ns: int | None = None  # of the clock that stamps models, as it was told last
        self.stale = ""  # why the model is too old to be used
        self.payload = ""  # what it may cost that the arm carries another load than the model's
        self.tools = ToolGate(reference.T_flange_tool, config)

    @property
    def actual(self) -> SerialArm:
        """The actual arm with its tool, as far as they are known; else the reference's."""
        arm = self._reference if self.stale else self._arm
        tool = self.tools.T_flange_tool
        return arm if tool is None else replace(arm, T_flange_tool=tool)

    def take_model(self, model: OfferedModel, places: Array, *, again: bool = False) -> None:
        """Take over a model; ``places`` (k, n) are where the robot is, and goes.

        A revision lower than the one in use comes from a history that began again: it must be
        newer by its stamp than all before, or be looked at (``again``). One that is refused for
        this, or for its size here, waits for `look_again`.

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
        if not again:
            known = self._model
            if known is not None:
                one, other = (pack_model(self._arm_of(m)) for m in (model, known))
                if same_models(one, other, 0.0) and model.revision == known.revision:
                    self._use(model)
                    return
            if not _later(model, known, self._head, self._newest_ns):
                self.waiting = model
                after = f"{self._head} of the history" if known is None else f"{self.revision}"
                raise RefusedError(
                    Reason.OLD_REVISION,
                    f"revision {model.revision} with other numbers after {after}, and not newer by "
                    "its stamp; ~/take_over takes it over",
                )
        arm = self._arm_of(model)
        if len(places):
            self._require_small(model, arm, places)
        self._use(model)
        self.payload = payload_note(arm, model.load, self._reference.load)
        self.survey = survey(self._reference, arm, self._config.thermal)

    def know_past(self, model: Past, tool: Past) -> None:
        """As if those before had been taken over, and left again."""
        self._head, self.tools.head = model.revision, tool.revision
        self._newest_ns = max(self._newest_ns, model.newest_ns)
        self.tools.newest_ns = max(self.tools.newest_ns, tool.newest_ns)

    def _use(self, model: OfferedModel) -> None:
        self._model, self._arm, self.revision = model, self._arm_of(model), model.revision
        self._newest_ns = max(self._newest_ns, model.stamp_ns)
        self._judge_age()

    def watch_age(self, now_ns: int) -> bool:
        """Compare the model's stamp with the clock; returns whether it became stale, or fresh."""
        was, self._now_ns = bool(self.stale), now_ns
        self._judge_age()
        return was != bool(self.stale)

    def _judge_age(self) -> None:
        self.stale, limit_s = "", self._config.model_age_s
        if self._model is not None and self._now_ns is not None and limit_s > 0.0:
            age_ns = self._now_ns - self._model.stamp_ns
            if abs(age_ns) > limit_s * 1e9 and self._arm is not self._reference:
                old = f"{abs(age_ns) * 1e-9:.1f} s " + ("old" if age_ns > 0 else "in the future")
                self.stale = (
                    f"model revision {self._model.revision} is {old}, allowed {limit_s:g} s"
                )

    def look_again(self, places: Array) -> None:
        """Take over the model that waits for it, if there is one; raises as `take_model`."""
        if self.waiting is not None:
            self.take_model(self.waiting, places, again=True)

    @property
    def serial(self) -> str:
        """Of the model in use; empty without one."""
        return "" if self._model is None else self._model.serial

    def _require_robot(self, offered: OfferedCalibration) -> None:
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
        nominal, reference = (
            replace(arm, T_base_root=model.T_base_root).with_model(
                model.mdh, model.functions, model.load
            )
            for arm in (self._nominal, self._reference)
        )
        # The root travels as a quaternion: equal up to rounding.
        if same_models(pack_model(nominal), pack_model(self._nominal), SAME_MODEL):
            return self._reference
        return reference

    def _require_small(self, model: OfferedModel, arm: SerialArm, places: Array) -> None:
        bound = self._config.thermal
        shift = JointCorrection.between(self._reference, arm).correct(places)
        if not np.all(bound.hold(shift)):
            self.waiting = model
            words = bound.beyond(
                np.max(shift.tcp_shift_m),
                np.max(shift.tcp_rotation_rad),
                "where the robot is or goes",
            )
            found = survey(self._reference, arm, bound)
            raise RefusedError(Reason.TCP_BOUND, f"{words}; over its joint range {found}")

    def take_tool(self, tool: OfferedTool) -> None:
        """As `ToolGate.take`; raises `RefusedError` also when it was made for another robot."""
        self._require_robot(tool)
        self.tools.take(tool)


class ToolGate:
    """Judges the measured tools of this robot, and keeps the last good one until it may be used.

    One that is ``waiting`` is adopted when the robot stands or a trajectory begins; one that was
    ``refused`` is older than those before by revision and stamp, and is to be looked at again.
    """

    def __init__(self, taught: Array, config: CorrectionConfig) -> None:
        self._taught = taught
        self._config = config
        self.in_use: OfferedTool | None = None
        self.waiting: OfferedTool | None = None
        self.refused: OfferedTool | None = None
        self.head = 0  # revision in force by the history
        self.newest_ns = 0  # stamp of all that were taken, or were in force before

    @property
    def T_flange_tool(self) -> Array | None:
        """The tool in use; None: the taught one."""
        return None if self.in_use is None else self.in_use.T_flange_tool

    def take(self, tool: OfferedTool, *, again: bool = False) -> None:
        """Let a tool wait for its adoption; one that is in use already only ends the wait.

        A revision that is not newer than the last one must be newer by its stamp than all before,
        or be looked at (``again``); that it says nothing of the mounted tool any more, or does
        again, is news.

        Raises `RefusedError` when it is not accepted, its frames are not the configured ones, it
        is older than the last one, or too far from the taught tool.
        """
        if not tool.accepted:
            raise RefusedError(Reason.NOT_ACCEPTED, f"tool revision {tool.revision}")
        parent, child = self._config.flange_frame, self._config.tool_frame
        if child and tool.child != child:
            raise RefusedError(Reason.BAD_TOOL, f"child '{tool.child}', expected '{child}'")
        if tool.parent != parent:
            raise RefusedError(Reason.BAD_TOOL, f"parent '{tool.parent}', expected '{parent}'")
        if tool.T_flange_tool is not None:
            self._require_small(tool.T_flange_tool)
        self.refused = None
        last = self.waiting or self.in_use
        known = last is not None and _same_tool(tool, last)
        later = _later(tool, last, self.head, self.newest_ns) or _retaught(tool, last)
        if not (known or later or again):
            self.refused = tool
            raise RefusedError(
                Reason.OLD_REVISION,
                f"tool revision {tool.revision} is another tool than the last one and not newer "
                "by its stamp; ~/take_over takes it over",
            )
        self.newest_ns = max(self.newest_ns, tool.stamp_ns)
        if self.in_use is not None and _same_tool(tool, self.in_use):
            self.in_use, self.waiting = tool, None
        else:
            self.waiting = tool

    def look_again(self) -> None:
        """Take the tool that was refused for its revision, if there is one."""
        if self.refused is not None:
            self.take(self.refused, again=True)

    def _require_small(self, T_flange_tool: Array) -> None:
        taught, bound = self._taught, self._config.tool
        shift = float(np.linalg.norm(T_flange_tool[:3, 3] - taught[:3, 3]))
        turn = float(np.linalg.norm(frames.log_rotation(T_flange_tool[:3, :3] @ taught[:3, :3].T)))
        if shift > bound.tcp_m + ROUNDING or turn > bound.tcp_rad + ROUNDING:
            words = bound.beyond(shift, turn, "from the taught tool")
            raise RefusedError(Reason.TOOL_BOUND, words)


def _same_tool(a: OfferedTool, b: OfferedTool) -> bool:
    if a.T_flange_tool is None or b.T_flange_tool is None:
        return a.revision == b.revision and a.T_flange_tool is b.T_flange_tool
    return a.revision == b.revision and np.array_equal(a.T_flange_tool, b.T_flange_tool)


def _retaught(a: OfferedTool, b: OfferedTool | None) -> bool:
    """Whether one is told as the taught tool and the other is not, both of one revision."""
    if b is None:
        return False
    same = (a.revision, a.stamp_ns) == (b.revision, b.stamp_ns)
    return same and (a.T_flange_tool is None) != (b.T_flange_tool is None)


def _later(a: OfferedCalibration, b: OfferedCalibration | None, head: int, newest_ns: int) -> bool:
    """Whether one is newer than the last, whose own stamp is an old one after a rollback.

    The first is compared with the revision in force by the history.
    """
    newer = a.revision >= head if b is None else a.revision > b.revision
    return newer or a.stamp_ns > newest_ns
