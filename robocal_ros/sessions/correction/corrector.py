"""Which model corrects the commands at every instant, and the corrected joints themselves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction import blend_models, pack_model
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
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.joint_correction.staged import StagedCorrection, StagedResult
from robocal_ros.core.joint_correction.starting import (
    RESPONSE_S,
    Follows,
    Sent,
    Whereabouts,
    follows,
    nearest_start,
)
from robocal_ros.core.kinematics import SerialArm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

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
    held : how often a blend waited because a bound would have been exceeded.
    waits : why the blend waits now; empty when it does not.
    mismatch : why nothing is put out until `restart`; empty when nothing is wrong.
    reduced : how many points were corrected in part, near a singularity.
    figures : of the last joints put out: error at the tool without correction, m; largest shift
        of a joint; error that remains, m.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm = reference
        self._config = config
        self._reference = pack_model(reference)
        self._wanted = self._reference
        self._known = self._reference
        self._started = False
        self._sent: Sent | None = None
        self._commanded = Commanded(self._reference, self._reference)
        self._stage: tuple[Array, Array, StagedCorrection] | None = None
        self.held = 0
        self.waits = ""
        self.mismatch = ""
        self.reduced = 0
        self.figures = (0.0, 0.0, 0.0)

    def want(self, arm: SerialArm | None, on: bool) -> None:
        """Head for a model and tool when ``on``, else for no correction; None: none is known."""
        actual = self._reference if arm is None else pack_model(arm)
        for known in (self._reference, self._wanted, self._commanded.end):
            if np.array_equal(known, actual):
                actual = known  # a settled blend is told by identity
                break
        self._known = actual
        self._wanted = actual if on else self._reference

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
        self._stay(now_s)
        if self._sent is not None and self._sent.stopped_s > now_s:
            self._sent = replace(self._sent, stopped_s=now_s)

    def _stay(self, now_s: float) -> None:
        model = self._commanded.at(now_s)
        self._commanded = Commanded(model, model)

    # ---- where a command may begin --------------------------------------------------------------

    def restart(self) -> None:
        """After a mismatch: the next command may begin where the robot stands."""
        if self.mismatch:
            self.mismatch, self._started, self._sent = "", False, None

    def must_start(self, now_s: float) -> bool:
        """Whether a command must begin where the robot stands: not when passed on as it came."""
        none = self._commanded.at(now_s) is self._wanted is self._reference
        return not (self._started and none)

    def start_at(self, begins: Array, where: Whereabouts, now_s: float) -> None:
        """A command begins at once, at where it should be now or was lately, ``begins`` (r, n).

        The correction goes on from the one that the robot shows: that which is commanded, none,
        or (before the first command) that which is known. Only a commanded robot may lag.
        """
        where.require_fresh(np.arange(self._arm.n))
        near, commanded = self._config.start_near(self._arm), self._commanded.at(now_s)
        models = [commanded, self._reference, *([] if self._started else [self._known])]
        lag = where.travel if self._started else 0.0
        starts = [(self._shifted(begins, m), near + lag * (m is commanded)) for m in models]
        chosen = nearest_start(where.measured, starts)
        if chosen is None:
            far = int(np.argmax(np.abs(begins[0] - where.measured)))
            raise self._refuse_start(
                f"{self._arm.joint_names[far]} is at {where.measured[far]:.6f}, the command "
                f"begins at {begins[0, far]:.6f}"
            )
        self._go_on_from(models[chosen], commanded)

    def start_within(
        self, first: Array, index: Index, where: Whereabouts, now_s: float, lead_s: float
    ) -> None:
        """A command leads in ``lead_s`` to its ``first`` taught joints (n,).

        The correction goes on from the one that the robot shows; where that cannot be told, it
        must be small enough to be made within that time.
        """
        where.require_known(index)
        commanded, shows = self._commanded.at(now_s), Follows.UNKNOWN
        near = self._config.start_near(self._arm)
        if self._sent is not None:
            shows = follows(self._sent, where, near, now_s)
        if shows is Follows.UNKNOWN:
            made = lead_s * self._config.blend_rates(self._arm)[index]
            for model in (commanded, self._known):
                shift = np.abs(self._shifted(first[None], model)[0] - first)[index]
                far = int(np.argmax(shift / made))
                if shift[far] > made[far]:
                    name = self._arm.joint_names[index[far]]
                    detail = f"a correction of {name} by {shift[far]:.6f} needs over {lead_s:g} s"
                    raise self._refuse_start(f"the robot is not where it was sent, and {detail}")
        self._go_on_from(self._reference if shows is Follows.NONE else commanded, commanded)

    def _go_on_from(self, model: Array, commanded: Array) -> None:
        if model is not commanded:
            self._commanded = Commanded(model, model)
        self._started = True

    def _shifted(self, q: Array, model: Array) -> Array:
        if model is self._reference:
            return q
        return self._stage_between(model, model).correct(q, np.ones(len(q))).q

    def _refuse_start(self, detail: str) -> RefusedError:
        self.mismatch = f"{detail}; call ~/enable when it may begin there"
        return RefusedError(Reason.START_MISMATCH, self.mismatch)

    def note_sent(self, sent: Sent, now_s: float) -> None:
        """Remember what was put out."""
        earlier = self._sent
        if len(sent.times_s) > 1 or sent.times_s[0] > 0.0:
            same = earlier is not None and np.array_equal(earlier.index, sent.index)
            if earlier is not None and same:
                sent = replace(sent, before=earlier.since(now_s - RESPONSE_S))
        self._sent = sent

    # ---- corrected joints -----------------------------------------------------------------------

    def passes(self, q: Array, now_s: float) -> bool:
        """True when joints (m, n) need no correction; they are still held to the limits."""
        if self._commanded.at(now_s) is not self._reference or self._wanted is not self._reference:
            return False
        require_limits(q, self._arm)
        self._stay(now_s)
        self.waits = ""
        self.figures = (0.0, 0.0, 0.0)
        return True

    def point(self, q: Array, now_s: float, pause_s: float, whole: bool = True) -> Corrected:
        """Correct one point (1, n) of a stream, ``pause_s`` after the one before.

        The blend waits while the stream is not ``whole``: it would move joints that are not in
        the commands, and the next whole command would make up for it in one step.
        """
        model = self._commanded.at(now_s)
        stage = self._stage_between(model, self._wanted)
        waits = "" if whole or model is self._wanted else PARTIAL
        if model is self._wanted:
            s, result = 1.0, stage.correct(q, np.ones(1))
        else:
            dt = min(pause_s, self._config.longest_step_s) if whole else 0.0
            s, result = step_towards(stage, q, self._config.blend_rates(self._arm), dt)
            fault = self._fault(result) if s > 0.0 else None
            if fault is not None:
                s, result = 0.0, stage.correct(q, np.zeros(1))
                waits = f"{fault.reason.value}: {fault.detail}"
                self.held += 1
            elif s == 0.0 and dt > 0.0:
                waits = "the correction changes too fast here"
        self._require(result)
        self.waits = waits
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

    def _fault(self, result: StagedResult) -> RefusedError | None:
        # The way back to no correction is never barred by the bounds of a correction.
        bounded = self._wanted is not self._reference
        return fault_of(result, self._config if bounded else None, self._arm)

    def _require(self, result: StagedResult) -> None:
        fault = self._fault(result)
        if fault is not None:
            raise fault

    def _note(self, q: Array, result: StagedResult) -> None:
        self.reduced += int((~result.whole).sum())
        self.figures = (
            float(result.arm.tcp_shift_m.max()),
            float(np.abs(result.q - q).max()),
            float(result.remaining_m.max()),
        )
