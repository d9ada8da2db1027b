"""One mount from several targets at once: what one leaves open, another shows."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from robocal_ros.core.errors import InputError, RobocalError
from robocal_ros.core.hand_eye.diagnosis import look
from robocal_ros.core.hand_eye.mount_fit import fit_mount, require_seen
from robocal_ros.core.hand_eye.mount_problem import MountState, View
from robocal_ros.core.hand_eye.quality import HandEyeSettings
from robocal_ros.core.hand_eye.result import HandEyeResult, TargetKind
from robocal_ros.core.hand_eye.solve import result_of
from robocal_ros.core.hand_eye.sphere_radius import require_radius
from robocal_ros.core.hand_eye.tasks import HandEyeData, Read, Task
from robocal_ros.core.hand_eye.verification import HeldOut, held_out, judged

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
    RobocalError
        When no target gives a first pose, the first one's reason; as `solve_task` otherwise.
    """
    kinds = [task.kind for task, _ in parts]
    if len(kinds) < 2 or len(set(kinds)) < len(kinds):
        raise InputError(f"several targets of different kinds are needed, not: {', '.join(kinds)}")
    reads = _read(parts)
    X = _first(parts, reads, settings)
    views = tuple(read.view for read in reads)
    places = [
        task.placed(view, X.T_flange_sensor) for (task, _), view in zip(parts, views, strict=True)
    ]
    fit = fit_mount(views, MountState(X.T_flange_sensor, tuple(places)), settings.noise())
    require_radius(fit)
    require_seen(
        fit, float(np.abs(np.concatenate([v.sightings.value[:, 1] for v in views])).mean())
    )
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


def _read(parts: Sequence[Part]) -> list[Read]:
    """Features of all parts; poses of each are numbered after those of the one before."""
    reads, first = [], 0
    for task, data in parts:
        read = task.read(data)
        s = read.view.sightings
        named = replace(
            s, names=tuple(f"{task.kind}/{name}" for name in s.names), pose=s.pose + first
        )
        reads.append(
            Read(
                View(read.view.model, named),
                {f"{task.kind}/{name}": why for name, why in read.rejected.items()},
                {f"{task.kind}/{name}": points for name, points in read.points.items()},
            )
        )
        first += len(data.names)
    return reads


def _first(parts: Sequence[Part], reads: Sequence[Read], settings: HandEyeSettings) -> MountState:
    """The pose of the sensor from the target that shows it best alone."""
    failure: RobocalError | None = None
    fits = []
    for (task, _), read in zip(parts, reads, strict=True):
        try:
            near = look(task, read.view)
            fits.append(fit_mount((read.view,), near, settings.noise()))
        except RobocalError as error:
            failure = failure or error
    if not fits:
        raise failure or InputError("no target gives a first pose of the sensor")
    return min(fits, key=lambda fit: float(np.trace(fit.covariance[:3, :3]))).state


def _data(parts: Sequence[Part]) -> HandEyeData:
    """All shots together."""
    return HandEyeData(
        tuple(f"{task.kind}/{name}" for task, data in parts for name in data.names),
        np.concatenate([data.T_base_flange for _, data in parts]),
        [profile for _, data in parts for profile in data.profiles],
    )
