"""From files to planned poses: what ``robocal thermal plan-poses`` computes."""

import argparse
import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.output import Document
from robocal_ros.ground.files import write_text
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import read_measurements
from robocal_ros.thermal.learning import read_prior
from robocal_ros.thermal.planning import PosePlan, SensorField, plan_cycle
from robocal_ros.thermal.process import drift_prior
from robocal_ros.thermal.sensor_calibration import read_sensor

Array = NDArray[np.float64]


def plan_files(arm: SerialArm, args: argparse.Namespace) -> Document:
    """Plan, compare, and write the poses.

    Raises
    ------
    InputError, WrongRobotError
        When a file cannot be read or belongs to another robot.
    LimitError, TooFewSamplesError
        When the sphere cannot be brought into the field often enough.
    """
    sensor = read_sensor(args.sensor, arm)
    own = None if args.own is None else _joints(args.own, arm)
    found = plan_cycle(
        arm,
        sensor.T_sensor_base,
        sensor.sphere_in_flange,
        SensorField(*(1e-3 * x for x in args.field_mm)),
        prior=drift_prior(arm) if args.prior is None else read_prior(args.prior, arm),
        sigma_m=args.sigma_mm * 1e-3,
        count=args.poses,
        candidates=args.candidates,
        working=None if args.working is None else _joints(args.working, arm),
        own=own,
        seed=args.seed,
    )
    document = _document(arm, found.plan) | {
        "working_poses": found.working,
        "candidates": found.candidates,
        "own_mm": None if found.own_rms_m is None else found.own_rms_m * 1e3,
        "own_poses": None if own is None else len(own),
        "output": None,
    }
    if args.output is not None:
        _write(args.output, document)
        document["output"] = str(args.output)
    return document


def _joints(path: Path, arm: SerialArm) -> Array:
    return read_measurements(path, arm).q


def _document(arm: SerialArm, plan: PosePlan) -> Document:
    unit = np.where(arm.prismatic, 1e3, np.degrees(1.0))
    names = [f"q{i}_{'mm' if slides else 'deg'}" for i, slides in enumerate(arm.prismatic, 1)]
    return {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "columns": names,
        "poses": [
            {"pose": f"p{i}", "joints": (q * unit).tolist()} for i, q in enumerate(plan.q, start=1)
        ],
        "predicted_mm": plan.predicted_rms_m * 1e3,
        "random_mm": plan.random_rms_m * 1e3,
        "before_mm": plan.before_rms_m * 1e3,
        "gain": 1.0 - plan.predicted_rms_m / plan.random_rms_m,
    }


def _write(path: Path, document: Document) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["pose", *document["columns"]])
    for pose in document["poses"]:
        writer.writerow([pose["pose"], *(f"{value:.4f}" for value in pose["joints"])])
    write_text(path, text.getvalue())
