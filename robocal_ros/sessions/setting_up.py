"""The set-up of a cell: where the sensor stands, and the cold reference."""

from dataclasses import replace
from typing import Any

from robocal_ros.core.assessment import Verdict, summarise
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import reference_document
from robocal_ros.core.errors import InputError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import Measurements
from robocal_ros.core.thermal.documents import sensor_document
from robocal_ros.core.thermal.process_documents import process_document
from robocal_ros.core.thermal.reference import capture_reference
from robocal_ros.core.thermal.sensor_calibration import (
    SensorMethod,
    calibrate_sensor,
    sensor_verdict,
)
from robocal_ros.sessions.drift_following import EXPECTED, default_process
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.expectation import expected_drift
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import REFERENCE, InForce
from robocal_ros.sessions.keeping import Keeper
from robocal_ros.sessions.thermal_config import ThermalConfig
from robocal_ros.sessions.windows import Beside

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
        keeper: Keeper,
    ) -> None:
        self._nominal, self._history, self._config = nominal, history, config
        self._current, self._keeper = current, keeper

    def capture(
        self, command: Command, data: Measurements, beside: Beside, wall_ns: int
    ) -> Outcome:
        """Make the cold reference of these measurements and bring it into force.

        Raises
        ------
        RobocalError
            When they cannot be one, or the history refuses.
        """
        reference = replace(
            capture_reference(self._current.arm, data),
            fixed=beside.fixed,
            temperature=beside.temperature,
        )
        rms_mm = summarise(reference.cell.residual(reference.used)).rms_m * 1e3
        message = (
            f"cold reference of {len(data)} measurements captured, residual {rms_mm:.3f} mm rms"
        )
        if reference.rejected:
            message += (
                f" of the {len(reference.used)} that fit; not fitting: "
                f"{', '.join(reference.rejected)}"
            )
        command, expected, told = self._expected(command)
        message += told
        document = {"residual_rms_mm": rms_mm, "rejected": list(reference.rejected)}
        verdict = Verdict(Code.ACCEPT, message)
        model = reference_document(reference) | {EXPECTED: expected}
        chosen = self._keeper.propose(
            REFERENCE, command, wall_ns, "lsq", verdict, document, model, data.arrays()
        )
        self._keeper.accept(chosen, command, "captured", wall_ns)
        return Outcome(command, Code.ACCEPT, message, calibration_id=chosen, samples=len(data))

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
