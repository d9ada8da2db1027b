"""What could be put out for a command: its joints, corrected on the way to a model."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.blending import (
    Commanded,
    blend_along,
    blend_rates,
    step_towards,
)
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.clamping import correction_between
from robocal_ros.correction.staged import StagedCorrection, StagedResult

Array = NDArray[np.float64]

PARTIAL = "only a part of the joints is commanded"
STEEP = "the correction changes too fast here"
STAGES = 4  # in use at a time: commands', readings', another goal's


@dataclass(frozen=True)
class Motion:
    """A command with all joints.

    Attributes
    ----------
    q : (m, n) taught joints; one point of a stream, or a trajectory's.
    velocity, acceleration : (m, n) or None.
    whole : whether all joints are commanded; the blend waits while they are not: it would move
        joints that are not in the commands, and the next whole command would make up for it in
        one step.
    before : (n,) what was put out before, or where a trajectory leads in from; NaN where that is
        not known.
    dt_s : (m,) time from there to each point, from the one before.
    room : (n,) it may begin as far from ``before``; None: there.
    """

    q: Array
    velocity: Array | None
    acceleration: Array | None
    whole: bool
    before: Array
    dt_s: Array
    room: Array | None = None

    def begin(self, first: Array) -> Array:
        """Where it may begin (n,), nearest to its first joints (n,); NaN as in ``before``."""
        if self.room is None:
            return self.before
        return np.clip(first, self.before - self.room, self.before + self.room)


@dataclass(frozen=True)
class Proposal:
    """Corrected joints and rates (m, n), and what would be commanded from then on."""

    result: StagedResult
    velocity: Array | None
    acceleration: Array | None
    commanded: Commanded
    waits: str


class Proposer:
    """Corrects motions on the way from a packed model to another."""

    def __init__(self, reference: Array, arm: SerialArm, config: CorrectionConfig) -> None:
        self._reference, self._arm, self._config = reference, arm, config
        self._rates = config.blend_rates(arm)
        self._stages: deque[tuple[Array, Array, StagedCorrection]] = deque(maxlen=STAGES)

    def stage(self, start: Array, end: Array) -> StagedCorrection:
        """The correction between two models."""
        for first, second, known in self._stages:
            if first is start and second is end:
                return known
        stage = correction_between(self._reference, start, end, self._arm, self._config)
        self._stages.append((start, end, stage))
        return stage

    def point(
        self, motion: Motion, commanded: Commanded, goal: Array, now_s: float, dt_s: float
    ) -> Proposal:
        """One point of a stream; the blend advances by ``dt_s``, at most by the longest step."""
        blend, begin = commanded.latest(now_s), commanded.latest(now_s).progress(now_s)
        if blend.end is not goal:
            blend, begin = Commanded(commanded.at(now_s), goal), 0.0
        if blend.start is goal:
            begin = 1.0
        stage, q, waits = self.stage(blend.start, goal), motion.q, ""
        if begin < 1.0 and motion.whole and dt_s > 0.0:
            dt = min(dt_s, self._config.longest_step_s)
            s, result = step_towards(stage, q, begin, self._rates, dt)
            waits = STEEP if s == begin else ""
        else:
            s, result = begin, stage.correct(q, np.array([begin]))
            waits = "" if begin == 1.0 or motion.whole else PARTIAL
        then = Commanded(goal if s >= 1.0 else blend.start, goal, s=np.array([s]))
        return self._with_rates(motion, stage, then.s, np.zeros(1), result, then, waits)

    def path(
        self,
        motion: Motion,
        commanded: Commanded,
        goal: Array,
        times_s: Array,
        now_s: float,
        starts_in_s: float,
        rests_s: float,
    ) -> Proposal:
        """A trajectory, from what is commanded when it begins; the blend runs along its time.

        It rests for ``rests_s`` from now on.
        """
        model = commanded.at(now_s + max(0.0, starts_in_s))
        stage, q, waits = self.stage(model, goal), motion.q, ""
        s = np.ones(len(q))
        if model is not goal:
            s = np.zeros(len(q))
            waits = "" if motion.whole else PARTIAL
            if motion.whole:
                s = blend_along(stage, q, times_s, rests_s - starts_in_s, self._rates)
        first = max(0.0, rests_s - starts_in_s)
        # until then: what is under way; a trajectory that still waits for its start is replaced
        before = replace(commanded.latest(now_s), before=None) if starts_in_s > 0.0 else None
        then = Commanded(
            model,
            goal,
            now_s + starts_in_s,
            np.append(first, np.maximum(times_s, first)),
            np.append(0.0, s),
            before,
        )
        result, speed = stage.correct(q, s), blend_rates(times_s, s)
        return self._with_rates(motion, stage, s, speed, result, then, waits)

    def _with_rates(
        self,
        motion: Motion,
        stage: StagedCorrection,
        s: Array,
        s_rate: Array,
        result: StagedResult,
        then: Commanded,
        waits: str,
    ) -> Proposal:
        if motion.velocity is None:
            return Proposal(result, None, None, then, waits)
        given = motion.acceleration
        bend = np.zeros_like(motion.q) if given is None else given
        velocity, acceleration = stage.rates(motion.q, motion.velocity, bend, s, s_rate, result)
        return Proposal(result, velocity, None if given is None else acceleration, then, waits)
