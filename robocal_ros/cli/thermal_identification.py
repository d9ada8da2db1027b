"""From tables to a drift: what ``robocal thermal identify`` computes, without its printing."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.output import Document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.identification.cell import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import read_measurements
from robocal_ros.thermal.documents import cycle_document, flange_sensor_document, judge_cycle
from robocal_ros.thermal.flange_sensor import identify_and_judge_flange_sensor
from robocal_ros.thermal.identification import CycleDrift, identify_cycle, identify_subset
from robocal_ros.thermal.learning import read_prior
from robocal_ros.thermal.process import drift_prior
from robocal_ros.thermal.reference import (
    ONLY_CYCLE,
    ColdSpots,
    Visits,
    read_visits,
    require_cold_counterparts,
)
from robocal_ros.thermal.sensor_calibration import PlacedSensor, read_sensor


@dataclass(frozen=True)
class FixedRequest:
    """Files of a fixed sensor; ``parameters`` empty: all of them, with a prior."""

    sensor_file: Path
    cold_file: Path
    warm_file: Path
    check_file: Path | None
    prior_file: Path | None
    parameters: tuple[str, ...]
    sigma_m: float


def identify_fixed_files(arm: SerialArm, request: FixedRequest) -> Document:
    """Identify each cycle of the warm table; the document is the last one's.

    Raises
    ------
    InputError, WrongRobotError
        When a file cannot be read, or does not belong to this robot or to the cold visit.
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    sensor = read_sensor(request.sensor_file, arm)
    cold, spots = cold_spots(arm, sensor, request.cold_file)
    warm = warm_visits(request.warm_file, arm, cold)
    check = (
        None if request.check_file is None else check_visits(request.check_file, arm, cold, warm)
    )
    prior = drift_prior(arm) if request.prior_file is None else read_prior(request.prior_file, arm)
    documents = []
    for name in warm.cycles:
        found = _solve(spots, warm.of_cycle(name), request, prior)
        own = None if check is None else _of_cycle(check, name, warm.cycles[-1])
        unseen = None if own is None else own.data
        judged = judge_cycle(found, spots, in_force=arm, check=unseen, sigma_m=request.sigma_m)
        method = "subset" if request.parameters else "map"
        documents.append(cycle_document(found, judged, spots, arm, method) | {"cycle": name})
    return documents[-1] | {
        "cycles": documents,
        "cold_rejected": list(spots.rejected),
        "data": {
            "sensor": str(request.sensor_file),
            "cold": str(request.cold_file),
            "warm": str(request.warm_file),
            "check": _name(request.check_file),
            "prior": _name(request.prior_file),
        },
    }


def _name(path: Path | None) -> str | None:
    return None if path is None else str(path)


def cold_spots(arm: SerialArm, sensor: PlacedSensor, path: Path) -> tuple[Visits, ColdSpots]:
    """Read a table of cold visits and average those of each pose."""
    cold = read_visits(path, arm)
    targets = cold.data.targets
    if len(targets) > 1:
        raise InputError(
            f"{len(targets)} targets ({', '.join(targets)}): the sensor file knows one sphere",
            file=str(path),
            column="target",
        )
    tool = frames.transform(np.eye(3), sensor.sphere_in_flange)[None]
    cell = CellModel(arm, sensor.T_sensor_base, targets, tool)
    return cold, ColdSpots.of(cell, cold.data)


def warm_visits(path: Path, arm: SerialArm, cold: Visits) -> Visits:
    """Read a table of warm visits of poses that were visited cold."""
    warm = read_visits(path, arm)
    require_cold_counterparts(cold, warm, str(path))
    return warm


def check_visits(path: Path, arm: SerialArm, cold: Visits, warm: Visits) -> Visits:
    """Read a table of warm visits of poses that are not in the warm table."""
    check = warm_visits(path, arm, cold)
    shared = sorted(set(check.pose) & set(warm.pose))
    if shared:
        raise InputError(
            f"pose '{shared[0]}' is in the warm table too: a drift is judged at poses that were "
            "not used to solve",
            file=str(path),
            column="pose",
        )
    return check


def _of_cycle(check: Visits, name: str, last: str) -> Visits | None:
    """The check visits of a cycle; those without a cycle belong to the last one."""
    if check.cycles == (ONLY_CYCLE,) and name == last:
        return check
    own = check.of_cycle(name)
    return own if len(own.data) else None


def _solve(
    spots: ColdSpots, cycle: Visits, request: FixedRequest, prior: NDArray[np.float64]
) -> CycleDrift:
    if request.parameters:
        return identify_subset(spots, cycle.data, request.parameters, sigma_m=request.sigma_m)
    return identify_cycle(spots, cycle.data, prior_covariance=prior, sigma_m=request.sigma_m)


def identify_flange_files(
    arm: SerialArm, data_files: Sequence[Path], check_file: Path | None
) -> Document:
    """Identify geometry, hand-eye and spheres from sessions; judge on the check session.

    Raises
    ------
    InputError
        When a file cannot be read.
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    sessions = [read_measurements(path, arm) for path in data_files]
    check = None if check_file is None else read_measurements(check_file, arm)
    judged = identify_and_judge_flange_sensor(arm, sessions, check)
    return flange_sensor_document(judged) | {
        "data": {
            "sessions": [str(path) for path in data_files],
            "check": _name(check_file),
        }
    }
