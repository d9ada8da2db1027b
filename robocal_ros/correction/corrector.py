"""Which model corrects the commands at every instant, and the corrected joints themselves."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.blending import ROUNDING, Commanded
from robocal_ros.correction.bounds import (
    CorrectionConfig,
    Policy,
    require_limits,
    require_solved,
    require_speeds,
    require_within,
)
from robocal_ros.correction.clamping import ClampedResult
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.correction.memory import Memory
from robocal_ros.correction.proposals import Motion, Proposal, Proposer
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.staged import StagedCorrection, StagedResult

Array = NDArray[np.float64]


class Corrector:
    """Corrects joints with the model that is wanted, or on the way to it.

    Attributes
    ----------
    reference : packed model of no correction.
    known : packed model that is wanted, or would be if the correction were on.
    held : how often a blend waited because a bound would have been exceeded.
    waits : why the blend waits now; empty when it does not.
    reduced : how many points were corrected in part, near a singularity or by a bound.
    clamped, passed : how many messages were corrected in part, or on the way to not at all, for
        what bound.
    figures : (3,) of the last joints put out, see `Memory`.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig, memory: Memory) -> None:
        self._arm = reference
        self._config = config
        self.reference = pack_model(reference)
        self._wanted = self.reference
        self.known = self.reference
        self._commanded = Commanded(self.reference, self.reference)
        self._proposer = Proposer(self.reference, reference, config)
        self.held = 0
        self.waits = ""
        self.reduced = 0
        self.clamped: Counter[Reason] = Counter()
        self.passed: Counter[Reason] = Counter()
        self.figures = memory.figures

    def want(self, arm: SerialArm, on: bool) -> None:
        """Head for a model and tool when ``on``, else for no correction."""
        actual = pack_model(arm)
        for known in (self.reference, self._wanted, self._commanded.end):
            if np.allclose(known, actual, rtol=0.0, atol=ROUNDING):
                actual = known  # a settled blend is told by identity
                break
        self.known = actual
        self._wanted = actual if on else self.reference

    @property
    def settled(self) -> bool:
        """True when the commands are corrected with the model that is wanted."""
        return self._commanded.start is self._commanded.end is self._wanted

    @property
    def idle(self) -> bool:
        """True when commands pass as they came."""
        return self.settled and self._wanted is self.reference

    def progress(self, now_s: float) -> float:
        """How far the blend under way is, 0 to 1; 1 when there is none."""
        blend = self._commanded.latest(now_s)
        return blend.progress(now_s) if blend.end is self._wanted else 0.0

    def stop(self, now_s: float) -> None:
        """Stay with the model of this instant: the trajectory under way ends."""
        self._commanded = self._commanded.stopped(now_s)

    # ---- what is commanded ----------------------------------------------------------------------

    def passing(self, now_s: float) -> bool:
        """True when commands pass as they came at an instant, and are to."""
        return self._commanded.at(now_s) is self._wanted is self.reference

    def model(self, now_s: float) -> Array:
        """The packed model in the commands at an instant."""
        return self._commanded.at(now_s)

    def go_on_from(self, model: Array, now_s: float) -> None:
        """What comes next goes on from a model: the robot shows that one."""
        if model is not self._commanded.at(now_s):
            self._commanded = Commanded(model, model)

    @property
    def under_way(self) -> Commanded:
        """The model in the commands, as a function of time."""
        return self._commanded

    def go_back(self, commanded: Commanded) -> None:
        """What was ``under_way`` once goes on."""
        self._commanded = commanded

    def begin(self, now_s: float) -> None:
        """The trajectory that was corrected last begins now."""
        self._commanded = replace(self._commanded, begin_s=now_s)

    def shifted(self, q: Array, model: Array) -> Array:
        """Joints (m, n), corrected with a packed model."""
        if model is self.reference:
            return q
        return self._proposer.stage(model, model).correct(q, np.ones(len(q))).q

    def commanded(self, now_s: float) -> StagedCorrection | None:
        """The correction in the commands at an instant, at blend 1; None when there is none."""
        return self.stage(self._commanded.at(now_s))

    def settled_on(self, now_s: float) -> Array | None:
        """The packed model in the commands from an instant on; None while it is to change."""
        return self._commanded.settled(now_s)

    def stage(self, model: Array) -> StagedCorrection | None:
        """The correction with a packed model; None for no correction."""
        return None if model is self.reference else self._proposer.stage(model, model)

    # ---- corrected joints -----------------------------------------------------------------------

    def pass_on(self, motion: Motion, now_s: float) -> None:
        """Nothing is added to a motion; it is held to the limits all the same."""
        require_limits(motion.q, self._arm)
        self._require_speeds(motion, motion.q, motion.velocity)
        self.stop(now_s)
        self.waits = ""
        self.figures[:] = 0.0

    def point(self, motion: Motion, now_s: float, pause_s: float) -> Proposal:
        """Correct one point of a stream, ``pause_s`` after the one before.

        Where a fault bars the way the blend waits.
        """

        def towards(goal: Array, dt_s: float) -> Proposal:
            proposal = self._proposer.point(motion, self._commanded, goal, now_s, dt_s)
            self._require(motion, proposal, goal)
            return proposal

        def step(goal: Array) -> Proposal:
            try:
                return towards(goal, pause_s)
            except RefusedError as fault:
                proposal = towards(goal, 0.0)
                self.held += 1
                return replace(proposal, waits=f"{fault.reason.value}: {fault.detail}")

        return self._take(motion, step)

    def path(
        self, motion: Motion, times_s: Array, now_s: float, starts_in_s: float, rests_s: float
    ) -> Proposal:
        """Correct a trajectory, from what is commanded when it begins; it blends after a rest."""

        def towards(goal: Array) -> Proposal:
            proposal = self._proposer.path(
                motion, self._commanded, goal, times_s, now_s, starts_in_s, rests_s
            )
            self._require(motion, proposal, goal)
            return proposal

        return self._take(motion, towards)

    def _take(self, motion: Motion, towards: Callable[[Array], Proposal]) -> Proposal:
        """What the policy makes of a motion; raises where that is a refusal."""
        goal, why = self._wanted, self._passes_for(motion)
        if why is not None:
            goal = self.reference
        try:
            proposal = towards(goal)
        except RefusedError as fault:
            too_fast = fault.reason is Reason.VELOCITY_LIMIT
            if self._config.policy is Policy.REFUSE or not too_fast or goal is self.reference:
                raise
            why, proposal = fault.reason, towards(self.reference)
        self._commanded, self.waits = proposal.commanded, proposal.waits
        result = proposal.result
        bound = result.reason if isinstance(result, ClampedResult) else None
        if why is not None and self._config.policy is Policy.PASS:
            self.passed[why] += 1
        elif (reason := why or bound) is not None:
            self.clamped[reason] += 1
        self._note(motion.q, result)
        return proposal

    def _passes_for(self, motion: Motion) -> Reason | None:
        """The bound for which a motion is not to be corrected at all; None: it is."""
        if self._config.policy is not Policy.PASS or self._wanted is self.reference:
            return None
        stage = self._proposer.stage(self._wanted, self._wanted)
        result = stage.correct(motion.q, np.ones(len(motion.q)))
        return result.reason if isinstance(result, ClampedResult) else None

    def _require(self, motion: Motion, proposal: Proposal, goal: Array) -> None:
        result = proposal.result
        require_limits(result.q, self._arm)
        require_solved(result)
        # The way back to no correction is never barred by the bounds of a correction.
        if self._config.policy is Policy.REFUSE and goal is not self.reference:
            require_within(result, self._config, self._arm)
        self._require_speeds(motion, result.q, proposal.velocity)

    def _require_speeds(self, motion: Motion, q: Array, velocity: Array | None) -> None:
        limits = self._config.velocity_limits
        if limits is None:
            return
        before = np.concatenate([motion.begin(q[0])[None], q[:-1]])
        mean = (q - before) / motion.dt_s[:, None]
        require_speeds(np.where(np.isfinite(mean), mean, 0.0), limits, self._arm)
        if velocity is not None:
            require_speeds(velocity, limits, self._arm)

    def _note(self, q: Array, result: StagedResult) -> None:
        self.reduced += int((~result.whole).sum())
        self.figures[:] = (
            result.arm.tcp_shift_m.max(),
            np.abs(result.q - q).max(),
            result.remaining_m.max(),
        )
