"""Joint states, un-corrected with what is being commanded."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.samples import TAUGHT
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.incoming import READING, CorrectionGuard, JointBook
from robocal_ros.correction.inputs import JointCommand

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Readings:
    """From corrected joints to taught ones.

    Attributes
    ----------
    whole : the last ones taken here that had all of the arm's joints; None in shadow mode.
    """

    def __init__(
        self, joints: JointBook, guard: CorrectionGuard, corrector: Corrector, shadow: bool
    ) -> None:
        self._joints, self._guard, self._corrector = joints, guard, corrector
        self._shadow = shadow
        self.whole: JointCommand | None = None

    def take(self, state: JointCommand, now_s: float, age_s: float) -> JointCommand:
        """Remember readings that are ``age_s`` old, and un-correct them."""
        self._guard.require_order(READING, state.stamp_ns, state.mark, now_s, state.names)
        index, place = self._joints.read(state, now_s, age_s)
        self._guard.accept_order(READING, state.stamp_ns, now_s, state.names)
        taught, position, velocity = self._un_corrected(state, index, place, now_s)
        self._joints.taught[:] = taught
        if len(index) == self._joints.count and not self._shadow:
            self.whole = state
        return replace(state, position=position, velocity=velocity, mark=TAUGHT)

    def taught(
        self, names: tuple[str, ...], position: Array, velocity: Array | None, now_s: float
    ) -> tuple[Array, Array | None]:
        """Un-correct joints as `take` does, remembering nothing; see `CorrectionSession.taught`."""
        state = JointCommand(names, position, velocity)
        index, place = self._joints.find(state)
        return self._un_corrected(state, index, place, now_s)[1:]

    def _un_corrected(
        self, state: JointCommand, index: Index, place: Index, now_s: float
    ) -> tuple[Array, Array, Array | None]:
        """All taught joints (n,), and the state's positions and velocities, un-corrected."""
        measured = self._joints.measured.copy()
        measured[index] = state.position[place]
        stage = None if self._shadow else self._corrector.commanded(now_s)
        if stage is None:
            return measured, state.position, state.velocity
        position, velocity = state.position.copy(), state.velocity
        if velocity is None or not len(place):
            taught = stage.uncorrect(measured[None], np.ones(1))
        else:
            velocity = velocity.copy()
            taught, speed = stage.taught(
                measured[None], self._joints.spread(velocity[None, place], index)
            )
            velocity[place] = speed[0, index]
        position[place] = taught[0, index]
        return taught[0], position, velocity

    def offset(self, now_s: float) -> Array:
        """What the commands add to the taught joints now (n,), where the robot was read last."""
        stage, measured = self._corrector.commanded(now_s), self._joints.measured
        if stage is None:
            return np.zeros(self._joints.count)
        if self._shadow:  # the robot stands where it was taught
            return np.asarray(stage.correct(measured[None], np.ones(1)).q[0] - measured)
        return np.asarray(measured - stage.uncorrect(measured[None], np.ones(1))[0])
