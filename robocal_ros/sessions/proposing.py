"""From the measurements of a command to a proposal in the history."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import Verdict, summarise
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import (
    identification_document,
    identified_model_document,
    model_document,
    reference_document,
)
from robocal_ros.core.errors import InputError
from robocal_ros.core.identification import Method, identify_and_hold_out
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import THERMAL, Proposal
from robocal_ros.core.samples import Measurements
from robocal_ros.core.thermal.cycle_verdict import judge_cycle
from robocal_ros.core.thermal.documents import cycle_document, sensor_document
from robocal_ros.core.thermal.identification import identify_subset
from robocal_ros.core.thermal.reference import ColdReference, capture_reference
from robocal_ros.core.thermal.sensor_calibration import (
    SensorMethod,
    calibrate_sensor,
    sensor_verdict,
)
from robocal_ros.core.thermal.steps import FixedSphere, fixed_sphere
from robocal_ros.sessions.drift_following import DriftFollower, Following
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import REFERENCE, InForce
from robocal_ros.sessions.thermal_config import METHODS, ThermalConfig

Array = NDArray[np.float64]

SENSOR = "sensor"
SENSOR_METHODS: tuple[SensorMethod, ...] = ("ml", "classic")


@dataclass(frozen=True)
class _Solution:
    """A judged identification as it is kept."""

    document: dict[str, Any]
    model: dict[str, Any]
    verdict: Verdict


class Proposer:
    """Solves what a command asks for, against what is in force, and keeps the result.

    Parameters
    ----------
    current : what is in force, followed by the session.
    following : follows the drift since the cold reference in force.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: ThermalConfig,
        software: str,
        current: InForce,
        following: Following,
    ) -> None:
        self._nominal = nominal
        self._history = history
        self._config = config
        self._software = software
        self._current = current
        self._following = following

    def capture(self, command: Command, data: Measurements, fixed: Array, wall_ns: int) -> Outcome:
        """Make the cold reference of these measurements and bring it into force.

        ``fixed``: centres (n, 3) of a sphere fixed in the cell, measured meanwhile, m.

        Raises
        ------
        RobocalError
            When they cannot be one, or the history refuses.
        """
        reference = replace(capture_reference(self._current.arm, data), fixed=fixed)
        rms_mm = summarise(reference.cell.residual(reference.used)).rms_m * 1e3
        message = (
            f"cold reference of {len(data)} measurements captured, residual {rms_mm:.3f} mm rms"
        )
        if reference.rejected:
            message += (
                f" of the {len(reference.used)} that fit; not fitting: "
                f"{', '.join(reference.rejected)}"
            )
        document = {"residual_rms_mm": rms_mm, "rejected": list(reference.rejected)}
        verdict = Verdict(Code.ACCEPT, message)
        model = reference_document(reference)
        chosen = self._propose(
            REFERENCE, command, wall_ns, "lsq", verdict, document, model, data.arrays()
        )
        self._accept(chosen, command, "captured", wall_ns)
        return Outcome(command, Code.ACCEPT, message, calibration_id=chosen, samples=len(data))

    def place_sensor(
        self, command: Command, data: Measurements, frame: str, wall_ns: int
    ) -> Outcome:
        """Place the sensor of a frame, and bring it into force where the verdict accepts.

        Raises
        ------
        RobocalError
            When the measurements cannot place them, or the history refuses.
        """
        named = str(command.arguments.get("method") or SENSOR_METHODS[0])
        method = next((m for m in SENSOR_METHODS if m == named), None)
        if method is None:
            raise InputError(f"method '{named}' is not one of {', '.join(SENSOR_METHODS)}")
        found = calibrate_sensor(self._current.arm, data, method)
        verdict, document = sensor_verdict(found), sensor_document(found, self._nominal)
        inputs, model = data.arrays(), document | {"frame": frame}
        chosen = self._propose(SENSOR, command, wall_ns, method, verdict, document, model, inputs)
        if verdict.accept:
            self._accept(chosen, command, "placed", wall_ns)
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))

    def _accept(self, chosen: int, command: Command, reason: str, wall_ns: int) -> None:
        """A step of the set-up, which moves nothing, is in force when it is done."""
        by = str(command.arguments.get("by", ""))
        self._history.accept(chosen, by=by, reason=reason, expected_head=None, wall_ns=wall_ns)

    def method(self, command: Command) -> Method:
        """Tell the estimator that a command names, else the configured one.

        Raises
        ------
        InputError
            When there is no such estimator.
        """
        named = str(command.arguments.get("method") or self._config.method)
        for method in METHODS:
            if method == named:
                return method
        raise InputError(f"method '{named}' is not one of {', '.join(METHODS)}")

    def identify(
        self, command: Command, data: Measurements, fixed: Array, method: Method, wall_ns: int
    ) -> Outcome:
        """Identify a model from these measurements, judge it and propose it.

        ``fixed``: centres (n, 3) of a sphere fixed in the cell, measured meanwhile, m.

        Raises
        ------
        RobocalError
            When they cannot answer, or the history refuses.
        """
        reference, follower = self._current.reference, self._following.follower
        if reference is None or follower is None:
            return self._keep(command, self._calibration(data, method), method, data, {}, wall_ns)
        with follower.attempt():
            solution = self._drift(follower, reference, data, fixed, method)
            kept = follower.checkpoint()
            return self._keep(command, solution, method, data, kept, wall_ns)

    def _keep(
        self,
        command: Command,
        solution: _Solution,
        method: Method,
        data: Measurements,
        beside: dict[str, NDArray[Any]],
        wall_ns: int,
    ) -> Outcome:
        verdict, inputs = solution.verdict, data.arrays() | beside
        cycle_id = str(command.arguments.get("cycle_id", ""))
        document = solution.document | {"stamp_ns": command.stamp_ns, "cycle_id": cycle_id}
        chosen = self._propose(
            THERMAL, command, wall_ns, method, verdict, document, solution.model, inputs
        )
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))

    def _drift(
        self,
        follower: DriftFollower,
        reference: ColdReference,
        data: Measurements,
        fixed: Array,
        method: Method,
    ) -> _Solution:
        """Since the cold visit, against the cold model: never a step on what is in force."""
        config, spots, in_force = self._config, reference.spots, self._current.arm
        tracked = follower.take(data, in_force, self._fixed(reference, fixed))
        found, judged = tracked.found, tracked.judged
        if method == "lsq" and not follower.state.moved:
            names = config.drift_parameters or self._nominal.parameters.names
            found = identify_subset(spots, data, names, sigma_m=config.sigma_m)
            judged = judge_cycle(found, spots, in_force=in_force, sigma_m=config.sigma_m)
        model = model_document(found.arm) | {
            "parameters": list(self._nominal.parameters.names),
            "covariance": found.covariance.tolist(),
            "reference_mdh": reference.cell.arm.mdh.tolist(),
            "reference_stamp_ns": reference.data.middle_ns,
        }
        visited = spots.visited(data.q)
        document = cycle_document(found, judged, spots, self._nominal, method) | {
            "poses": {
                "visited": len(visited),
                "missing": [n for n in range(1, spots.poses + 1) if n not in visited],
            }
        }
        return _Solution(document, model, judged.verdict)

    def _fixed(self, reference: ColdReference, now: Array) -> FixedSphere | None:
        if not len(reference.fixed) or not len(now):
            return None
        return fixed_sphere(reference.fixed, now, self._config.sigma_m)

    def _calibration(self, data: Measurements, method: Method) -> _Solution:
        current = self._current
        judged = identify_and_hold_out(
            self._nominal,
            data,
            share=self._config.hold_out,
            seed=self._config.seed,
            method=method,
            in_force=current.arm if current.head.model is not None else None,
        )
        model = identified_model_document(judged.identification)
        return _Solution(identification_document(judged), model, judged.verdict)

    def _propose(
        self,
        kind: str,
        command: Command,
        wall_ns: int,
        method: str,
        verdict: Verdict,
        document: dict[str, Any],
        model: dict[str, Any],
        inputs: dict[str, NDArray[Any]],
    ) -> int:
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
