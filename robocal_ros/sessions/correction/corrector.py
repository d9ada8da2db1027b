"""Which model corrects the commands at every instant, and the corrected joints themselves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction import pack_model
from robocal_ros.core.joint_correction.blending import (
    Commanded,
    blend_along,
    step_towards,
)
from robocal_ros.core.joint_correction.bounds import (
    FADES_FROM,
    CorrectionConfig,
    fault_of,
    require_limits,
)
from robocal_ros.core.joint_correction.refusals import RefusedError
from robocal_ros.core.joint_correction.staged import StagedCorrection, StagedResult
from robocal_ros.core.kinematics import SerialArm

Array = NDArray[np.float64]

PARTIAL = "only a part of the joints is commanded"


@dataclass(frozen=True)
class Corrected:
    """Corrected joints (m, n), at blends s (m,) of a stage."""

    stage: StagedCorrection
    s: Array
    result: StagedResult


class Corrector:
    """Corrects joints with the model that is wanted, or on the way to it.

    Attributes
    ----------
    reference : packed model of no correction.
    known : packed model that is wanted, or would be if the correction were on.
    held : how often a blend waited because a bound would have been exceeded.
    waits : why the blend waits now; empty when it does not.
    reduced : how many points were corrected in part, near a singularity.
    figures : of the last joints put out: error at the tool without correction, m; largest shift
        of a joint; error that remains, m.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm = reference
        self._config = config
        self.reference = pack_model(reference)
        self._wanted = self.reference
        self.known = self.reference
        self._commanded = Commanded(self.reference, self.reference)
        self._stage: tuple[Array, Array, StagedCorrection] | None = None
        self.held = 0
        self.waits = ""
        self.reduced = 0
        self.figures = (0.0, 0.0, 0.0)

    def want(self, arm: SerialArm, on: bool) -> None:
        """Head for a model and tool when ``on``, else for no correction."""
        actual = pack_model(arm)
        for known in (self.reference, self._wanted, self._commanded.end):
            if np.array_equal(known, actual):
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
        model = self._commanded.at(now_s)
        self._commanded = Commanded(model, model)

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

    def shifted(self, q: Array, model: Array) -> Array:
        """Joints (m, n), corrected with a packed model."""
        if model is self.reference:
            return q
        return self._stage_between(model, model).correct(q, np.ones(len(q))).q

    # ---- corrected joints -----------------------------------------------------------------------

    def passes(self, q: Array, now_s: float) -> bool:
        """True when joints (m, n) need no correction; they are still held to the limits."""
        if self._commanded.at(now_s) is not self.reference or self._wanted is not self.reference:
            return False
        require_limits(q, self._arm)
        self.stop(now_s)
        self.waits = ""
        self.figures = (0.0, 0.0, 0.0)
        return True

    def point(self, q: Array, now_s: float, pause_s: float, whole: bool = True) -> Corrected:
        """Correct one point (1, n) of a stream, ``pause_s`` after the one before.

        The blend waits while the stream is not ``whole``: it would move joints that are not in
        the commands, and the next whole command would make up for it in one step.
        """
        blend = self._commanded.latest(now_s)
        begin = blend.progress(now_s)
        if blend.end is not self._wanted:
            blend, begin = Commanded(self._commanded.at(now_s), self._wanted), 0.0
        stage = self._stage_between(blend.start, blend.end)
        waits = "" if whole or blend.start is blend.end else PARTIAL
        s, result = begin, stage.correct(q, np.array([begin]))
        if begin < 1.0 and whole:
            dt = min(pause_s, self._config.longest_step_s)
            s, there = step_towards(stage, q, begin, self._config.blend_rates(self._arm), dt)
            fault = self._fault(there) if s > begin else None
            if fault is not None:
                s, waits = begin, f"{fault.reason.value}: {fault.detail}"
                self.held += 1
            else:
                result = there
                waits = "the correction changes too fast here" if s == begin and dt > 0.0 else ""
        self._require(result)
        self.waits = waits
        settled = s >= 1.0
        start = blend.end if settled else blend.start
        self._commanded = Commanded(start, blend.end, s=np.array([s]))
        self._note(q, result)
        return Corrected(stage, np.array([s]), result)

    def path(
        self, q: Array, times_s: Array, now_s: float, starts_in_s: float, whole: bool = True
    ) -> Corrected:
        """Correct the points (m, n) of a trajectory, from what is commanded when it begins.

        The blend waits while the commands are not ``whole``, as in `point`.
        """
        model = self._commanded.at(now_s + max(0.0, starts_in_s))
        stage = self._stage_between(model, self._wanted)
        s = np.ones(len(q))
        if model is not self._wanted and not whole:
            s = np.zeros(len(q))
        elif model is not self._wanted:
            rates = self._config.blend_rates(self._arm)
            s = blend_along(stage, q, times_s, -starts_in_s, rates)
        result = stage.correct(q, s)
        self._require(result)
        self.waits = "" if whole or model is self._wanted else PARTIAL
        first = max(0.0, -starts_in_s)
        self._commanded = Commanded(
            model,
            self._wanted,
            now_s + starts_in_s,
            np.append(first, np.maximum(times_s, first)),
            np.append(0.0, s),
            self._running(now_s) if starts_in_s > 0.0 else None,
        )
        self._note(q, result)
        return Corrected(stage, s, result)

    def _running(self, now_s: float) -> Commanded:
        """What is under way: a trajectory that still waits for its start is replaced."""
        return replace(self._commanded.latest(now_s), before=None)

    def commanded(self, now_s: float) -> StagedCorrection | None:
        """The correction in the commands at an instant, at blend 1; None when there is none."""
        model = self._commanded.at(now_s)
        return None if model is self.reference else self._stage_between(model, model)

    def _stage_between(self, start: Array, end: Array) -> StagedCorrection:
        if self._stage is None or self._stage[0] is not start or self._stage[1] is not end:
            stage = StagedCorrection(
                self.reference,
                start,
                end,
                FADES_FROM * self._config.thermal.of_joints(self._arm),
                self._config.tool.of_joints(self._arm),
            )
            self._stage = (start, end, stage)
        return self._stage[2]

    def _fault(self, result: StagedResult) -> RefusedError | None:
        # The way back to no correction is never barred by the bounds of a correction.
        bounded = self._wanted is not self.reference
        return fault_of(result, self._config if bounded else None, self._arm)

    def _require(self, result: StagedResult) -> None:
        fault = self._fault(result)
        if fault is not None:
            raise fault

    def _note(self, q: Array, result: StagedResult) -> None:
        self.reduced += int(np.sum(~result.whole))
        self.figures = (
            float(np.max(result.arm.tcp_shift_m)),
            float(np.max(np.abs(result.q - q))),
            float(np.max(result.remaining_m)),
        )
