"""The set-up of a cell: where the sensor stands, and the cold reference."""

from dataclasses import replace
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import Verdict, summarise
from robocal_ros.ground.errors import Code, ConflictError, InputError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, Outcome
from robocal_ros.session.history import History
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.documents import sensor_document
from robocal_ros.thermal.drift_following import EXPECTED, default_process
from robocal_ros.thermal.expectation import expected_drift
from robocal_ros.thermal.in_force import REFERENCE, InForce
from robocal_ros.thermal.keeping import CandidateStore
from robocal_ros.thermal.process_documents import process_document
from robocal_ros.thermal.reference import (
    COMMISSIONED,
    ColdReference,
    capture_reference,
    reference_document,
)
from robocal_ros.thermal.sensor_calibration import SensorMethod, calibrate_sensor, sensor_verdict
from robocal_ros.thermal.warmth import drift_share, drift_size_m
from robocal_ros.thermal.windows import Beside

SENSOR = "sensor"
SENSOR_METHODS: tuple[SensorMethod, ...] = ("ml", "classic")


class SetUp:
    """Solves the steps of the set-up; what its verdict accepts is in force at once."""

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: ThermalConfig,
        current: InForce,
        keeper: CandidateStore,
    ) -> None:
        self._nominal, self._history, self._config = nominal, history, config
        self._current, self._keeper = current, keeper

    def capture(
        self, command: Command, data: Measurements, beside: Beside, wall_ns: int
    ) -> Outcome:
        """Make the cold reference of these measurements and bring it into force.

        The model in force stays: where it holds a drift that a cold robot has not, the forecast
        says so until a cycle is accepted.

        Raises
        ------
        RobocalError
            When they cannot be one, or the history refuses.
        """
        visit, told = self._visit(data)
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
        message += told + from_what
        document = {"residual_rms_mm": rms_mm, "rejected": list(reference.rejected)}
        verdict = Verdict(Code.ACCEPT, message)
        model = reference_document(reference) | {
            EXPECTED: expected,
            COMMISSIONED: self._current.commissioned.mdh.tolist(),
        }
        chosen = self._keeper.propose(
            REFERENCE, command, wall_ns, "lsq", verdict, document, model, data.arrays()
        )
        self._keeper.accept(chosen, command, "captured", wall_ns)
        return Outcome(command, Code.ACCEPT, message, calibration_id=chosen, samples=len(data))

    def _visit(self, data: Measurements) -> tuple[ColdReference, str]:
        """The measurements with the arm that they were made with, and words that tell which.

        A robot that has cooled is the commissioned one; after a knock of the sensor it is as warm
        as before, and with the cold arm its drift would be lost.
        """
        current = self._current
        visit, reference = capture_reference(current.commissioned, data), current.reference
        if reference is None or not current.drifted:
            return visit, ""
        sigma_m = self._config.sigma_m
        if (size_m := drift_size_m(visit, current.arm)) <= sigma_m:
            return visit, f"; the drift in force is within the noise ({size_m * 1e3:.3f} mm)"
        found = drift_share(reference, visit, current.arm, sigma_m)
        shown = f"{found.share:.0%} of the drift in force"
        if not found.told:
            raise TooFewSamplesError(
                "these poses do not tell whether the robot is cold or as warm as the model in "
                f"force: if it is cold, {self._back()} and capture again; if it is warm, measure "
                "the poses of the cold reference in three rounds, or capture when it is cold"
            )
        if found.between:
            raise ConflictError(
                f"the measurements show {shown}: the robot is neither cold nor as warm as the "
                f"model in force; capture when it has cooled, or {self._back()} if it is cold"
            )
        if found.warm:
            visit = capture_reference(current.arm, data)
            return visit, f"; the robot is as warm as the model in force ({shown})"
        return visit, (
            f"; the robot is cold ({shown}), and the model in force still holds that drift: "
            f"measure a cycle and accept its model, or {self._back()}"
        )

    def _back(self) -> str:
        """What rids the model in force of its drift."""
        nominal = np.array_equal(self._current.commissioned.mdh, self._nominal.mdh)
        which = "id 0, the nominal model" if nominal else "the id of the calibration before it"
        return f"roll the drift back (~/rollback, {which})"

    def _expected(self, command: Command) -> tuple[Command, dict[str, Any], str]:
        """The drift to expect from now on; the command carries it for replay."""
        default = default_process(self._nominal, self._config.sigma_m)
        if self._config.prior == "default":
            return command, process_document(default), ""
        if EXPECTED not in command.arguments:
            found, words = expected_drift(self._nominal, self._history)
            kept = process_document(found or default)
            arguments = {**command.arguments, EXPECTED: kept, "expected_from": words}
            command = replace(command, arguments=arguments)
        told = f"; expected drift: {command.arguments['expected_from']}"
        return command, command.arguments[EXPECTED], told

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
        chosen = self._keeper.propose(
            SENSOR, command, wall_ns, method, verdict, document, model, inputs
        )
        if verdict.accept:
            self._keeper.accept(chosen, command, "placed", wall_ns)
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))
