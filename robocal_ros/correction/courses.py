"""Trajectories that were put out, and what goes on when one is rejected.

A controller that rejects a goal goes on with what it has. So each trajectory knows what it took
the place of, until it is known to be accepted.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.blending import Commanded
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.memory import Memory
from robocal_ros.correction.starts import Beginning, Starts

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Left:
    """What was commanded when something else took its place.

    Attributes
    ----------
    goal, out : (n,) of the `Memory`: taught joints that were commanded last, and what was put out
        for the last target.
    """

    commanded: Commanded
    beginning: Beginning
    goal: Array
    out: Array

    def stopped(self, now_s: float) -> "Left":
        """The same, ended at an instant."""
        return replace(
            self,
            commanded=self.commanded.stopped(now_s),
            beginning=self.beginning.stopped(now_s),
        )


class Course:
    """A trajectory that was put out; told what becomes of it at the controller.

    ``now_s`` is the session's clock.
    """

    def __init__(self, courses: "Courses", before: "Course | None", at_once: bool) -> None:
        self._courses, self._before, self._at_once = courses, before, at_once
        self._rejected = False
        self.left: Left | None = None  # set when something else takes its place

    def begin(self, now_s: float) -> None:
        """It goes out now: one that begins at once begins now, not when it was corrected."""
        if self._at_once and self._courses.current is self:
            self._courses.begin(now_s)

    def accept(self) -> None:
        """The controller took it: there is no way back."""
        self._before = None

    def reject(self) -> None:
        """The controller did not take it: what it took the place of goes on there."""
        self._rejected = True
        back = self
        while back._rejected and back._before is not None:
            back = back._before
        if self._courses.current is self and back.left is not None:
            self._courses.go_back(back, back.left)

    def end(self, now_s: float) -> None:
        """It ended early: what was commanded then stays. Of no effect on what came after it."""
        if self._courses.current is self:
            self._courses.stop(now_s)
        elif self.left is not None:
            self.left = self.left.stopped(now_s)


class Courses:
    """Which trajectory was put out last.

    Attributes
    ----------
    current : None when something else was put out since: a target, or a stop.
    """

    def __init__(self, corrector: Corrector, starts: Starts, memory: Memory) -> None:
        self._corrector, self._starts, self._memory = corrector, starts, memory
        self.current: Course | None = None

    def left(self) -> Left:
        """What is commanded, before a trajectory takes its place."""
        goal, out = self._memory.goal.copy(), self._memory.out.copy()
        return Left(self._corrector.under_way, self._starts.beginning, goal, out)

    def take(self, left: Left, *, at_once: bool, may_be_rejected: bool) -> None:
        """A trajectory takes the place of what was ``left``; ``at_once``: when it is forwarded."""
        before = None
        if may_be_rejected:
            before = self.current or Course(self, None, False)
            before.left = left
        elif self.current is not None:
            self.current.left = left
        self.current = Course(self, before, at_once)

    def begin(self, now_s: float) -> None:
        """The current one begins now."""
        self._corrector.begin(now_s)
        self._starts.begin(now_s)

    def go_back(self, course: Course, left: Left) -> None:
        """What was left goes on."""
        self.current = course
        self._corrector.go_back(left.commanded)
        self._starts.go_back(left.beginning)
        self._memory.goal[:], self._memory.out[:] = left.goal, left.out

    def stop(self, now_s: float) -> None:
        """What is under way ends."""
        self.current = None
        self._corrector.stop(now_s)
        self._starts.stop(now_s)
