# SPDX-License-Identifier: Apache-2.0
"""A tip from touches of one point, recorded by the node while the robot stands at each."""

from dataclasses import dataclass

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import JointStream, StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.files import change_document
from robocal_ros.tool.judging import KnownTool, change_between
from robocal_ros.tool.run import ToolConfig
from robocal_ros.tool.touch_points import TouchFit, fit_four

STANDS = StandstillRule(after_s=0.0)  # up to the newest reading
SAME_RAD = float(np.radians(2.0))  # a touch from the same posture says nothing new


@dataclass(frozen=True, eq=False)
class TouchedTip:
    """A tip from touches at joints ``q`` (k, n), judged; kept as a run of the beams is."""

    q: Array
    found: KnownTool
    verdict: Verdict
    document: Document
    thermal_revision: int
    cycle_id: str = ""

    def arrays(self) -> dict[str, Array]:
        """What it was found from."""
        return {"q": self.q}


class TouchLog:
    """Touches of one point since the last tool that they gave, each the joints at rest (n,)."""

    def __init__(self, config: ToolConfig) -> None:
        self._config = config
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

    def solve(self, arm: SerialArm, in_force: KnownTool, thermal_revision: int) -> TouchedTip:
        """Find the tip with the model ``arm``, and judge it; the orientation stays."""
        q = np.array(self._touches).reshape(-1, arm.n)
        fit = fit_four(arm.fk(q))
        T = frames.transform(in_force.T_flange_tool[:3, :3], fit.tip)
        covariance = np.zeros((5, 5))
        if in_force.covariance is not None:
            covariance[3:, 3:] = in_force.covariance[3:, 3:]
        covariance[:3, :3] = fit.covariance
        verdict = self._verdict(fit, T)
        document: Document = {
            "method": "touches",
            "touches": len(q),
            "tcp_mm": (1e3 * fit.tip).tolist(),
            "sigma_mm": (1e3 * np.sqrt(np.diag(fit.covariance))).tolist(),
            "change": change_document(change_between(in_force.T_flange_tool, T)),
            "misfit_mm": 1e3 * fit.rms_m,
            "verdict": verdict_document(verdict),
        }
        return TouchedTip(q, KnownTool(T, covariance), verdict, document, thermal_revision)

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
