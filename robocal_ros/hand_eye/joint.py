"""One mount from several targets at once: what one leaves open, another shows."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.hand_eye.diagnosis import features, looked
from robocal_ros.hand_eye.mount_fit import fit_mount, require_seen
from robocal_ros.hand_eye.mount_problem import MountState
from robocal_ros.hand_eye.quality import HandEyeSettings
from robocal_ros.hand_eye.result import HandEyeResult, TargetKind
from robocal_ros.hand_eye.solve import result_of
from robocal_ros.hand_eye.sphere_radius import require_radius
from robocal_ros.hand_eye.tasks import HandEyeData, Read, Task
from robocal_ros.hand_eye.verification import HeldOut, held_out, judged

Part = tuple[Task, HandEyeData]


def solve_joint(
    parts: Sequence[Part],
    settings: HandEyeSettings,
    checks: Mapping[TargetKind, HandEyeData] | None = None,
) -> HandEyeResult:
    """Calibrate with all shots of several targets; names of samples begin with their target's kind.

    At least one target must suffice for a first pose of the sensor. ``checks``: by kind, other
    shots of targets, which have not moved; they judge the result.

    Raises
    ------
    InputError
        Fewer than two targets, or two of one kind.
    ResidualError
        One target's samples contradict each other; the mistake is named as in `solve_task`.
    TooFewSamplesError, RankDeficientError
        When no target gives a first pose, the first one's reason; as `solve_task` otherwise.
    """
    kinds = [task.kind for task, _ in parts]
    if len(kinds) < 2 or len(set(kinds)) < len(kinds):
        raise InputError(f"several targets of different kinds are needed, not: {', '.join(kinds)}")
    alone = [_alone(*part) for part in parts]
    X = _first(alone, settings)
    reads = _named(parts, [read for read, _ in alone])
    views = tuple(read.view for read in reads)
    places = [
        task.placed(view, X.T_flange_sensor) for (task, _), view in zip(parts, views, strict=True)
    ]
    fit = fit_mount(views, MountState(X.T_flange_sensor, tuple(places)), settings.noise())
    require_radius(fit)
    require_seen(fit)
    tasks = [task for task, _ in parts]
    result = result_of(tasks, fit, reads, _data(parts), settings)
    if not checks:
        return result
    shots = sum(len(data.names) for data in checks.values())
    return judged(result, _held_out(tasks, fit.state, checks), shots, settings)


def _held_out(
    tasks: Sequence[Task], state: MountState, checks: Mapping[TargetKind, HandEyeData]
) -> HeldOut:
    """How far all other shots are off."""
    found = {
        task.kind: held_out(task, checks[task.kind], state.T_flange_sensor, place)
        for task, place in zip(tasks, state.places, strict=True)
        if task.kind in checks
    }
    return HeldOut(
        tuple(f"{kind}/{name}" for kind, one in found.items() for name in one.samples),
        np.concatenate([one.distance_m for one in found.values()]),
        {
            f"{kind}/{name}": why
            for kind, one in found.items()
            for name, why in one.rejected.items()
        },
    )


def _alone(task: Task, data: HandEyeData) -> tuple[Read, MountState | RobocalError]:
    """Features of one target, and where they lead alone, or why nowhere: others may show more."""
    read = features(task, data)
    try:
        return read, looked(task, data, read)
    except (TooFewSamplesError, RankDeficientError) as error:
        return read, error


def _first(
    alone: Sequence[tuple[Read, MountState | RobocalError]], settings: HandEyeSettings
) -> MountState:
    """The pose of the sensor from the target that shows it best alone."""
    failures = [near for _, near in alone if isinstance(near, RobocalError)]
    fits = []
    for read, near in alone:
        if isinstance(near, MountState):
            try:
                fits.append(fit_mount((read.view,), near, settings.noise()))
            except (TooFewSamplesError, RankDeficientError) as error:
                failures.append(error)
    if not fits:
        raise failures[0]
    return min(fits, key=lambda fit: float(np.trace(fit.covariance[:3, :3]))).state


def _named(parts: Sequence[Part], reads: Sequence[Read]) -> list[Read]:
    """Samples called after their target; shots of all are numbered through."""
    named, first = [], 0
    for (task, data), read in zip(parts, reads, strict=True):
        s = read.view.sightings
        s = replace(
            s,
            names=tuple(f"{task.kind}/{name}" for name in s.names),
            shot=s.shot + first,
            pose=s.pose + first,
        )
        named.append(
            Read(
                replace(read.view, sightings=s),
                {f"{task.kind}/{name}": why for name, why in read.rejected.items()},
                {f"{task.kind}/{name}": points for name, points in read.points.items()},
            )
        )
        first += len(data.names)
    return named


def _data(parts: Sequence[Part]) -> HandEyeData:
    """All shots together."""
    return HandEyeData(
        tuple(f"{task.kind}/{name}" for task, data in parts for name in data.names),
        np.concatenate([data.T_base_flange for _, data in parts]),
        [profile for _, data in parts for profile in data.profiles],
    )
