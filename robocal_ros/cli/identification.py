"""From files to an identification: what ``robocal identify`` computes, without its printing."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import hold_out, pose_groups
from robocal_ros.ground.errors import Code, InputError, TooFewSamplesError
from robocal_ros.ground.files import quoted
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import JudgedIdentification, Method, Part, identify_and_judge
from robocal_ros.identification.judged import identification_document
from robocal_ros.identification.mismatch import explain_mismatch, require_match
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import beyond_limits, read_measurements

Document = dict[str, Any]

_OTHER_SET_UP = (
    "if the check data come from another set-up (measuring device or targets moved), say so with "
    "--check-refit base,tool"
)


@dataclass(frozen=True)
class IdentifyRequest:
    """What to identify from which files.

    ``check_file`` None: a share ``hold_out`` of the poses of ``data_file`` judges instead.
    """

    data_file: Path
    check_file: Path | None = None
    check_refit: tuple[Part, ...] = ()
    hold_out: float = 0.5
    seed: int = 0
    fit: tuple[Part, ...] = ("base", "tool", "geometry")
    method: Method = "map"


@dataclass(frozen=True)
class IdentifyAnswer:
    """An identification, its document and what the user should know beside it."""

    judged: JudgedIdentification
    document: Document
    warnings: tuple[str, ...] = field(default=())


def identify_files(arm: SerialArm, request: IdentifyRequest) -> IdentifyAnswer:
    """Identify from tables and judge.

    Raises
    ------
    InputError
        When a file cannot be read, or its data cannot belong to this robot or to each other.
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    warnings: list[str] = []
    data = _read(request.data_file, arm, warnings)
    if request.check_file is None:
        held = hold_out(pose_groups(data.q), request.hold_out, request.seed)
        train, check = data.take(~held), data.take(held)
    else:
        train, check = data, _read(request.check_file, arm, warnings)
        _require_other_data(train, check, request)
        _require_known_targets(train, check, request)
        warnings += _compared(train, check, request)
    base, tool = "base" in request.fit, "tool" in request.fit
    require_match(arm, data, base=base, tool=tool, file=str(request.data_file))
    try:
        judged = identify_and_judge(
            arm,
            train,
            check,
            fit=request.fit,
            method=request.method,
            check_refit=request.check_refit,
        )
    except TooFewSamplesError as error:
        if request.check_file is not None:
            raise
        raise TooFewSamplesError(
            f"{request.data_file}: {error} ({len(check)} of its {len(data)} measurements are held "
            "out to judge)"
        ) from error
    if request.check_file is not None:
        _require_check_fits(judged, check, request)
        if judged.verdict.code is Code.RESIDUAL_TOO_LARGE and not request.check_refit:
            warnings.append(_OTHER_SET_UP)
    document = identification_document(judged) | {"data": _data_document(request, train, check)}
    return IdentifyAnswer(judged, document, tuple(warnings))


def _read(path: Path, arm: SerialArm, warnings: list[str]) -> Measurements:
    data = read_measurements(path, arm)
    warnings += [f"{path}: {words}" for words in beyond_limits(data, arm)]
    return data


def _data_document(request: IdentifyRequest, train: Measurements, check: Measurements) -> Document:
    split = request.check_file is None
    return {
        "file": str(request.data_file),
        "check_file": None if split else str(request.check_file),
        "fit": list(request.fit),
        "check_refit": list(request.check_refit),
        "hold_out": request.hold_out if split else None,
        "seed": request.seed if split else None,
        "train": len(train),
        "check": len(check),
    }


def _require_check_fits(
    judged: JudgedIdentification, check: Measurements, request: IdentifyRequest
) -> None:
    """Name the mistake in check data that miss the identified model, as for training data."""
    arm, refit, file = judged.identification.cell.arm, request.check_refit, str(request.check_file)
    if frozenset(refit) >= {"base", "tool"}:
        require_match(arm, check, base=True, tool=True, file=file)
    elif not refit and (
        mistake := explain_mismatch(arm, check, judged.identification.cell.residual)
    ):
        raise InputError(mistake, file=file)


def _require_other_data(train: Measurements, check: Measurements, request: IdentifyRequest) -> None:
    known = {row.tobytes(): i for i, row in enumerate(_rows(train))}
    same = [i for i, row in enumerate(_rows(check)) if row.tobytes() in known]
    if same:
        raise InputError(
            f"{len(same)} of {len(check)} measurements are in {request.data_file} too (the first "
            f"is sample {check.sample[same[0]]}): a model is judged on data not used to solve; "
            "take them out of one file, or leave out --check to hold out a part",
            file=str(request.check_file),
        )


def _rows(data: Measurements) -> Any:
    return np.ascontiguousarray(np.hstack([data.q, data.position]))


def _require_known_targets(
    train: Measurements, check: Measurements, request: IdentifyRequest
) -> None:
    unknown = [name for name in check.targets if name not in train.targets]
    if unknown and "tool" not in request.check_refit:
        raise InputError(
            f"target {quoted(unknown[0])} is not in {request.data_file} (it has "
            f"{', '.join(train.targets)}): use the same name, or --check-refit tool (or "
            "base,tool) to place it anew from the check data",
            file=str(request.check_file),
            column="target",
        )


def _compared(train: Measurements, check: Measurements, request: IdentifyRequest) -> list[str]:
    """What the user should know about the two files together."""
    found = []
    group = pose_groups(np.vstack([train.q, check.q]))
    again = int(np.sum(np.isin(group[len(train) :], group[: len(train)])))
    if again:
        found.append(
            f"{again} of {len(check)} check measurements are at poses that were also used to "
            "solve: errors at new poses can be larger"
        )
    if train.rotation is None and check.rotation is not None:
        found.append(
            f"{request.check_file} has orientations and {request.data_file} has none: the "
            "model is solved and judged by positions"
        )
    return found
