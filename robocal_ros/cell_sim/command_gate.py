"""What comes between a robot's commands and its controller: faults of the way, and its speed."""

from collections.abc import Callable

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.cell_sim.joint_motion import JointMotion
from robocal_ros.cell_sim.trajectory import Trajectory
from robocal_ros.cell_sim.trajectory_goal import TrajectoryGoal
from robocal_ros.ground.errors import InputError


class CommandGate:
    """Passes trajectories and goals on to a motion, as the faults let them.

    ``begun`` is called when one has been taken.

    Attributes
    ----------
    scale : speed scaling that was asked for; 1 without.
    """

    def __init__(
        self, motion: JointMotion, faults: Faults, draws: Draws, begun: Callable[[], None]
    ) -> None:
        self._motion, self._faults, self._draws, self._begun = motion, faults, draws, begun
        self.scale = 1.0
        self._late: list[tuple[float, Trajectory | TrajectoryGoal]] = []
        self._messages = 0
        self.fault_began(0.0)

    def fault_began(self, now_s: float) -> None:
        """Another fault is in force from now on, or none."""
        self._lost, self._since_s = 0, now_s

    def require_taken(self, trajectory: Trajectory, now_s: float) -> None:
        """Raise where a trajectory is rejected.

        Raises
        ------
        InputError
            With the controller's reason, or with that of a fault.
        """
        if "commands_rejected" in self._faults:
            raise InputError("rejected: simulated fault commands_rejected")
        self._motion.controller.require_valid(trajectory, now_s)

    def take(self, given: Trajectory | TrajectoryGoal, now_s: float) -> None:
        """Pass one on, lose it, or let it wait.

        Raises
        ------
        InputError
            When it is rejected; what runs goes on.
        """
        goal = None if isinstance(given, Trajectory) else given
        self.require_taken(given if isinstance(given, Trajectory) else given.trajectory, now_s)
        if self._loses(goal is None, now_s):
            if goal is not None:
                self._motion.controller.accept(goal, now_s, lost=True)
        elif "commands_late" in self._faults:
            self._late.append((now_s + self._faults.size("commands_late"), given))
        else:
            self._motion.take(now_s, given)
            self._begun()

    def pass_time(self, now_s: float, to_s: float) -> float:
        """Pass on what has waited until now, set the speed; up to when nothing changes."""
        for due_s, given in [waiting for waiting in self._late if waiting[0] <= now_s]:
            self._late.remove((due_s, given))
            try:
                self._motion.take(now_s, given)
                self._begun()
            except InputError:
                pass  # ended in the past by now: dropped, as a controller drops it
        scale, stop_s = self.scale, self._faults.size("protective_stop")
        if "speed_scaling" in self._faults:
            scale *= self._faults.size("speed_scaling")
        if now_s < self._since_s + stop_s:
            scale, to_s = 0.0, min(to_s, self._since_s + stop_s)
        self._motion.controller.scale = scale
        return min([to_s, *(due_s for due_s, _ in self._late)])

    def _loses(self, of_topic: bool, now_s: float) -> bool:
        """Whether one is lost: on the topic by chance, else where it replaces a motion."""
        faults = self._faults
        if "commands_lossy" in faults and of_topic:
            self._messages += 1
            rng = self._draws.of(Stream.LOST_COMMANDS, self._messages)
            return bool(rng.random() < faults.size("commands_lossy"))
        if self._lost < faults.size("commands_lost") and now_s < self._motion.end_s:
            self._lost += 1
            return True
        return False
