"""What the history has in force, followed while other processes decide in it too."""

from robocal_ros.ground.errors import ConflictError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.followed import HistoryFollower
from robocal_ros.session.history import History
from robocal_ros.thermal.reference import ColdReference, commissioned_of, holds_drift, reference_of

REFERENCE = "reference"


class InForce(HistoryFollower):
    """The thermal model and the cold reference in force, as of the last look.

    Attributes
    ----------
    head : head of the thermal models.
    reference, reference_id, reference_model : the cold reference, its calibration, and what is
        kept of it; or None.
    """

    def __init__(self, history: History, nominal: SerialArm) -> None:
        self._nominal = nominal
        super().__init__(history, THERMAL)

    def _read(self) -> None:
        super()._read()
        head = self._history.head(REFERENCE)
        reference = None if head.model is None else reference_of(head.model, self._nominal)
        self.reference: ColdReference | None = reference
        self.reference_id, self.reference_model = head.calibration_id, head.model

    @property
    def arm(self) -> SerialArm:
        """The arm with the model in force."""
        model = self.head.model
        return self._nominal if model is None else arm_of(model, self._nominal)

    @property
    def drifted(self) -> bool:
        """Whether the model in force holds a drift since a cold reference."""
        return holds_drift(self.head.model)

    @property
    def commissioned(self) -> SerialArm:
        """The arm without any drift: what is in force while none is, else what the reference keeps.

        Raises
        ------
        ConflictError
            When a drift is in force and no cold reference.
        """
        if not self.drifted:
            return self.arm
        if self.reference_model is None:
            raise ConflictError(
                "the model in force holds a drift, but there is no cold reference any more: roll "
                "the thermal model back to the one without it"
            )
        return commissioned_of(self.reference_model, self._nominal)

    @property
    def nominal(self) -> SerialArm:
        """The arm without any calibration."""
        return self._nominal
