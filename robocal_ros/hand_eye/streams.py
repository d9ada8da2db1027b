"""Streams of poses on two clocks: the time offset between them, then the camera's place.

The offset is first where the angular speeds of both streams correlate best, which needs no
placement; then it is one more unknown of maximum likelihood (Furrer et al. 2017, "Evaluation of
combined time-offset estimation and hand-eye calibration on robotic datasets").
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.hand_eye.camera import CameraSettings, CheckPairs, calibrate_camera, require_sound
from robocal_ros.hand_eye.camera_fit import GivenNoise, PairFit, fit_pairs
from robocal_ros.hand_eye.camera_model import Mount, PosePairs, Shared, differences, predicted
from robocal_ros.hand_eye.result import HandEyeResult

Array = NDArray[np.float64]

FEWEST_POSES = 20
SPAN_S = 0.25  # over which a turn is taken: noise of single poses must not drown it
STEP_S = 0.01
LEAST_OVERLAP = 0.5  # of the shorter stream
LEAST_CORRELATION = 0.6
CLOCK_JUMP_NS = 1_000_000_000
LONGEST_GAP = 5.0  # usual periods between two robot poses that are interpolated
_FREE_S = 0.5  # prior sigma of what is left of the offset
_CLOSE_S = 1e-6
_ROUNDS = 12
_ALONE = "no robot pose at its time"


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Poses T (n, 4, 4) at times (n,), s, that increase; ``names`` (n,) of the samples."""

    time_s: Array
    T: Array
    names: tuple[str, ...]

    @property
    def period_s(self) -> float:
        """Usual time between two poses."""
        return float(np.median(np.diff(self.time_s)))

    def at(self, time_s: Array) -> Array:
        """Poses (m, 4, 4), interpolated along the shortest turn; held beyond both ends."""
        t = np.clip(time_s, self.time_s[0], self.time_s[-1])
        i = np.clip(np.searchsorted(self.time_s, t, side="right") - 1, 0, len(self.time_s) - 2)
        share = (t - self.time_s[i]) / (self.time_s[i + 1] - self.time_s[i])
        first, second = self.T[i], self.T[i + 1]
        R = first[:, :3, :3]
        turn = frames.log_rotation(R.swapaxes(1, 2) @ second[:, :3, :3])
        place = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
        return frames.transform(R @ frames.exp_rotation(share[:, None] * turn), place)

    def covers(self, time_s: Array) -> NDArray[np.bool_]:
        """Which times (m,) lie between two poses that follow each other closely."""
        i = np.clip(np.searchsorted(self.time_s, time_s, side="right"), 1, len(self.time_s) - 1)
        close = np.diff(self.time_s)[i - 1] <= LONGEST_GAP * self.period_s
        return np.asarray(close & (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1]))


def stream_of(stamp_ns: NDArray[np.int64], T: Array, names: tuple[str, ...], origin_ns: int,
              what: str) -> PoseStream:  # fmt: skip
    """A stream from stamps (n,), times counted from ``origin_ns``.

    Poses that came late are put in order, repeated stamps count once.

    Raises `InputError` when stamps go back by more than a second; `TooFewSamplesError`: fewer than
    20 poses.
    """
    back = -np.diff(stamp_ns)
    if len(back) and back.max() > CLOCK_JUMP_NS:
        row = int(np.argmax(back)) + 1
        raise InputError(
            f"the stamps of the {what} poses go back by {back.max() * 1e-9:.1f} s at sample "
            f"{names[row]}: give one run, on one clock"
        )
    stamps, first = np.unique(stamp_ns, return_index=True)
    if len(stamps) < FEWEST_POSES:
        raise TooFewSamplesError(
            f"{len(stamps)} {what} poses are no stream (at least {FEWEST_POSES})"
        )
    time_s = np.asarray((stamps - origin_ns) * 1e-9, dtype=np.float64)
    return PoseStream(time_s, T[first], tuple(names[i] for i in first))


def coarse_offset(robot: PoseStream, camera: PoseStream) -> float:
    """What to add to the camera's stamps, s, so that both streams turn at the same times.

    Raises `InputError` when the angular speeds nowhere correlate.
    """
    a, b = _turns(robot), _turns(camera)
    here, there = np.ones(len(a)), np.ones(len(b))
    a, b = a - a.mean(), b - b.mean()
    together = _correlate(here, there)
    scale = np.sqrt(np.maximum(_correlate(a**2, there) * _correlate(here, b**2), 0.0))
    enough = together >= LEAST_OVERLAP * min(len(a), len(b))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(enough & (scale > 0.0), _correlate(a, b) / scale, -1.0)
    best = int(np.argmax(value))
    if value[best] < LEAST_CORRELATION:
        raise InputError(
            f"the angular speeds of robot and camera nowhere correlate (at best "
            f"{value[best]:.2f}): are both streams of one run, and did the robot turn?"
        )
    lag = best - (len(b) - 1) + _peak(value[max(best - 1, 0) : best + 2])
    return float(robot.time_s[0] - camera.time_s[0] + lag * STEP_S)


def _peak(value: Array) -> float:
    """Where a parabola through the best value and its neighbours is highest, in steps from it."""
    if len(value) < 3 or np.any(value <= -1.0):
        return 0.0
    curve = float(value[0] - 2.0 * value[1] + value[2])
    return 0.0 if curve >= 0.0 else float(0.5 * (value[0] - value[2]) / curve)


def _turns(stream: PoseStream) -> Array:
    """Angles turned within `SPAN_S`, every `STEP_S`: no frame's choice changes them."""
    grid = np.arange(stream.time_s[0], stream.time_s[-1] - SPAN_S, STEP_S)
    R = stream.at(grid)[:, :3, :3].swapaxes(1, 2) @ stream.at(grid + SPAN_S)[:, :3, :3]
    return np.asarray(np.linalg.norm(frames.log_rotation(R), axis=1))


def _correlate(a: Array, b: Array) -> Array:
    """Sums of products at all lags (len(a) + len(b) - 1,)."""
    from scipy.signal import correlate

    return np.asarray(correlate(a, b, method="fft"))


def pairs_at(
    robot: PoseStream, camera: PoseStream, offset_s: float, mount: Mount
) -> tuple[PosePairs, tuple[str, ...]]:
    """Camera poses with the robot's at their times; names of those that have none.

    Raises `TooFewSamplesError` when the streams hardly overlap.
    """
    time = camera.time_s + offset_s
    there = robot.covers(time)
    if int(there.sum()) < FEWEST_POSES:
        raise TooFewSamplesError(
            f"{int(there.sum())} of {len(time)} camera poses lie within the robot's stream at an "
            f"offset of {offset_s:.3f} s: record both for longer"
        )
    names = np.array(camera.names)
    pairs = PosePairs(
        T_base_flange=robot.at(time[there]),
        T_camera_board=camera.T[there],
        names=tuple(names[there].tolist()),
        mount=mount,
        time_s=camera.time_s[there],
    )
    return pairs, tuple(names[~there].tolist())


def _with_offset(robot: PoseStream, pairs: PosePairs, fit: PairFit, offset_s: float) -> PosePairs:
    """Pairs with what is left of the offset as an error common to all."""
    time = pairs.time_s
    if time is None:
        raise ValueError("pairs of a stream have times")
    half = 0.5 * max(robot.period_s, STEP_S)
    later, sooner = (
        predicted(replace(pairs, T_base_flange=robot.at(time + offset_s + h)), fit.at)
        for h in (half, -half)
    )
    motion = differences(later, replace(pairs, T_camera_board=sooner)) / (2.0 * half)
    return replace(pairs, shared=Shared(-motion[:, :, None], np.array([[_FREE_S**2]])))


@dataclass(frozen=True, eq=False)
class StreamPairs:
    """Paired streams: ``left_out`` names the camera poses without one of the robot."""

    pairs: PosePairs
    offset_s: float
    sigma_s: float
    left_out: tuple[str, ...]


def pair_streams(
    robot: PoseStream, camera: PoseStream, mount: Mount = "in-hand",
    given: GivenNoise | None = None,
) -> StreamPairs:  # fmt: skip
    """Find the offset, and pair the streams by it.

    Raises `InputError`, `TooFewSamplesError`, `RankDeficientError` as `coarse_offset`, `pairs_at`,
    `robocal_ros.hand_eye.camera.calibrate_camera`.
    """
    offset = coarse_offset(robot, camera)
    pairs, left_out = pairs_at(robot, camera, offset, mount)
    fit = fit_pairs(pairs, given, sound=require_sound(pairs, {}))
    for _ in range(_ROUNDS):
        fit = fit_pairs(_with_offset(robot, pairs, fit, offset), given, fit.at, fit.at)
        step = float(fit.estimate.state.common[0])
        offset += step
        pairs, left_out = pairs_at(robot, camera, offset, mount)
        if abs(step) < max(_CLOSE_S, 0.01 * _sigma(fit)):
            break
    else:
        raise RankDeficientError(
            f"the time offset did not settle (last {offset:.4f} s): record a motion that turns "
            "about all axes, with changes of speed",
            ("time offset",),
        )
    return StreamPairs(_with_offset(robot, pairs, fit, offset), offset, _sigma(fit), left_out)


def _sigma(fit: PairFit) -> float:
    return float(np.sqrt(fit.whole_covariance[12, 12]))


def calibrate_streams(
    robot: PoseStream, camera: PoseStream, mount: Mount = "in-hand",
    settings: CameraSettings | None = None, check: PoseStream | None = None,
) -> HandEyeResult:  # fmt: skip
    """Place a camera from two streams; the result's ``more`` tells the offset.

    ``check``: a stream of the robot at times of the camera's that judge the result.

    Raises `InputError`, `TooFewSamplesError`, `RankDeficientError`, `ResidualError` as
    `pair_streams` and `calibrate_camera`, and for a check of times that were used to solve.
    """
    how = settings or CameraSettings()
    found = pair_streams(robot, camera, mount, how.noise)
    judges = None if check is None else _judges(found, check, camera)
    elsewhere = set() if judges is None else {*judges.pairs.names, *judges.rejected}
    return calibrate_camera(
        found.pairs,
        how,
        check=judges,
        rejected={name: _ALONE for name in found.left_out if name not in elsewhere},
        more={"time_offset_s": found.offset_s, "time_offset_sigma_s": found.sigma_s},
    )


def _judges(found: StreamPairs, check: PoseStream, camera: PoseStream) -> CheckPairs:
    """Pairs of the check's stretch, and the camera poses there that have none of the robot."""
    # the common error is the offset, which is in the times already
    pairs = pairs_at(check, camera, found.offset_s, found.pairs.mount)[0]
    used, held = set(found.pairs.names), set(pairs.names)
    twice = [name for name in pairs.names if name in used]
    if twice:
        raise InputError(
            f"{len(twice)} of the camera's poses, first {twice[0]}, lie in the robot's stream and "
            "in that of the check: other times must judge"
        )
    time = camera.time_s + found.offset_s
    there = (time >= check.time_s[0]) & (time <= check.time_s[-1])
    alone = set(np.array(camera.names)[there].tolist()) & set(found.left_out) - held
    return CheckPairs(pairs, {name: _ALONE for name in found.left_out if name in alone})
