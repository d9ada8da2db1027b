"""Which model corrects the commands at every instant, and the corrected joints themselves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction import blend_models, pack_model
from robocal_ros.core.joint_correction.blending import Commanded, blend_along, step_towards
from robocal_ros.core.joint_correction.bounds import (
    FADES_FROM,
    CorrectionConfig,
    require_limits,
    require_solved,
    require_within,
)
from robocal_ros.core.joint_correction.refusals import RefusedError
from robocal_ros.core.joint_correction.staged import StagedCorrection, StagedResult
from robocal_ros.core.kinematics import SerialArm

Array = NDArray[np.float64]


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
    held : how often a blend waited because a bound would have been exceeded.
    reduced : how many points were corrected in part, near a singularity.
    figures : of the last joints put out: error at the tool without correction, m; largest shift
        of a joint; error that remains, m.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm = reference
        self._config = config
        self._reference = pack_model(reference)
        self._wanted = self._reference
        self._commanded = Commanded(self._reference, self._reference)
        self._stage: tuple[Array, Array, StagedCorrection] | None = None
        self.held = 0
        self.reduced = 0
        self.figures = (0.0, 0.0, 0.0)

    def want(self, arm: SerialArm | None) -> None:
        """Head for another model and tool; None: for no correction."""
        wanted = self._reference if arm is None else pack_model(arm)
        for known in (self._reference, self._wanted, self._commanded.end):
            if np.array_equal(known, wanted):
                wanted = known  # a settled blend is told by identity
                break
        self._wanted = wanted

    @property
    def settled(self) -> bool:
        """True when the commands are corrected with the model that is wanted."""
        return self._commanded.start is self._commanded.end is self._wanted

    @property
    def idle(self) -> bool:
        """True when commands pass as they came."""
        return self.settled and self._wanted is self._reference

    def stop(self, now_s: float) -> None:
        """Stay with the model of this instant: the trajectory under way ends."""
        model = self._commanded.at(now_s)
        self._commanded = Commanded(model, model)

    def passes(self, q: Array, now_s: float) -> bool:
        """True when joints (m, n) need no correction; they are still held to the limits."""
        if self._commanded.at(now_s) is not self._reference or self._wanted is not self._reference:
            return False
        require_limits(q, self._arm)
        self.stop(now_s)
        self.figures = (0.0, 0.0, 0.0)
        return True

    def point(self, q: Array, now_s: float, pause_s: float, whole: bool = True) -> Corrected:
        """Correct one point (1, n) of a stream, ``pause_s`` after the one before.

        The blend waits while the stream is not ``whole``: it would move joints that are not in
        the commands, and the next whole command would make up for it in one step.
        """
        model = self._commanded.at(now_s)
        stage = self._stage_between(model, self._wanted)
        if model is self._wanted:
            s, result = 1.0, stage.correct(q, np.ones(1))
        else:
            dt = min(pause_s, self._config.longest_step_s) if whole else 0.0
            s, result = step_towards(stage, q, self._config.blend_rates(self._arm), dt)
            if s > 0.0 and self._fault(result) is not None:
                s, result = 0.0, stage.correct(q, np.zeros(1))
                self.held += 1
        self._require(result)
        end = self._wanted if s >= 1.0 else model if s <= 0.0 else None
        if end is None:
            end = blend_models(model, self._wanted, s)
        self._commanded = Commanded(end, end)
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
        latest = self._commanded
        if latest.before is not None and now_s < latest.begin_s:
            return latest.before
        return replace(latest, before=None)

    def commanded(self, now_s: float) -> StagedCorrection | None:
        """The correction in the commands at an instant, at blend 1; None when there is none."""
        model = self._commanded.at(now_s)
        return None if model is self._reference else self._stage_between(model, model)

    def _stage_between(self, start: Array, end: Array) -> StagedCorrection:
        if self._stage is None or self._stage[0] is not start or self._stage[1] is not end:
            stage = StagedCorrection(
                self._reference,
                start,
                end,
                FADES_FROM * self._config.thermal.of_joints(self._arm),
                self._config.tool.of_joints(self._arm),
            )
            self._stage = (start, end, stage)
        return self._stage[2]

    def _require(self, result: StagedResult) -> None:
        fault = self._fault(result)
        if fault is not None:
            raise fault

    def _fault(self, result: StagedResult) -> RefusedError | None:
        try:
            require_limits(result.q, self._arm)
            require_solved(result)
            # The way back to no correction is never barred by the bounds of a correction.
            if self._wanted is not self._reference:
                require_within(result, self._config, self._arm)
        except RefusedError as error:
            return error
        return None

    def _note(self, q: Array, result: StagedResult) -> None:
        self.reduced += int(np.sum(~result.whole))
        self.figures = (
            float(np.max(result.arm.tcp_shift_m)),
            float(np.max(np.abs(result.q - q))),
            float(np.max(result.remaining_m)),
        )
