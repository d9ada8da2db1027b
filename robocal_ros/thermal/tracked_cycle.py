"""A measuring cycle through the tracker: what the robot's parameters are now, and the verdict."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Judgement, Verdict
from robocal_ros.estimation.estimation import describe, observability
from robocal_ros.ground.errors import Code, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.cycle_verdict import conclude
from robocal_ros.thermal.identification import FEWEST_POSES, CycleDrift
from robocal_ros.thermal.steps import FixedSphere, possible_causes, step_words
from robocal_ros.thermal.tracking import DriftState, DriftTracker, Innovation

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackedCycle:
    """A cycle that the tracker took or refused.

    Attributes
    ----------
    found : the drift after the cycle; before it where the cycle was refused.
    judged : figures and verdict; each pose is forecast from all earlier cycles and the other poses.
    innovation : what the cycle brought against what was expected.
    """

    found: CycleDrift
    judged: Judgement
    innovation: Innovation


def track_cycle(
    tracker: DriftTracker,
    warm: Measurements,
    time_s: float,
    *,
    in_force: SerialArm,
    fixed: FixedSphere | None = None,
    doubt_s: float | None = None,
) -> TrackedCycle:
    """Update the tracker with a cycle and judge the model that follows from it.

    A cycle that the drift since the last one cannot explain, or during which a sphere that is
    fixed in the cell (``fixed``) moved, leaves the tracker as it was, and is refused as
    SENSOR_OR_ROBOT_MOVED with what it may be. ``doubt_s``: see `DriftTracker.take`.

    Raises
    ------
    InputError
        When a sample has no cold counterpart.
    TooFewSamplesError
        With fewer than two poses.
    StaleError
        When the cycle is older than the last one.
    """
    spots = tracker.spots
    warm = spots.average(warm, tracker.sigma_m)
    if len(warm) < FEWEST_POSES:
        raise TooFewSamplesError("one pose cannot show a drift: measure at least five")
    last = tracker.state
    innovation = tracker.take(warm, time_s, doubt_s)
    taken, tracker.state = tracker.state, last
    before = tracker.at(innovation.time_s)
    moved = not innovation.applied or (fixed is not None and fixed.moved)
    if not moved:
        tracker.state = taken
    miss, spread, drifts = _left_out(tracker, before, warm, innovation)
    found = _found(tracker, warm, time_s, innovation, miss, spread)
    arm = spots.cell.arm
    A = spots.rows(warm.q, spots.target[spots.match(warm)])[0]
    own = drifts - arm.parameters.read(in_force.mdh - arm.mdh)
    judged = conclude(
        found,
        spots,
        warm,
        in_force,
        current=np.linalg.norm(miss + np.einsum("mik,mk->mi", A, own), axis=1),
        after=np.linalg.norm(miss, axis=1),
        spread=spread,
        usable=innovation.kept,
    )
    if moved:
        judged = replace(judged, verdict=_refusal(tracker, warm, innovation, fixed))
    return TrackedCycle(found, judged, innovation)


def _found(
    tracker: DriftTracker,
    warm: Measurements,
    time_s: float,
    innovation: Innovation,
    miss: Array,
    spread: Array,
) -> CycleDrift:
    spots, k = tracker.spots, tracker.count
    arm, (drift, covariance) = spots.cell.arm, tracker.drift(time_s)
    kept = warm.take(innovation.kept)
    rows = spots.rows(kept.q, spots.target[spots.match(kept)])[0]
    seen = observability(rows.reshape(-1, k))
    chosen = arm.parameters
    sigma = np.full(len(warm), tracker.sigma_m) if warm.sigma is None else warm.sigma
    return CycleDrift(
        drift=drift,
        covariance=covariance,
        prior_covariance=tracker.expected_drift(),
        arm=arm.with_mdh(chosen.add(arm.mdh, drift)),
        warm=warm,
        left_out=miss,
        left_out_sigma=spread,
        rejected=~innovation.kept,
        noise_m=float(np.sqrt(np.mean(sigma**2))),
        seen=seen,
        unobservable=tuple(describe(c, chosen.names, chosen.to_display) for c in seen.null.T),
    )


def _left_out(
    tracker: DriftTracker, before: DriftState, warm: Measurements, innovation: Innovation
) -> tuple[Array, Array, Array]:
    """Error (m, 3) at each pose of what all else says, its rms length (m,), and drifts (m, k).

    All else: the earlier cycles and the other poses of this one that agree. Cold visit and set-up
    are estimated along, so that model in force and candidate differ by the drift alone.
    """
    _, H, _ = tracker.observation(warm, before.time_s)
    D = tracker.drift_rows(before.time_s)
    v, S, k, count = innovation.deviation, innovation.covariance, tracker.count, len(warm)
    forecast, PH = D @ before.mean, D @ before.covariance @ H.T
    kept = np.repeat(innovation.kept, 3)
    miss, spread, drifts = np.empty((count, 3)), np.empty(count), np.empty((count, k))
    for i in range(count):
        own, others = slice(3 * i, 3 * i + 3), kept.copy()
        others[own] = False
        across = S[others, own]
        gain = np.linalg.solve(S[np.ix_(others, others)], np.column_stack([v[others], across]))
        miss[i] = v[own] - across.T @ gain[:, 0]
        spread[i] = np.sqrt(np.trace(S[own, own] - across.T @ gain[:, 1:]))
        drifts[i] = forecast + PH[:, others] @ gain[:, 0]
    return miss, spread, drifts


def _refusal(
    tracker: DriftTracker, warm: Measurements, innovation: Innovation, fixed: FixedSphere | None
) -> Verdict:
    rms_mm, expected_mm = (
        1e3 * float(np.sqrt(3.0 * np.mean(square)))
        for square in (innovation.deviation**2, np.diag(innovation.covariance))
    )
    causes = possible_causes(tracker.spots, warm, innovation.deviation, innovation.covariance)
    return Verdict(
        Code.SENSOR_OR_ROBOT_MOVED,
        f"the measured positions are {rms_mm:.2f} mm rms off, where drift and noise explain "
        f"{expected_mm:.2f} mm; the model stays as it was; {step_words(causes, fixed)}",
    )
