"""Which estimator answers for which target."""

from collections.abc import Callable, Mapping, Sequence

from robocal_ros.core.errors import InputError, TooFewSamplesError
from robocal_ros.core.hand_eye.result import HandEyeResult
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.hand_eye_data import IN_HAND, TO_HAND, TOPIC_OF, DataSet, HandEyeSample

Solver = Callable[[DataSet, Sequence[HandEyeSample], str, HandEyeConfig], HandEyeResult]

METHODS = ("best", "classic")
MOUNTS = (IN_HAND, TO_HAND)
WITHOUT_FILE = ("line", "camera")  # solved with the sensor's place
SOLVERS: Mapping[str, Solver] = {}


def require_known(kind: str, method: str, mount: str) -> None:
    """Refuse a target, a method or a mount that no estimator answers for.

    Raises
    ------
    InputError
        Naming those that there are.
    """
    for what, value, known in (
        ("target", kind, tuple(TOPIC_OF)),
        ("method", method, METHODS),
        ("mount", mount, MOUNTS),
    ):
        if value not in known:
            raise InputError(f"{what} '{value}' is none of {', '.join(known)}")
    if mount == TO_HAND and kind != "camera":
        raise InputError(
            f"a {kind} is seen by a sensor on the flange: a sensor that stands still is calibrated "
            "with a camera's target"
        )


def solved(
    data: DataSet, samples: Sequence[HandEyeSample], method: str, config: HandEyeConfig
) -> HandEyeResult:
    """Where the sensor sits.

    Raises
    ------
    RobocalError
        When the samples cannot answer.
    """
    require_known(data.kind, method, data.mount)
    if not samples:
        raise TooFewSamplesError("nothing was captured yet: capture the target from several poses")
    return SOLVERS[data.kind](data, samples, method, config)
