"""A joint trajectory controller's parameters, its goals, and how they end."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.trajectory import Trajectory

Array = NDArray[np.float64]


class GoalState(Enum):
    """Of an action's goal."""

    EXECUTING = "executing"
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


class GoalCode(Enum):
    """``error_code`` of control_msgs/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass(frozen=True, eq=False)
class Tolerances:
    """Position errors (n,) on the way and at the end, rad (prismatic: m); 0: no check.

    ``goal_time_s``: how long after its end a goal may be out of tolerance; 0: for ever.
    """

    path: Array
    goal: Array
    goal_time_s: float = 0.0


@dataclass(eq=False)
class TrajectoryGoal:
    """A goal of the action; ``tolerances`` None: the controller's own."""

    trajectory: Trajectory
    tolerances: Tolerances | None = None
    state: GoalState = GoalState.EXECUTING
    code: GoalCode = GoalCode.SUCCESSFUL
    text: str = ""

    def end(self, state: GoalState, code: GoalCode = GoalCode.SUCCESSFUL, text: str = "") -> None:
        """Over."""
        self.state, self.code, self.text = state, code, text


@dataclass(frozen=True)
class ControllerOptions:
    """Parameters of the controller, by its own names, with its defaults.

    Attributes
    ----------
    velocity_states : the drives report velocities (``state_interfaces``); mock hardware with
        positions alone does not.
    goal_time : with ``trajectory`` and ``goal`` of each joint (prismatic: m): `Tolerances`.
    """

    velocity_states: bool = True
    allow_partial_joints_goal: bool = False
    allow_nonzero_velocity_at_trajectory_end: bool = False
    interpolate_from_desired_state: bool = False
    trajectory: float = 0.0
    goal: float = 0.0
    goal_time: float = 0.0
