"""A tip from touches of one point, recorded by the node while the robot stands at each."""

from dataclasses import replace

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import JointStream, StandstillRule
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import TOOL, Proposal
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.files import change_document
from robocal_ros.tool.judging import KnownTool, change_between
from robocal_ros.tool.run import ToolConfig, made_with
from robocal_ros.tool.touch_points import TouchFit, fit_four

STANDS = StandstillRule(after_s=0.0)  # up to the newest reading
SAME_RAD = float(np.radians(2.0))  # a touch from the same posture says nothing new


class TouchLog:
    """Touches of one point since the last tool that they gave, each the joints at rest (n,)."""

    def __init__(self, nominal: SerialArm, config: ToolConfig, software: str) -> None:
        self._nominal, self._config, self._software = nominal, config, software
        self._touches: list[Array] = []

    def add(self, command: Command, stream: JointStream, stamp_ns: int) -> Outcome:
        """Take a touch; one from a posture that was touched from already takes its place.

        Raises `NotStillError` while the robot moves; `TooFewSamplesError` without joint readings.
        """
        q = stream.resting(stamp_ns, STANDS) if stamp_ns else None
        if q is None:
            raise TooFewSamplesError("no joint states received: does the robot's driver publish?")
        apart = [old for old in self._touches if np.max(np.abs(old - q)) > SAME_RAD]
        words = "" if len(apart) == len(self._touches) else ", in place of one from this posture"
        self._touches = [*apart, q]
        return Outcome(command, Code.ACCEPT, f"touch {len(self._touches)} is taken{words}")

    def clear(self, command: Command) -> Outcome:
        """Forget all."""
        count, self._touches = len(self._touches), []
        return Outcome(command, Code.ACCEPT, f"{count} touches are forgotten")

    def solve(
        self,
        command: Command,
        history: CalibrationHistory,
        arm: SerialArm,
        in_force: KnownTool,
        thermal_revision: int,
        wall_ns: int,
    ) -> Outcome:
        """Find the tip with the model ``arm``, judge and propose it; the orientation stays.

        Raises `RobocalError` when the touches cannot answer; they are kept then.
        """
        fit = fit_four(arm.fk(np.array(self._touches).reshape(-1, arm.n)))
        T = frames.transform(in_force.T_flange_tool[:3, :3], fit.tip)
        covariance = np.zeros((5, 5))
        if in_force.covariance is not None:
            covariance[3:, 3:] = in_force.covariance[3:, 3:]
        covariance[:3, :3] = fit.covariance
        change = change_between(in_force.T_flange_tool, T)
        verdict = self._verdict(fit, T)
        document: Document = {
            "method": "touches",
            "touches": len(self._touches),
            "tcp_mm": (1e3 * fit.tip).tolist(),
            "sigma_mm": (1e3 * np.sqrt(np.diag(fit.covariance))).tolist(),
            "change": change_document(change),
            "misfit_mm": 1e3 * fit.rms_m,
            "verdict": verdict_document(verdict),
        }
        found = KnownTool(T, covariance)
        kept = history.propose(
            Proposal(
                kind=TOOL,
                model_hash=self._nominal.model_hash,
                based_on=history.head(TOOL).revision,
                cycle_id="",
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method="touches",
                code=verdict.code,
                reason=verdict.reason,
                document=document,
                model=found.document()
                | {"thermal_revision": thermal_revision, "made_with": made_with(self._config)},
                inputs={"q": np.array(self._touches)},
            )
        )
        count, self._touches = len(self._touches), []
        outcome = Outcome(command, verdict.code, verdict.reason, document, kept)
        return replace(outcome, samples=count)

    def _verdict(self, fit: TouchFit, T_flange_tool: Array) -> Verdict:
        """The touches' own, then how well the tip is known and how far it is from the taught."""
        limits, verdict = self._config.limits, fit.verdict
        sigma_m = float(np.sqrt(np.max(np.diag(fit.covariance))))
        away = change_between(self._config.T_flange_taught, T_flange_tool)
        if verdict.accept and sigma_m > limits.sigma_m:
            words = f"{verdict.reason}; the tip is known to {1e3 * sigma_m:.3f} mm only"
            return Verdict(Code.RESIDUAL_TOO_LARGE, f"{words}: touch from more sides")
        if verdict.accept and away.tip_m > limits.change_m:
            words = f"{verdict.reason}; the tip is {1e3 * away.tip_m:.2f} mm from the taught one"
            return Verdict(Code.LIMIT_EXCEEDED, f"{words} (allowed {1e3 * limits.change_m:g} mm)")
        return verdict
