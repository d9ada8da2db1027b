"""What is wrong with pairs of poses that no placement fits, and motions that show too little."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.hand_eye.camera_start import robust_start, sample_sizes, score
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs

Array = NDArray[np.float64]

FEWEST_PAIRS = 3
LEAST_TURN_RAD = float(np.radians(1.0))  # rms about a second axis
LEAST_SHIFT_M = 1e-2  # of the flange beside its axis
SMALLEST_M, LARGEST_M = 5e-3, 100.0  # reach of robots, cameras and trackers
CLEARLY_BETTER = 0.3
MOST_SHIFTED = 2  # samples by which one table may lag behind the other
MOST_SWAPPED = 20  # rejected samples among which swaps are looked for
SCALE_TOLERANCE = 0.02
SCALE_SIGMAS = 5.0
FEWEST_SCALED = 6  # samples: of fewer the sigma itself is not known
_NEARLY = 0.1  # of a factor of a thousand


def require_pairs(pairs: PosePairs, rejected: Mapping[str, str]) -> None:
    """Refuse pairs that cannot give an answer, before anything is solved.

    ``rejected``: samples that were left out already, with the reason.

    Raises
    ------
    TooFewSamplesError
        Fewer than three.
    InputError
        When positions have another unit.
    RankDeficientError
        When the flange was turned about one axis only, or not at all.
    """
    if len(pairs) < FEWEST_PAIRS:
        raise TooFewSamplesError(
            f"{len(pairs)} samples: at least {FEWEST_PAIRS} with turns about two axes are needed "
            "(15 or more are better)"
            + "".join(f"; left out: {name}: {why}" for name, why in list(rejected.items())[:3])
        )
    for what, T in (("robot", pairs.T_base_flange), ("board", pairs.T_camera_board)):
        largest = float(np.linalg.norm(T[:, :3, 3], axis=1).max())
        if not SMALLEST_M < largest < LARGEST_M:
            small = largest <= SMALLEST_M
            raise InputError(
                f"the {what}'s positions reach {largest:.4g} m: are they a thousand times too "
                + ("small, m where mm are said?" if small else "large, mm where m are said?")
            )
    _require_turns(pairs)


def _require_turns(pairs: PosePairs) -> None:
    R = pairs.T_base_flange[:, :3, :3]
    mean = frames.nearest_rotation(R.mean(axis=0))
    turns = frames.log_rotation(mean.T @ R)
    turns = turns - turns.mean(axis=0)
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    spread = s / np.sqrt(len(pairs))
    if spread[1] >= LEAST_TURN_RAD:
        return
    if spread[0] < LEAST_TURN_RAD:
        raise RankDeficientError(
            f"the flange turned by {np.degrees(spread[0]):.2f} deg rms only: the camera's place "
            "does not show; turn the flange about two axes, by 20 deg or more",
            ("translation of the camera in all directions",),
        )
    where = "flange" if pairs.mount == "in-hand" else "base"
    axis = Vt[0] if where == "flange" else mean @ Vt[0]
    words = " ".join(f"{value:+.2f}" for value in axis)
    hidden = [f"translation along the common rotation axis ({words} in the {where})"]
    remedy = "turn the flange about another axis too, by 20 deg or more"
    if _one_centre(pairs.T_boardside_cameraside):
        hidden.append(f"turn about the same axis ({words} in the {where})")
    raise RankDeficientError(
        f"the flange turned about one axis only ({np.degrees(spread[0]):.1f} deg rms, "
        f"{np.degrees(spread[1]):.2f} deg about any other); not determined: {'; '.join(hidden)}: "
        + remedy,
        hidden,
    )


def _one_centre(T: Array) -> bool:
    """Whether all poses (m, 4, 4), turned about one axis, are turns about one line."""
    # R_i u + t_i = p for one u and p
    A = np.concatenate([T[:, :3, :3], np.broadcast_to(-np.eye(3), (len(T), 3, 3))], axis=2)
    rows, t = A.reshape(-1, 6), T[:, :3, 3].ravel()
    miss = t - rows @ np.linalg.lstsq(rows, t, rcond=None)[0]
    spread = np.linalg.svd(miss.reshape(-1, 3), compute_uv=False) / np.sqrt(len(T))
    return bool(spread[1] < LEAST_SHIFT_M)  # along the axis it may move


def scale_of_board(pairs: PosePairs, at: Placement) -> tuple[float, float]:
    """Factor by which board positions would fit the robot's better, and its sigma."""
    carrier = pairs.T_boardside_cameraside
    R = carrier[:, :3, :3]
    seen = R @ (at.X[:3, :3] @ pairs.T_camera_board[:, :3, 3, None])
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape), seen], axis=2).reshape(-1, 7)
    b = -carrier[:, :3, 3].ravel()
    found, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-10)
    if rank < A.shape[1] or len(pairs) < FEWEST_SCALED:
        return 1.0, np.inf
    variance = float(np.sum((b - A @ found) ** 2)) / (len(b) - A.shape[1])
    return float(found[6]), float(np.sqrt(variance * np.linalg.inv(A.T @ A)[6, 6]))


def wrong_scale(pairs: PosePairs, at: Placement) -> str:
    """Say in words that lengths of robot and board differ by a factor; empty if they do not."""
    factor, sigma = scale_of_board(pairs, at)
    away = abs(factor - 1.0)
    if away < SCALE_TOLERANCE or min(away, factor) < SCALE_SIGMAS * sigma:
        return ""
    for thousand, words in ((1e3, "small"), (1e-3, "large")):
        if abs(factor / thousand - 1.0) < _NEARLY:
            return (
                f"the board's positions look a thousand times too {words} beside the robot's: "
                "check the units, m and mm"
            )
    return (
        f"the board's positions fit the robot's when multiplied by {factor:.4f} +- {sigma:.4f}: "
        "check the size of its squares, the intrinsics, and the units"
    )


def mistake(pairs: PosePairs, at: Placement) -> str:
    """The mistake that explains why pairs fit badly, in words; empty where none does."""
    now = score(pairs, at)
    robot, board = pairs.T_base_flange, pairs.T_camera_board
    turned = replace(pairs, T_base_flange=frames.invert(robot))
    other = "to-hand" if pairs.mount == "in-hand" else "in-hand"
    tries = {
        "the robot's poses fit when they are inverted: are they T_flange_base, or is the camera "
        f"mounted {other}?": turned,
        "the board's poses fit when they are inverted: are they T_board_camera?": replace(
            pairs, T_camera_board=frames.invert(board)
        ),
        **_right_handed(pairs),
    }
    for lag in range(1, MOST_SHIFTED + 1):
        if len(pairs) - lag > FEWEST_PAIRS + 2:
            for sign, words in ((lag, "after"), (-lag, "before")):
                tries[
                    f"each board pose fits the robot pose {lag} row(s) {words} its own: the pairs "
                    "are shifted"
                ] = _shifted(pairs, sign)
    scores = {words: score(tried, robust_start(tried)) for words, tried in tries.items()}
    best = min(scores, key=lambda words: scores[words])
    if scores[best] < CLEARLY_BETTER * now:
        return best
    return wrong_scale(pairs, at)


def _right_handed(pairs: PosePairs) -> dict[str, PosePairs]:
    """Pairs with a mirror undone, each by its words.

    Which axis a whole mirror turns round is a choice of frames; and to mirror the robot's poses
    undoes a mirror of the board's as well.
    """
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    remedy = "they come from a left-handed frame: turn one axis round"
    mirrored = replace(pairs, T_base_flange=flip @ pairs.T_base_flange @ flip)
    found = {f"the robot's poses, or the board's, fit when mirrored as a whole: {remedy}": mirrored}
    for axis, name in enumerate("xyz"):
        robot, board = pairs.T_base_flange.copy(), pairs.T_camera_board.copy()
        robot[:, axis, 3] *= -1.0
        board[:, axis, 3] *= -1.0
        words = f"positions fit with {name} negated: {remedy}"
        found[f"the robot's {words}"] = replace(pairs, T_base_flange=robot)
        found[f"the board's {words}"] = replace(pairs, T_camera_board=board)
    return found


def _shifted(pairs: PosePairs, lag: int) -> PosePairs:
    """Each board pose with the robot pose ``lag`` rows later."""
    m = len(pairs)
    rows = np.arange(max(lag, 0), m + min(lag, 0))
    return replace(pairs.take(rows - lag), T_base_flange=pairs.T_base_flange[rows])


def swapped(pairs: PosePairs, at: Placement, rejected: NDArray[np.bool_]) -> dict[str, str]:
    """Which rejected samples fit when their robot poses are exchanged: name and the other's."""
    rows = np.flatnonzero(rejected)
    if not 2 <= len(rows) <= MOST_SWAPPED:
        return {}
    first, second = (grid.ravel() for grid in np.meshgrid(rows, rows, indexing="ij"))
    crossed = replace(pairs.take(first), T_base_flange=pairs.T_base_flange[second])
    size = sample_sizes(crossed, at).reshape(len(rows), len(rows))
    usual = 3.0 * float(np.max(sample_sizes(pairs.take(~rejected), at)))
    found = {}
    for i, row in enumerate(rows):
        others = [j for j in range(len(rows)) if j != i and size[i, j] < usual > size[j, i]]
        if others and size[i, i] >= usual:
            found[pairs.names[row]] = pairs.names[rows[others[0]]]
    return found
