"""Where a command may begin: the robot is compared with what was put out last."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.blending import SPLINE_PEAK
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.memory import OUT, RESPONSE_S, Memory
from robocal_ros.correction.proposals import Motion
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.starting import (
    Follows,
    Sent,
    Whereabouts,
    follows,
    nearest_start,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = np.zeros(1)


@dataclass(frozen=True)
class Beginning:
    """What was put out last; see `Starts`."""

    sent: Sent | None
    started: bool
    bare: bool

    def stopped(self, now_s: float) -> "Beginning":
        """The same, ended at an instant."""
        sent = self.sent
        if sent is None or sent.stopped_s <= now_s:
            return self
        return replace(self, sent=replace(sent, stopped_s=now_s))


class Starts:
    """Lets a command begin only where no step can come of it.

    Attributes
    ----------
    started : whether anything was put out since the start or a mismatch.
    mismatch : why nothing is put out until `restart`; empty when nothing is wrong.
    """

    def __init__(
        self, arm: SerialArm, config: CorrectionConfig, corrector: Corrector, memory: Memory
    ) -> None:
        self._arm, self._config, self._corrector = arm, config, corrector
        self._memory = memory
        self._noted: Sent | None = None
        self._target: Index | None = None  # joints of the target that was put out last
        self.started = False
        self._bare = False  # the robot was seen without a correction, and none was put out since
        self.mismatch = ""

    @property
    def bare(self) -> bool:
        """Whether the robot was seen without a correction, and none was put out since."""
        return self._bare

    @property
    def _sent(self) -> Sent | None:
        """What was put out last; a target lies in the memory, where those after it come too."""
        index, memory = self._target, self._memory
        if index is None:
            return self._noted
        taught, corrected = memory.goal[None, index], memory.out[None, index]
        return Sent(index, float(memory.times[OUT]), _AT_ONCE, taught, corrected)

    @_sent.setter
    def _sent(self, sent: Sent | None) -> None:
        self._noted, self._target = sent, None

    def under_way(self, now_s: float) -> bool:
        """True while the robot may be moving by what was put out last."""
        return self._sent is not None and self._sent.live(now_s)

    def stop(self, now_s: float) -> None:
        """What was put out last ends."""
        self._sent = self.beginning.stopped(now_s).sent

    @property
    def beginning(self) -> Beginning:
        """What was put out last."""
        return Beginning(self._sent, self.started, self._bare)

    def go_back(self, beginning: Beginning) -> None:
        """What was put out last was rejected: what was before goes on."""
        self._sent, self.started, self._bare = beginning.sent, beginning.started, beginning.bare

    def begin(self, now_s: float) -> None:
        """The trajectory that was put out last begins now."""
        if self._sent is not None:
            self._sent = replace(self._sent, begin_s=now_s)

    def restart(self) -> None:
        """After a mismatch: the next command may begin where the robot stands."""
        if self.mismatch:
            self.mismatch, self.started, self._bare, self._sent = "", False, False, None

    def must_start(self, now_s: float) -> bool:
        """Whether a command must begin where the robot stands.

        Not when it is passed on as it came, to a robot that shows no correction any more: what
        should have taken it out may have been rejected.

        Raises
        ------
        RefusedError
            After a mismatch.
        """
        if self._config.shadow:  # nothing is added that could be a step
            self.started = True
            return False
        if self.mismatch:
            raise RefusedError(Reason.START_MISMATCH, self.mismatch)
        return not (self.started and self._bare and self._corrector.passing(now_s))

    def start_at(self, begins: Array, where: Whereabouts, now_s: float) -> None:
        """A command begins at once, at where it should be now or was lately, ``begins`` (r, n).

        The correction goes on from the one that the robot shows: that which is commanded, none,
        or (before the first command) that which is known. Only a commanded robot may lag.
        """
        where.require_fresh(np.arange(self._arm.n))
        near, commanded = self._config.start_near(self._arm), self._corrector.model(now_s)
        models = [
            commanded,
            self._corrector.reference,
            *([] if self.started else [self._corrector.known]),
        ]
        lag = where.travel if self.started and self.under_way(now_s) else 0.0
        starts = [
            (self._corrector.shifted(begins, m), near + lag * (m is commanded)) for m in models
        ]
        chosen = nearest_start(where.measured, starts)
        if chosen is None:
            far = int(np.argmax(np.abs(begins[0] - where.measured)))
            raise self._refuse_start(
                f"{self._arm.joint_names[far]} is at {where.measured[far]:.6f}, the command "
                f"begins at {begins[0, far]:.6f}"
            )
        self._corrector.go_on_from(models[chosen], now_s)
        self._bare = models[chosen] is self._corrector.reference

    def start_within(
        self, first: Array, index: Index, where: Whereabouts, now_s: float, lead_s: float
    ) -> None:
        """A command leads in ``lead_s`` to its ``first`` taught joints (n,).

        The correction goes on from the one that the robot shows; where that cannot be told, it
        must be small enough to be made within that time.
        """
        where.require_fresh(index)
        commanded, shows = self._corrector.model(now_s), self._shows(where, now_s)
        if shows is Follows.UNKNOWN:
            made = lead_s * self._config.blend_rates(self._arm)[index]
            for model in (commanded, self._corrector.known):
                shift = np.abs(self._corrector.shifted(first[None], model)[0] - first)[index]
                far = int(np.argmax(shift / made))
                if shift[far] > made[far]:
                    name = self._arm.joint_names[index[far]]
                    detail = f"a correction of {name} by {shift[far]:.6f} needs over {lead_s:g} s"
                    raise self._refuse_start(f"the robot is not where it was sent, and {detail}")
        if shows is Follows.NONE:
            self._corrector.go_on_from(self._corrector.reference, now_s)

    def _shows(self, where: Whereabouts, now_s: float) -> Follows:
        if self._sent is None:
            return Follows.UNKNOWN
        return follows(self._sent, where, self._config.start_near(self._arm), now_s)

    def leads_from(self, where: Whereabouts, index: Index, now_s: float) -> Array:
        """Where joints ``index`` lead in from (2, n): where the robot is, and its controller.

        These differ while the robot follows what was put out: it lags. NaN where it was not read
        lately, and for the other joints.
        """
        places = np.full((2, self._arm.n), np.nan)
        places[:, index] = np.where(where.age_s <= where.limit_s, where.measured, np.nan)[index]
        sent = self._sent
        if sent is not None and sent.live(now_s) and self._shows(where, now_s) is Follows.COMMANDED:
            place = np.full(self._arm.n, np.nan)
            place[sent.index] = sent.place(now_s)
            places[1] = np.where(np.isfinite(place), place, places[1])
        return places

    def led_in(self, motion: Motion, places: Array, lead_s: float, now_s: float) -> Motion:
        """A motion from one of two ``places`` (2, n); its first point lies ``lead_s`` ahead."""
        if lead_s <= 0.0:
            return motion
        if motion.velocity is not None and not self.under_way(now_s):
            lead_s /= SPLINE_PEAK  # the controller's way from rest is faster than its mean
        room = 0.5 * np.abs(places[1] - places[0]) + self._config.start_near(self._arm)
        dt_s = np.append(lead_s, motion.dt_s[1:])
        return replace(motion, before=places.mean(axis=0), dt_s=dt_s, room=room)

    def _refuse_start(self, detail: str) -> RefusedError:
        self.mismatch = f"{detail}; call ~/enable when it may begin there"
        return RefusedError(Reason.START_MISMATCH, self.mismatch)

    def note_target(self, index: Index) -> None:
        """Remember that the target in the memory, of joints (k,), was put out."""
        self.started, self._target = True, index
        if not np.array_equal(self._memory.goal[index], self._memory.out[index]):
            self._bare = False

    def note_sent(self, sent: Sent, now_s: float) -> None:
        """Remember what was put out."""
        self.started = True
        if not np.array_equal(sent.taught, sent.corrected):
            self._bare = False
        earlier = self._sent
        if len(sent.times_s) > 1 or sent.times_s[0] > 0.0:
            same = earlier is not None and np.array_equal(earlier.index, sent.index)
            if earlier is not None and same:
                sent = replace(sent, before=earlier.since(now_s - RESPONSE_S))
        self._sent = sent
