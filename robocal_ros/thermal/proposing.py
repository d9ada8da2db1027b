# SPDX-License-Identifier: Apache-2.0
"""From the measurements of a command to a proposal in the history; of a shift of frames too."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros import __version__
from robocal_ros.estimation.assessment import Verdict, summarise
from robocal_ros.ground.errors import Code, ConflictError, InputError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document, transform_document
from robocal_ros.ground.samples import Measurements
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import FRAME_SHIFT, REFERENCE, THERMAL, Head, Proposal
from robocal_ros.identification import Method, identify_and_hold_out
from robocal_ros.identification.judged import (
    JudgedIdentification,
    identification_document,
    identified_model_document,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.programs.frame_shift import FrameShift, given_shift
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import expected_drift, process_document
from robocal_ros.thermal.cell_setup import (
    SensorMethod,
    calibrate_sensor,
    sensor_document,
    sensor_verdict,
)
from robocal_ros.thermal.drift_following import (
    EXPECTED,
    FLANGE,
    METHODS,
    DriftFollower,
    InForce,
    default_process,
)
from robocal_ros.thermal.flange_sensor import (
    capture_on_flange,
    flange_sensor_document,
    flange_sensor_model,
    identify_and_judge_flange_sensor,
)
from robocal_ros.thermal.identification import (
    cycle_document,
    fixed_sphere,
    identify_subset,
    judge_cycle,
)
from robocal_ros.thermal.observations import Beside
from robocal_ros.thermal.reference import (
    COMMISSIONED,
    ColdReference,
    ColdSpots,
    capture_reference,
    drift_share,
    drift_size_m,
    reference_document,
)

if TYPE_CHECKING:
    from robocal_ros.programs.documents import (
        PoseErrorDocument,
        ShiftDocument,
        ShiftErrorsDocument,
        ShiftInForceDocument,
    )

SENSOR = "sensor"
SENSOR_METHODS: tuple[SensorMethod, ...] = ("ml", "classic")


class Proposer:
    """Solves what a command asks for, against what is in force, and keeps the result.

    ``software``: version that makes the candidates.
    ``current``: what is in force, followed by the session.
    """

    def __init__(self, software: str, current: InForce) -> None:
        self._software, self._current, self._config = software, current, current.config
        self._nominal, self._history = current.nominal, current.history

    def _propose(
        self,
        kind: str,
        command: Command,
        wall_ns: int,
        method: str,
        verdict: Verdict,
        document: Document,
        model: Document,
        inputs: dict[str, NDArray[Any]],
    ) -> int:
        """Keep a candidate and return its id."""
        # What it was solved against, though another process may have decided meanwhile.
        head = self._current.head if kind == THERMAL else self._history.head(kind)
        held_out = document.get("calibrated", {}).get("held_out", {})
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self._nominal.model_hash,
                based_on=head.revision,
                cycle_id=str(command.arguments.get("cycle_id", "")),
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method=method,
                code=verdict.code,
                reason=verdict.reason,
                candidate_rms_mm=held_out.get("rms_mm"),
                document=document,
                model=model,
                inputs=inputs,
            )
        )

    def _accept(self, chosen: int, command: Command, reason: str, wall_ns: int) -> None:
        """Bring a step of the set-up into force: it moves nothing."""
        by = str(command.arguments.get("by", ""))
        self._history.accept(chosen, by=by, reason=reason, expected_head=None, wall_ns=wall_ns)

    def method(self, command: Command) -> Method:
        """Tell the estimator that a command names, else the configured one.

        Raises `InputError` when there is no such estimator.
        """
        named = str(command.arguments.get("method") or self._config.method)
        for method in METHODS:
            if method == named:
                return method
        raise InputError(f"method '{named}' is not one of {', '.join(METHODS)}")

    def identify(
        self,
        command: Command,
        data: Measurements,
        beside: Beside,
        method: Method,
        follower: DriftFollower | None,
        wall_ns: int,
    ) -> Outcome:
        """Identify a model from these measurements, judge it and propose it.

        ``follower``: of the drift since the cold reference in force; None without one.
        """
        current, reference = self._current, self._current.reference
        if reference is None or follower is None:
            in_force = current.arm if current.head.model is not None else None
            if self._config.arrangement == FLANGE:
                judged = identify_and_judge_flange_sensor(
                    self._nominal,
                    [data],
                    share=self._config.hold_out,
                    seed=self._config.seed,
                    in_force=in_force,
                )
                document = flange_sensor_document(judged)
                model = flange_sensor_model(judged.identification)
                verdict = judged.verdict
                return self._keep(command, document, model, verdict, "map", data, {}, wall_ns)
            found = identify_and_hold_out(
                self._nominal,
                data,
                share=self._config.hold_out,
                seed=self._config.seed,
                method=method,
                model="full",
                in_force=in_force,
            )
            model = identified_model_document(found.identification)
            document = {**identification_document(found)}
            return self._keep(command, document, model, found.verdict, method, data, {}, wall_ns)
        data = reference.placed(data)
        with follower.attempt():
            solution = self._drift(follower, reference, data, beside, method)
            kept = follower.kept(beside.temperature)
            return self._keep(command, *solution, method, data, kept, wall_ns)

    def _keep(
        self,
        command: Command,
        document: Document,
        model: Document,
        verdict: Verdict,
        method: Method,
        data: Measurements,
        beside: dict[str, NDArray[Any]],
        wall_ns: int,
    ) -> Outcome:
        cycle_id = str(command.arguments.get("cycle_id", ""))
        document = document | {"stamp_ns": command.stamp_ns, "cycle_id": cycle_id}
        model = model | {"reference_revision": self._current.reference_revision}
        inputs = data.arrays() | beside
        chosen = self._propose(THERMAL, command, wall_ns, method, verdict, document, model, inputs)
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))

    def _drift(
        self,
        follower: DriftFollower,
        reference: ColdReference,
        data: Measurements,
        beside: Beside,
        method: Method,
    ) -> tuple[Document, Document, Verdict]:
        """Since the cold visit, against the cold model: never a step on what is in force."""
        config, spots, in_force = self._config, reference.spots, self._current.arm
        held = self._require_functions()
        fixed = None
        if len(reference.fixed) and len(beside.fixed):
            fixed = fixed_sphere(reference.fixed, beside.fixed, config.sigma_m)
        follower.read(beside.temperatures)
        tracked = follower.take(data, in_force, fixed)
        found, judged = tracked.found, tracked.judged
        if method == "lsq" and not follower.state.moved:
            names = config.drift_parameters or self._nominal.parameters.names
            found = identify_subset(spots, data, names, sigma_m=config.sigma_m)
            judged = judge_cycle(found, spots, in_force=in_force, sigma_m=config.sigma_m)
        verdict = judged.verdict
        # what moved is told on until the next cycle; a motor may speak again before
        unread = "" if follower.state.moved else follower.unread(beside.silent)
        for words in filter(None, (other_sides(spots, data), unread)):
            verdict = replace(verdict, reason=f"{verdict.reason}; {words}")
        judged = replace(judged, verdict=verdict)
        model = (
            model_document(found.arm)
            | held
            | {
                "parameters": list(self._nominal.parameters.names),
                "covariance": found.covariance.tolist(),
                "reference_mdh": reference.cell.arm.mdh.tolist(),
                "reference_stamp_ns": reference.data.middle_ns,
            }
        )
        visited = spots.visited(data.q)
        document = cycle_document(found, judged, spots, self._nominal, method) | {
            "poses": {
                "visited": len(visited),
                "missing": [n for n in range(1, spots.poses + 1) if n not in visited],
            }
        }
        return document, model, verdict

    def _require_functions(self) -> Document:
        """The load of the reference's model, of which a drift holds functions and compliances.

        Raises `ConflictError` where the model in force has other joint functions: a drift since
        this reference would put them out of force.
        """
        reference, model = self._current.reference_model or {}, self._current.head.model or {}
        functions = model.get("functions")
        if functions is not None and functions != reference.get("functions"):
            raise ConflictError(
                "the model in force has other joint functions than the cold reference: capture a "
                "new one with the cold robot"
            )
        return _load_of(reference)

    def capture(
        self, command: Command, data: Measurements, beside: Beside, frame: str, wall_ns: int
    ) -> Outcome:
        """Make the cold reference of these measurements and bring it into force.

        The model in force stays: where it holds a drift that a cold robot has not, the forecast
        says so until a cycle is accepted.
        """
        current = self._current
        visit, which_arm = self._visit(data, frame)
        reference = replace(visit, fixed=beside.fixed, temperature=beside.temperature)
        rms_mm = summarise(reference.cell.residual(reference.used)).rms_m * 1e3
        message = (
            f"cold reference of {len(data)} measurements captured, residual {rms_mm:.3f} mm rms"
        )
        if reference.rejected:
            message += (
                f" of the {len(reference.used)} that fit; not fitting: "
                f"{', '.join(reference.rejected)}"
            )
        command, expected, from_what = self._expected(command)
        message += str(command.arguments.get(LEFT_OUT, "")) + which_arm + from_what
        if expected["gains"] is not None and beside.temperature is None:
            message += f", followed without: no temperature of {', '.join(beside.silent)}"
        if words := other_sides(reference.spots, reference.data):
            message += f"; {words}"
        document = {"residual_rms_mm": rms_mm, "rejected": list(reference.rejected)}
        verdict = Verdict(Code.ACCEPT, message)
        model = (
            reference_document(reference)
            | _load_of(current.head.model or {})
            | {
                EXPECTED: expected,
                COMMISSIONED: current.commissioned.mdh.tolist(),
            }
        )
        chosen = self._propose(
            REFERENCE, command, wall_ns, "lsq", verdict, document, model, visit.data.arrays()
        )
        self._accept(chosen, command, "captured", wall_ns)
        return Outcome(command, Code.ACCEPT, message, calibration_id=chosen, samples=len(data))

    def _visit(self, data: Measurements, frame: str) -> tuple[ColdReference, str]:
        """The measurements with the arm that they were made with, and words that tell which.

        A robot that has cooled is the commissioned one; after a knock of the sensor it is as warm
        as before, and with the cold arm its drift would be lost.
        """
        current, sigma_m = self._current, self._config.sigma_m
        captured: Callable[..., ColdReference] = capture_reference
        if self._config.arrangement == FLANGE:
            captured = partial(capture_on_flange, frame=frame)
        visit, reference = captured(current.commissioned, data), current.reference
        if reference is None or not current.drifted:
            return visit, ""
        if (size_m := drift_size_m(visit, current.arm)) <= sigma_m:
            return visit, f"; the drift in force is within the noise ({size_m * 1e3:.3f} mm)"
        found = drift_share(reference, visit, current.arm, sigma_m)
        shown = f"{found.share:.0%} of the drift in force"
        nominal = np.array_equal(current.commissioned.mdh, self._nominal.mdh)
        which = "id 0, the nominal model" if nominal else "the id of the calibration before it"
        remedy = f"roll the drift back (~/rollback, {which})"
        if not found.told:
            raise TooFewSamplesError(
                "these poses do not tell whether the robot is cold or as warm as the model in "
                f"force: if it is cold, {remedy} and capture again; if it is warm, measure "
                "the poses of the cold reference in three rounds, or capture when it is cold"
            )
        if found.between:
            raise ConflictError(
                f"the measurements show {shown}: the robot is neither cold nor as warm as the "
                f"model in force; capture when it has cooled, or {remedy} if it is cold"
            )
        if found.warm:
            visit = captured(current.arm, data)
            return visit, f"; the robot is as warm as the model in force ({shown})"
        return visit, (
            f"; the robot is cold ({shown}), and the model in force still holds that drift: "
            f"measure a cycle and accept its model, or {remedy}"
        )

    def _expected(self, command: Command) -> tuple[Command, Document, str]:
        """The drift to expect from now on; the command carries it for replay."""
        default = default_process(self._nominal, self._config.sigma_m)
        if self._config.prior == "default":
            return command, process_document(default), ""
        if EXPECTED not in command.arguments:
            found, words = expected_drift(self._nominal, self._history)
            kept = process_document(found or default)
            arguments = {**command.arguments, EXPECTED: kept, "expected_from": words}
            command = replace(command, arguments=arguments)
        from_what = f"; expected drift: {command.arguments['expected_from']}"
        return command, command.arguments[EXPECTED], from_what

    def place_sensor(
        self, command: Command, data: Measurements, frame: str, wall_ns: int
    ) -> Outcome:
        """Place the sensor of a frame, and bring it into force where the verdict accepts.

        Raises `RobocalError` when the measurements cannot place them, or the history refuses.
        """
        if self._config.arrangement == FLANGE:
            raise InputError(
                "a sensor on the flange is placed with the cold reference: call capture_reference"
            )
        named = str(command.arguments.get("method") or SENSOR_METHODS[0])
        method = next((m for m in SENSOR_METHODS if m == named), None)
        if method is None:
            raise InputError(f"method '{named}' is not one of {', '.join(SENSOR_METHODS)}")
        found = calibrate_sensor(self._current.arm, data, method)
        verdict = sensor_verdict(found)
        document: Document = {**sensor_document(found, self._nominal)}
        inputs, model = data.arrays(), document | {"frame": frame}
        chosen = self._propose(SENSOR, command, wall_ns, method, verdict, document, model, inputs)
        if verdict.accept:
            self._accept(chosen, command, "placed", wall_ns)
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))


LEFT_OUT = "left_out"  # argument of a capture: words on what was measured before its visit
NAMED_SHARE = 0.25  # of a joint's backlash


def other_sides(spots: ColdSpots, data: Measurements) -> str:
    """Say at which poses joints came from another side than when cold; empty: at none.

    Of a cold visit itself: at which poses its rounds differ.
    """
    if data.side is None:
        return ""
    other = spots.other_side(spots.match(data), data.side) > NAMED_SHARE
    poses = spots.visited(data.q[other.any(axis=1)])
    if not poses:
        return ""
    names = [spots.cell.arm.joint_names[j] for j in np.flatnonzero(other.any(axis=0))]
    return (
        f"reached from another side: {', '.join(names)} at pose {', '.join(map(str, poses))}, "
        "where backlash counts as noise; begin each round at the same place"
    )


def _load_of(model: Document) -> Document:
    """The load that a model's compliances were found with; today's payload may be another one."""
    return {} if model.get("load") is None else {"load": model["load"]}


WORTH_IT = 0.9  # of the error: less of a gain is not worth a change of the controller's frames


@dataclass(frozen=True, eq=False)
class FrameShiftInForce:
    """A shift of the history, judged with the present model."""

    revision: int
    shift: FrameShift

    def document(self, limit_mm: float) -> "ShiftInForceDocument":
        """What it leaves; ``limit_mm``: as of `errors_of`."""
        return {"revision": self.revision, **errors_of(self.shift.after, limit_mm)}


def shift_in_force(
    history: CalibrationHistory, models: CorrectionModels, q: Array, T_flange_tool: Array
) -> FrameShiftInForce | None:
    """The shift in force at working poses q (m, n); None where the frames are as they were."""
    head = history.head(FRAME_SHIFT)
    if head.calibration_id is None:
        return None
    kept = history.model(head.calibration_id)
    T_base, T_tool = (np.array(kept[name]) for name in ("T_base_shift", "T_tool_shift"))
    return FrameShiftInForce(head.revision, given_shift(models, q, T_flange_tool, T_base, T_tool))


@dataclass(frozen=True, eq=False)
class ShiftedWork:
    """What a shift serves: working poses q (m, n), their names, the tool (4, 4) there."""

    q: Array
    names: tuple[str, ...]
    T_flange_tool: Array


def shifted_work(history: CalibrationHistory, T_flange_tool: Array) -> ShiftedWork | None:
    """What the shift in force was found for; None where the frames are as they were.

    ``T_flange_tool`` (4, 4): where it was kept before the tool was kept with it.
    """
    number = history.head(FRAME_SHIFT).calibration_id
    if number is None:
        return None
    inputs, poses = history.inputs(number), history.document(number)["poses"]
    names = tuple(str(pose["name"]) for pose in poses)
    return ShiftedWork(inputs["q"], names, inputs.get("T_flange_tool", T_flange_tool))


def shift_document(shift: FrameShift, names: tuple[str, ...], limit_mm: float) -> "ShiftDocument":
    """A shift, and its errors, of each pose by its name; ``limit_mm``: for the shares."""
    poses = zip(names, _sizes(shift.before), _sizes(shift.after), strict=True)
    return {
        "T_base_shift": transform_document(shift.T_base_shift),
        "T_tool_shift": transform_document(shift.T_tool_shift),
        "before": errors_of(shift.before, limit_mm),
        "after": errors_of(shift.after, limit_mm),
        "poses": [{"name": name, "before": one, "after": other} for name, one, other in poses],
    }


def head_without_reference(history: CalibrationHistory) -> Head:
    """What a model identified from tables is judged against.

    Raises `ConflictError` where a cold reference is in force: drifts are told against its model.
    """
    reference = history.head(REFERENCE)
    if reference.model is not None:
        raise ConflictError(
            f"a cold reference is in force (calibration {reference.calibration_id}), and drifts "
            "count from its model: return to none with 'robocal history rollback --kind reference "
            "--to nominal', accept the new model, then capture a new reference"
        )
    return history.head(THERMAL)


def keep_identified(
    history: CalibrationHistory,
    judged: JudgedIdentification,
    data: Measurements,
    method: Method,
    based_on: int,
    wall_ns: int,
) -> int:
    """Put a model identified from tables into the history as a candidate; its number there.

    ``based_on``: revision that it was judged against, though another one may be in force by now.

    Raises `ConflictError` as `head_without_reference`.
    """
    head_without_reference(history)
    beside = {"reference_revision": history.head(REFERENCE).revision}
    document: Document = {**identification_document(judged), "stamp_ns": wall_ns, "cycle_id": ""}
    return history.propose(
        Proposal(
            kind=THERMAL,
            model_hash=document["model_hash"],
            based_on=based_on,
            cycle_id="",
            stamp_ns=wall_ns,
            created_ns=wall_ns,
            software=__version__,
            method=method,
            code=judged.verdict.code,
            reason=judged.verdict.reason,
            candidate_rms_mm=document["calibrated"]["held_out"]["rms_mm"],
            document=document,
            model=identified_model_document(judged.identification) | beside,
            inputs=data.arrays(),
        )
    )


def shift_verdict(
    found: "ShiftDocument", was: "ShiftInForceDocument | None", only_judged: bool
) -> Verdict:
    """Whether the shift is worth entering: against what was in force, else the frames as given."""
    before, now = found["before"]["rms_mm"], found["after"]["rms_mm"]
    with_what = "without a shift" if was is None else f"with that of revision {was['revision']}"
    rms = before if was is None else was["rms_mm"]
    if only_judged:
        code = Code.ACCEPT if now <= before else Code.WORSE_THAN_CURRENT
        return Verdict(code, f"{before:.3f} mm rms are {now:.3f} mm {with_what}")
    words = f"{rms:.3f} mm rms {with_what} become {now:.3f} mm"
    if now <= WORTH_IT * rms:
        return Verdict(Code.ACCEPT, words)
    hint = "correct the program instead" if was is None else "the frames in force still serve"
    return Verdict(Code.NO_SIGNIFICANT_GAIN, f"{words}: {hint}")


def keep_shift(
    history: CalibrationHistory,
    nominal: SerialArm,
    shift: FrameShift,
    q: Array,
    T_flange_tool: Array,
    document: Mapping[str, Any],
    verdict: Verdict,
    thermal_revision: int,
    wall_ns: int,
) -> int:
    """Put a shift into the history; its number there.

    ``thermal_revision``: of the model that it was found for, though another one may be in force.
    """
    return history.propose(
        Proposal(
            kind=FRAME_SHIFT,
            model_hash=nominal.model_hash,
            based_on=history.head(FRAME_SHIFT).revision,
            cycle_id="",
            stamp_ns=wall_ns,
            created_ns=wall_ns,
            software=__version__,
            method="frame-shift",
            code=verdict.code,
            reason=verdict.reason,
            candidate_rms_mm=document["after"]["rms_mm"],
            document=document,
            model={
                "T_base_shift": shift.T_base_shift.tolist(),
                "T_tool_shift": shift.T_tool_shift.tolist(),
                "thermal_revision": thermal_revision,
            },
            inputs={"q": q, "T_flange_tool": T_flange_tool},
        )
    )


def _sizes(twist: Array) -> "list[PoseErrorDocument]":
    return [
        {"mm": 1e3 * float(np.linalg.norm(e[:3])), "deg": float(np.degrees(np.linalg.norm(e[3:])))}
        for e in twist
    ]


def errors_of(twist: Array, limit_mm: float) -> "ShiftErrorsDocument":
    """Of twists (m, 6) from where the tool stands to where it should; the share is of axes."""
    mm = 1e3 * np.linalg.norm(twist[:, :3], axis=1)
    share = float(np.mean(1e3 * np.abs(twist[:, :3]) <= limit_mm))
    rms = float(np.sqrt(np.mean(mm**2)))
    return {"rms_mm": rms, "max_mm": float(np.max(mm)), "share_within_limit": share}
