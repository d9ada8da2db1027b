"""From the measurements of a command to a proposal in the history."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import Method, identify_and_hold_out
from robocal_ros.identification.documents import identification_document, identified_model_document
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.config import METHODS, ThermalConfig
from robocal_ros.thermal.cycle_verdict import judge_cycle
from robocal_ros.thermal.documents import cycle_document
from robocal_ros.thermal.drift_following import DriftFollower, Following
from robocal_ros.thermal.identification import identify_subset
from robocal_ros.thermal.in_force import InForce
from robocal_ros.thermal.keeping import CandidateStore
from robocal_ros.thermal.reference import ColdReference
from robocal_ros.thermal.steps import FixedSphere, fixed_sphere
from robocal_ros.thermal.windows import Beside

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Solution:
    """A judged identification as it is kept."""

    document: dict[str, Any]
    model: dict[str, Any]
    verdict: Verdict


class Proposer:
    """Solves what a command asks for, against what is in force, and keeps the result.

    Parameters
    ----------
    current : what is in force, followed by the session.
    following : follows the drift since the cold reference in force.
    """

    def __init__(
        self,
        nominal: SerialArm,
        config: ThermalConfig,
        current: InForce,
        following: Following,
        keeper: CandidateStore,
    ) -> None:
        self._nominal = nominal
        self._config = config
        self._current = current
        self._following = following
        self._keeper = keeper

    def method(self, command: Command) -> Method:
        """Tell the estimator that a command names, else the configured one.

        Raises
        ------
        InputError
            When there is no such estimator.
        """
        named = str(command.arguments.get("method") or self._config.method)
        for method in METHODS:
            if method == named:
                return method
        raise InputError(f"method '{named}' is not one of {', '.join(METHODS)}")

    def identify(
        self, command: Command, data: Measurements, beside: Beside, method: Method, wall_ns: int
    ) -> Outcome:
        """Identify a model from these measurements, judge it and propose it.

        Raises
        ------
        RobocalError
            When they cannot answer, or the history refuses.
        """
        reference, follower = self._current.reference, self._following.follower
        if reference is None or follower is None:
            return self._keep(command, self._calibration(data, method), method, data, {}, wall_ns)
        with follower.attempt():
            solution = self._drift(follower, reference, data, beside, method)
            kept = follower.kept(beside.temperature)
            return self._keep(command, solution, method, data, kept, wall_ns)

    def _keep(
        self,
        command: Command,
        solution: _Solution,
        method: Method,
        data: Measurements,
        beside: dict[str, NDArray[Any]],
        wall_ns: int,
    ) -> Outcome:
        verdict, inputs = solution.verdict, data.arrays() | beside
        cycle_id = str(command.arguments.get("cycle_id", ""))
        document = solution.document | {"stamp_ns": command.stamp_ns, "cycle_id": cycle_id}
        chosen = self._keeper.propose(
            THERMAL, command, wall_ns, method, verdict, document, solution.model, inputs
        )
        return Outcome(command, verdict.code, verdict.reason, document, chosen, samples=len(data))

    def _drift(
        self,
        follower: DriftFollower,
        reference: ColdReference,
        data: Measurements,
        beside: Beside,
        method: Method,
    ) -> _Solution:
        """Since the cold visit, against the cold model: never a step on what is in force."""
        config, spots, in_force = self._config, reference.spots, self._current.arm
        follower.read(beside.temperatures)
        tracked = follower.take(data, in_force, self._fixed(reference, beside.fixed))
        found, judged = tracked.found, tracked.judged
        if method == "lsq" and not follower.state.moved:
            names = config.drift_parameters or self._nominal.parameters.names
            found = identify_subset(spots, data, names, sigma_m=config.sigma_m)
            judged = judge_cycle(found, spots, in_force=in_force, sigma_m=config.sigma_m)
        model = model_document(found.arm) | {
            "parameters": list(self._nominal.parameters.names),
            "covariance": found.covariance.tolist(),
            "reference_mdh": reference.cell.arm.mdh.tolist(),
            "reference_stamp_ns": reference.data.middle_ns,
        }
        visited = spots.visited(data.q)
        document = cycle_document(found, judged, spots, self._nominal, method) | {
            "poses": {
                "visited": len(visited),
                "missing": [n for n in range(1, spots.poses + 1) if n not in visited],
            }
        }
        return _Solution(document, model, judged.verdict)

    def _fixed(self, reference: ColdReference, now: Array) -> FixedSphere | None:
        if not len(reference.fixed) or not len(now):
            return None
        return fixed_sphere(reference.fixed, now, self._config.sigma_m)

    def _calibration(self, data: Measurements, method: Method) -> _Solution:
        current = self._current
        judged = identify_and_hold_out(
            self._nominal,
            data,
            share=self._config.hold_out,
            seed=self._config.seed,
            method=method,
            in_force=current.arm if current.head.model is not None else None,
        )
        model = identified_model_document(judged.identification)
        return _Solution(identification_document(judged), model, judged.verdict)
