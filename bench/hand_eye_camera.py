# SPDX-License-Identifier: Apache-2.0
"""A camera's hand-eye: against the bound and OpenCV's closed forms, and on real measurements."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.hand_eye_cell import BoardCell, BoardNoise, TrueLens, TruePose
from bench.hand_eye_joints import camera_table as joints_of_camera
from bench.hand_eye_sets import (
    ARM_RMS_MM,
    BOARD,
    BOARD_RMS_MM,
    TMAC_MM,
    arm_streams,
    board_images,
    tmac,
    turned_tsai,
)
from bench.real_data import data_folder
from bench.tables import Goal, Table
from robocal_ros.hand_eye.boards import boards_of_corners, see_boards
from robocal_ros.hand_eye.camera import distances, pair_streams, rms
from robocal_ros.hand_eye.camera_data import (
    CLOSED_FORMS,
    HAND_EYE,
    PosePairs,
    closed_form,
    closed_form_of_all,
    pairs_at,
)
from robocal_ros.hand_eye.camera_fit import GivenNoise, PairFit, fit_pairs, linearised

Array = NDArray[np.float64]

RUNS, SAMPLES = 2000, 20  # a ratio to within one part in a hundred
IMAGE_RUNS, IMAGES, NOISE_PX = 100, 15, 0.2
MANY = 200
NOISE = BoardNoise()
ROBOT = GivenNoise(NOISE.robot_m, NOISE.robot_rad, camera_scale=1.0)
CAMERA_ALONE = GivenNoise(1e-9, 1e-9, camera_scale=1.0)


def measured(cell: BoardCell, count: int, rng: np.random.Generator) -> PosePairs:
    """What robot and camera tell of random views."""
    views = cell.views(rng, count)
    return PosePairs(
        cell.read_robot(cell.flange(views), rng),
        cell.read_board(views, rng),
        tuple(map(str, range(count))),
        "in-hand" if cell.mount == "in-hand" else "to-hand",
        np.tile(cell.noise.board_covariance, (count, 1, 1)),
    )


def error_of(T: Array, truth: TruePose) -> Array:
    """Errors (6,) of position, m, and turn, rad, along the camera's axes."""
    T_true = truth.matrices()[0]
    turn = Rotation.from_matrix(T[:3, :3].T @ T_true[:3, :3]).as_rotvec()
    return np.concatenate([T[:3, :3].T @ (T_true - T)[:3, 3], turn])


@dataclass
class Errors:
    """Errors (6,) of each run, and the covariances told of them."""

    error: list[Array] = field(default_factory=list)
    covariance: list[Array] = field(default_factory=list)

    def add(self, T: Array, truth: TruePose, covariance: Array | None = None) -> None:
        """One more run."""
        self.error.append(error_of(T, truth))
        if covariance is not None:
            self.covariance.append(covariance[:6, :6])

    @property
    def sizes(self) -> tuple[float, float]:
        """Rms distance, m, and angle, rad."""
        square = np.square(np.array(self.error)).mean(axis=0)
        return float(np.sqrt(square[:3].sum())), float(np.sqrt(square[3:].sum()))

    @property
    def told(self) -> tuple[float, float]:
        """The same by the covariances."""
        square = np.diagonal(np.array(self.covariance), axis1=1, axis2=2).mean(axis=0)
        return float(np.sqrt(square[:3].sum())), float(np.sqrt(square[3:].sum()))

    @property
    def chi_square(self) -> float:
        """Of all errors over its degrees of freedom."""
        error = np.array(self.error)
        solved = np.linalg.solve(np.array(self.covariance), error[:, :, None])[:, :, 0]
        return float(np.sum(solved * error) / error.size)


def _chi_square_goal(errors: Errors) -> Goal:
    """Within four standard errors of 1."""
    spread = (2.0 / np.array(errors.error).size) ** 0.5
    return Goal(abs(errors.chi_square - 1.0), 4.0 * float(spread))


def bound_table() -> Table:
    """Errors over the Cramer-Rao bound: ours and OpenCV's."""
    table = Table(
        "hand_eye_camera_bound",
        f"A camera from {SAMPLES} board poses: error over the Cramer-Rao bound",
        ("mount", "estimator", "position", "goal", "turn", "goal ", "chi-square of 6", "goal  "),
        f"Simulated, {RUNS} runs each: robot 0.2 mm and 0.017 deg, board 0.1, 0.1, 0.4 mm and "
        "0.06, 0.06, 0.011 deg along the camera's axes (1 sigma an axis), tilts up to 29 deg. "
        "Chi-square: |value - 1| within 4 standard errors. Camera's noise alone: the robot taken "
        "as exact. All noise estimated, from the residuals alone: of position, along the camera's "
        "axis besides, of the robot's turn, of the camera's across its axis and about it.",
    )
    for mount in ("in-hand", "to-hand"):
        _add_bound(table, BoardCell(mount=mount, noise=NOISE))
    return table


def _add_bound(table: Table, cell: BoardCell) -> None:
    found: dict[str, Errors] = {}
    ours: dict[str, tuple[GivenNoise | None, bool]] = {
        "best, noise known": (ROBOT, True),
        "best, robot's noise estimated": (GivenNoise(camera_scale=1.0), True),
        "best, all noise estimated": (None, False),
        "camera's noise alone": (CAMERA_ALONE, True),
    }
    for run in range(RUNS):
        pairs = measured(cell, SAMPLES, np.random.default_rng([31, run]))
        for name, (given, told) in ours.items():
            fit = fit_pairs(pairs if told else replace(pairs, covariance=None), given)
            found.setdefault(name, Errors()).add(fit.at.X, cell.camera, fit.covariance)
        for name in CLOSED_FORMS:
            at = closed_form(name, pairs)
            if at is not None:
                found.setdefault(f"OpenCV {name}", Errors()).add(at.X, cell.camera)
    bound = found["best, noise known"].told
    for name, errors in found.items():
        place, turn = (size / least for size, least in zip(errors.sizes, bound, strict=True))
        goals = name.endswith(("noise known", "noise estimated"))
        chi = errors.chi_square if errors.covariance else None
        table.add(
            cell.mount,
            name,
            place,
            Goal(place, 1.05) if goals else None,
            turn,
            Goal(turn, 1.05) if goals else None,
            chi,
            _chi_square_goal(errors) if goals else None,
        )


def intrinsics_table() -> Table:
    """What it brings to know that the errors of the intrinsics are common."""
    table = Table(
        "hand_eye_camera_intrinsics",
        f"A camera and its intrinsics from the same {IMAGES} images",
        ("errors of the intrinsics", "position, mm", "turn, deg", "chi-square of 6", "goal"),
        f"Simulated, {IMAGE_RUNS} runs: 9 x 6 corners 25 mm apart, {NOISE_PX} px, a lens with "
        "radial distortion, robot 0.1 mm and 0.011 deg. Chi-square: |value - 1| within 4 standard "
        "errors.",
    )
    cell, lens = BoardCell(noise=BoardNoise(1e-4, 2e-4)), TrueLens()
    given = GivenNoise(1e-4, 2e-4, camera_scale=1.0)
    common, none = Errors(), Errors()
    forms = {name: Errors() for name in CLOSED_FORMS}
    for run in range(IMAGE_RUNS):
        rng = np.random.default_rng([32, run])
        views = cell.views(rng, IMAGES)
        robot = cell.read_robot(cell.flange(views), rng)
        corners = np.array([lens.corners(views.take(i), BOARD.points) for i in range(IMAGES)])
        corners += NOISE_PX * rng.standard_normal(corners.shape)
        names = tuple(map(str, range(IMAGES)))
        seen = boards_of_corners(names, corners, BOARD, (lens.width, lens.height))
        pairs = PosePairs(robot, seen.T_camera_board, names, "in-hand", seen.covariance)
        for errors, one in ((common, replace(pairs, shared=seen.shared)), (none, pairs)):
            fit = fit_pairs(one, given)
            errors.add(fit.at.X, cell.camera, fit.covariance)
        for name, errors in forms.items():
            at = closed_form(name, pairs)
            if at is not None:
                errors.add(at.X, cell.camera)
    for name, errors in (("common to all poses", common), ("taken as none", none)):
        place, turn = errors.sizes
        goal = _chi_square_goal(errors) if errors is common else None
        table.add(name, place * 1e3, float(np.degrees(turn)), errors.chi_square, goal)
    for name, errors in forms.items():
        place, turn = errors.sizes
        table.add(f"OpenCV {name}", place * 1e3, float(np.degrees(turn)), None, None)
    return table


def speed_table() -> Table:
    """Time of one solve beside OpenCV's, in one run."""
    table = Table(
        "hand_eye_camera_speed",
        f"Time to solve {MANY} samples",
        ("solver", "ms", "times ours", "goal"),
        "Processor's own time, median of nine, taken in turn. Ours: start, noise, robust maximum "
        "likelihood, covariance. Goal: 20 times faster than cv2.calibrateHandEye, whichever of "
        "its methods, by default: with all noise estimated.",
    )
    pairs = measured(BoardCell(noise=NOISE), MANY, np.random.default_rng(33))
    solvers: dict[str, Callable[[], object]] = {
        "ours, all noise estimated": partial(fit_pairs, replace(pairs, covariance=None)),
        "ours, covariance told, its scale and the robot's noise estimated": partial(
            fit_pairs, pairs
        ),
        "ours, noise known": partial(fit_pairs, pairs, ROBOT),
    }
    for name in CLOSED_FORMS:
        solvers[f"OpenCV {name}"] = partial(closed_form_of_all, name, pairs)
    spent: dict[str, list[float]] = {name: [] for name in solvers}
    for _ in range(9):
        for name, solve in solvers.items():
            start = time.thread_time()
            solve()
            spent[name].append(time.thread_time() - start)
    ours = float(np.median(spent["ours, all noise estimated"]))
    for name, times in spent.items():
        ratio = float(np.median(times)) / ours
        pairwise = name.removeprefix("OpenCV ") in HAND_EYE
        goal = Goal(ratio, 20.0, at_least=True) if pairwise else None
        table.add(name, float(np.median(times)) * 1e3, ratio, goal)
    return table


def _mean_mm(fit: PairFit) -> float:
    return float(np.linalg.norm(fit.differences[~fit.rejected, :3], axis=1).mean()) * 1e3


def tracker_table() -> Table:
    """A tracked target on a UR10: every start gives the same."""
    table = Table(
        "hand_eye_tmac",
        "A UR10 and a T-Mac: distance of both sides' target, mm",
        ("series", "start", "closed form, mean", "maximum likelihood, mean", "goal"),
        "Measured (Landgraf et al. 2021), 25 and 26 poses, none left out.",
    )
    for series, limit in TMAC_MM.items():
        pairs = tmac(series)
        starts = {name: closed_form(name, pairs) for name in CLOSED_FORMS}
        starts["tsai, X and Z exchanged"] = turned_tsai(pairs)
        for name, at in starts.items():
            fit = fit_pairs(pairs, None, at)
            alone = None if at is None else float(distances(pairs, at).mean()) * 1e3
            table.add(series, name, alone, _mean_mm(fit), Goal(_mean_mm(fit), limit))
    return table


def board_table() -> Table:
    """Real images of a chessboard: scatter of the fixed board, of samples used and of others."""
    table = Table(
        "hand_eye_board",
        "A camera on a UR from 20 images alone: scatter of the fixed board in base, mm rms",
        ("estimator", "samples used", "goal", "each left out in turn"),
        "Measured (wangrp1997). Intrinsics from the same images. The closed forms have the same "
        "samples; left out: the distance of every one of the 20 from the solution without it.",
    )
    T_base_flange, images = board_images()
    seen = see_boards(images, BOARD)
    pairs = PosePairs(
        T_base_flange,
        seen.T_camera_board,
        seen.names,
        "in-hand",
        seen.covariance,
        seen.shared,
    )
    fit = fit_pairs(pairs)
    used = pairs.take(~fit.rejected)
    alone: dict[str, list[float]] = {}
    for i in range(len(pairs)):
        rest, one = pairs.take(np.arange(len(pairs)) != i), pairs.take(np.array([i]))
        state = fit_pairs(rest).estimate.state
        miss = linearised(one, state)[0]
        alone.setdefault("best", []).append(float(np.linalg.norm(miss[0, :3])))
        for name in CLOSED_FORMS:
            at = closed_form(name, rest)
            if at is not None:
                alone.setdefault(name, []).append(float(distances(one, at)[0]))
    best = rms(np.linalg.norm(fit.differences[~fit.rejected, :3], axis=1)) * 1e3
    held = {name: rms(np.array(values)) * 1e3 for name, values in alone.items()}
    table.add(f"best ({len(used)} of {len(pairs)})", best, Goal(best, BOARD_RMS_MM), held["best"])
    for name in CLOSED_FORMS:
        at = closed_form(name, used)
        scatter = None if at is None else rms(distances(used, at)) * 1e3
        table.add(f"OpenCV {name}", scatter, None, held.get(name))
    return table


def arm_table() -> Table:
    """Real streams with stamps: the offset found, and what it is worth."""
    table = Table(
        "hand_eye_arm",
        "A camera on an arm, streams with stamps: scatter of the fixed target in base, mm rms",
        ("estimator", "offset, ms", "all samples", "goal"),
        "Measured (Furrer et al. 2017), 1703 images; the closed forms solve every tenth.",
    )
    robot, camera = arm_streams()
    found = pair_streams(robot, camera)
    as_told = pairs_at(robot, camera, 0.0, "in-hand")[0]
    few = as_told.take(np.arange(0, len(as_told), 10))  # OpenCV pairs each with each
    sigma = f"{found.offset_s * 1e3:.1f} ± {found.sigma_s * 1e3:.1f}"
    best = rms(np.linalg.norm(fit_pairs(found.pairs).differences[:, :3], axis=1)) * 1e3
    table.add("best", sigma, best, Goal(best, ARM_RMS_MM))
    untold = rms(np.linalg.norm(fit_pairs(as_told).differences[:, :3], axis=1)) * 1e3
    table.add("best, stamps as they are", "0", untold, None)
    for name in CLOSED_FORMS:
        at = closed_form_of_all(name, few)
        scatter = None if at is None else rms(distances(as_told, at)) * 1e3
        table.add(f"OpenCV {name}, stamps as they are", "0", scatter, None)
    return table


def tables() -> Sequence[Table]:
    """All of them; those of real measurements where these are."""
    made = [bound_table(), intrinsics_table(), joints_of_camera()]
    if not data_folder().is_dir():
        print(f"no real measurements at {data_folder()} (set ROBOCAL_DATA): left out")
        return made
    return [*made, tracker_table(), board_table(), arm_table()]
