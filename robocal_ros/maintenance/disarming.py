"""Whether the tool's driver may move the robot: from each doubt on, until a disarm is confirmed.

Safety case: nothing moves, and no fault is acknowledged, while another node might move the robot.
Only its own confirmation ends that doubt; a node that hangs gives none, and may be moving. One that
is not there at all can give none either, and would block the cell for ever. It is let go where it
cannot move anything: its service has not existed for `GONE_S`, with each disarm that was asked (a
node that starts is found sooner, and starts disarmed); this node has not armed it since the last
confirmed disarm, so that no motion that was asked for here can be under way, not the rest of a
dead node's trajectory either; and the robot rests at home (`Hands` looks).

A node that was started anew confirms too, but knows nothing of that trajectory. So a confirmation
tells what will be sent; what was sent before it is over where the measurement has been answered, or
was stopped from here, and the robot rests: until then it is in doubt as well.
"""

import numpy as np

from robocal_ros.ground.errors import ConflictError
from robocal_ros.maintenance.requests import DriverAnswer

AGAIN_S = 0.5
GONE_S = 5.0
SENT = "what the tool node sent may still be driven"


class Disarming:
    """What is known of the tool's driver; times of a steady clock.

    Attributes
    ----------
    engaged : it may be armed.
    armed : this node armed it, and what it was to move may still be under way.
    """

    def __init__(self) -> None:
        self.engaged = self.armed = False
        self._asked: set[int] = set()
        self._newest, self._heard = 0, False
        self._asked_s = -np.inf
        self._absent_from_s = np.inf

    def doubt(self) -> None:
        """Nobody knows; what is still to come of older disarms was carried out before this."""
        self.engaged, self._heard = True, False
        self._asked.clear()

    def asked(self, number: int, now_s: float) -> None:
        """A disarm was asked for; one before that nobody answered is the silence of a node."""
        if self._newest in self._asked:
            self._absent_from_s = np.inf
        self._asked.add(number)
        self._newest, self._heard, self._asked_s = number, False, now_s

    def answered(self, number: int, answer: DriverAnswer, now_s: float) -> None:
        """What came of a disarm; of anything else nothing follows."""
        if number not in self._asked:
            return
        self._asked.discard(number)
        self._heard |= number == self._newest
        if answer.done:
            self.engaged = False
        self._absent_from_s = min(self._absent_from_s, now_s) if answer.absent else np.inf

    def again(self, now_s: float) -> bool:
        """Whether to ask again."""
        return self.engaged and now_s >= self._asked_s + AGAIN_S

    @property
    def doubted(self) -> bool:
        """Whether it may move the robot, or the controller what it sent."""
        return self.engaged or self.armed

    @property
    def absent(self) -> bool:
        """Whether the driver is not there, as far as the newest answer tells."""
        return bool(self._absent_from_s < np.inf)

    def gone(self, now_s: float) -> bool:
        """Whether it cannot move a robot that rests at home."""
        return self._heard and not self.armed and now_s >= self._absent_from_s + GONE_S

    def words(self) -> str:
        """What a person can do."""
        if self.absent:
            return "the tool node is not there: start it, or leave 'laser' empty"
        return "the tool node is silent: wait for it, or start it anew"

    def require_disarmed(self) -> None:
        """Refuse, with a `ConflictError`, what needs a robot that nothing moves from there."""
        if self.engaged:
            words = "the tool node has not confirmed that it is disarmed"
            raise ConflictError(f"{words}; {self.words()}")
        if self.armed:
            raise ConflictError(f"{SENT}: wait until the robot rests")
