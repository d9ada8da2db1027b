"""Where a sensor sits according to the history, and the arm that its flange poses come from."""

from robocal_ros.ground.proposals import THERMAL, Head, hand_eye_kind
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.base import HistoryFollower
from robocal_ros.session.decisions import History


class HandEyeInForce(HistoryFollower):
    """What the history has in force for a sensor, as of the last look.

    Attributes
    ----------
    head, thermal : heads of this sensor's calibrations and of the thermal models.
    """

    def __init__(self, history: History, nominal: SerialArm, sensor_frame: str) -> None:
        self._nominal = nominal
        super().__init__(history, hand_eye_kind(sensor_frame))

    def _read(self) -> None:
        super()._read()
        self.thermal: Head = self._history.head(THERMAL)

    @property
    def arm(self) -> SerialArm:
        """The arm with the thermal model in force."""
        model = self.thermal.model
        return self._nominal if model is None else arm_of(model, self._nominal)
