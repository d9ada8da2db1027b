"""What the session asks of whoever drives it, and what is answered."""

from dataclasses import dataclass

from robocal_ros.ground.errors import Code
from robocal_ros.motion.plan import JointPlan


@dataclass(frozen=True)
class DriverRequest:
    """Asked of the driver; ``number`` comes back with the answer."""

    number: int


@dataclass(frozen=True)
class BeginCycle(DriverRequest):
    """Open a thermal cycle (`ThermalSession`, `thermal_node` ``~/begin_cycle``)."""

    cycle_id: str


@dataclass(frozen=True)
class EndCycle(DriverRequest):
    """End it and identify the model; the answer carries the candidate."""

    cycle_id: str


@dataclass(frozen=True)
class Arm(DriverRequest):
    """Let the tool's driver move the robot (`ToolDriver.arm`, `tcf_node` ``~/arm``)."""


@dataclass(frozen=True)
class Disarm(DriverRequest):
    """Forbid it; a motion of its own is stopped at once."""


@dataclass(frozen=True)
class Measure(DriverRequest):
    """Measure the tool; ``mode`` of `tool.results`. Answered when the run has ended."""

    mode: str
    cycle_id: str


@dataclass(frozen=True)
class CancelMeasure(DriverRequest):
    """Break the open tool run off; its `Measure` is answered."""


@dataclass(frozen=True)
class Move(DriverRequest):
    """Send a plan to the controller; reported by `MaintenanceSession.reported`.

    ``worst_s``: until the robot is back at home at the latest, counted from now.
    """

    plan: JointPlan
    worst_s: float


@dataclass(frozen=True)
class Stop(DriverRequest):
    """Send a stop to the controller."""

    plan: JointPlan


@dataclass(frozen=True)
class HardStop(DriverRequest):
    """Stop a robot that does not obey its controller by other means, where there are any."""

    why: str


@dataclass(frozen=True)
class DriverAnswer:
    """What came of a request.

    Attributes
    ----------
    code : ACCEPT when done, else why not; a verdict where there is one.
    candidate_id : calibration in the history, else 0.
    missing : numbers, from 1, of the cold poses that were not measured.
    visited : number of those that were; None where that is not told.
    has_result : whether a measurement reached one.
    answer : of a quick check: "pass", "recalibrate", "cannot tell".
    deviation_mm, sigma_mm : of the tip from the tool in force.
    left_plan : the robot was stopped because it left its plan.
    absent : the request reached nobody, as the node is not there.
    """

    code: Code
    message: str = ""
    candidate_id: int = 0
    missing: tuple[int, ...] = ()
    has_result: bool = False
    answer: str = ""
    deviation_mm: float = 0.0
    sigma_mm: float = 0.0
    left_plan: bool = False
    absent: bool = False
    visited: int | None = None

    @property
    def done(self) -> bool:
        """Whether it did what was asked."""
        return self.code is Code.ACCEPT
