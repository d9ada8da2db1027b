"""An action server whose goals are ended from any callback."""

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle

from robocal_ros.ros.endpoints import EndpointNode

RESULT_KEPT_S = 60  # for callers that ask late


class DeferredActionServer(ActionServer):
    """A goal begins with ``goal.execute()`` and goes on until `end`: no coroutine waits for it.

    ``callbacks`` go to rclpy; ``handle_accepted_callback`` takes the place of an execute callback.
    """

    def __init__(self, node: EndpointNode, kind: Any, name: str, **callbacks: Any) -> None:
        self._host = node
        unused = kind.Result
        super().__init__(node, kind, name, unused, result_timeout=RESULT_KEPT_S, **callbacks)

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Let rclpy run a callback whose return ends the goal; without one the goal goes on."""
        if execute_callback is not None and self._host.executor is not None:
            super().notify_execute(goal_handle, execute_callback)

    def end(self, goal: ServerGoalHandle, status: int, result: Any) -> None:
        """End a goal with a status of `GoalStatus`; one that its caller did not cancel, aborted.

        Without an executor, when the process ends, nobody is told: the action goes anyway.
        """

        def finish(goal: ServerGoalHandle) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                goal.succeed()
            elif status == GoalStatus.STATUS_CANCELED and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return result

        self.notify_execute(goal, finish)
