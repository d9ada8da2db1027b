"""Why an input of the joint correction is refused."""

from enum import StrEnum

from robocal_ros.ground.errors import Code, RobocalError


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
    OTHER_COMMANDER = "somebody else commands the robot"
    LEASED = "the robot is leased for a measurement"
    STOPPED = "stopped"
    NO_SPEED_LIMITS = "the robot has no speed limits"


_CODES = {
    Reason.JOINT_LIMIT: Code.LIMIT_EXCEEDED,
    Reason.VELOCITY_LIMIT: Code.LIMIT_EXCEEDED,
    Reason.TCP_BOUND: Code.LIMIT_EXCEEDED,
    Reason.JOINT_BOUND: Code.LIMIT_EXCEEDED,
    Reason.NOT_SOLVED: Code.LIMIT_EXCEEDED,
    Reason.TOOL_BOUND: Code.LIMIT_EXCEEDED,
    Reason.WRONG_ROBOT: Code.WRONG_ROBOT,
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
