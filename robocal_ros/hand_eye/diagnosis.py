"""What is wrong with data that do not fit: the common mistakes, tried one by one."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, RankDeficientError, ResidualError, RobocalError
from robocal_ros.hand_eye.mistakes import explain, undone
from robocal_ros.hand_eye.mount_fit import first_look, misfit
from robocal_ros.hand_eye.mount_problem import MountState, TargetView
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.tasks import HandEyeData, Read, Task

Array = NDArray[np.float64]

DOUBTFUL_M = 2e-4  # median distance from which a mistake in the data is looked for
SHOWN = 0.5  # of the profiles
WRONG_M = 2e-3  # the same, from which something is wrong, whatever it is


def features(task: Task, data: HandEyeData) -> Read:
    """Features of the profiles.

    Raises
    ------
    ResidualError
        When poses must tell which feature is which, and do not: with the mistake that explains it.
    RobocalError
        When too little is seen.
    """
    try:
        return task.read(data)
    except InputError:
        raise
    except RobocalError as error:
        if task.read_by_poses:
            _name_mistake(task, data, None, np.inf, error)
        raise


def looked(task: Task, data: HandEyeData, read: Read) -> MountState:
    """A state near the solution.

    Raises
    ------
    ResidualError
        When the data do not fit: with the mistake that explains it, where one does.
    RobocalError
        When too little is seen, or the poses leave a direction open.
    """
    try:
        near = look(task, read.view)
    except RobocalError as error:
        _name_mistake(task, data, read, np.inf, error)
        raise
    as_given = misfit((read.view,), near) if _shown(read.view, data) else np.inf
    if as_given > DOUBTFUL_M:
        _name_mistake(task, data, read, as_given, None)
    if as_given > WRONG_M:
        off = f"samples are off by {misfit((read.view,), near) * 1e3:.3g} mm"
        raise ResidualError(
            f"{off} or do not show the target where it must be, and no common mistake explains it: "
            "has the target moved, are poses and profiles of the same run, is it the right target?"
        )
    return near


def _shown(view: TargetView, data: HandEyeData) -> bool:
    """Whether most of the profiles show the target where it must be."""
    usable = sum(isinstance(profile, Profile) for profile in data.profiles)
    return len(np.unique(view.sightings.shot)) > SHOWN * usable


def look(task: Task, view: TargetView) -> MountState:
    """The state nearest to the sightings to which a start leads, before the noise is known.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When none leads anywhere.
    """
    states: list[MountState] = []
    failure: RobocalError | None = None
    for start in task.starts(view):
        try:
            states.append(first_look((view,), start))
        except RobocalError as error:
            failure = failure or error
            if isinstance(error, RankDeficientError):
                break  # it lies in the poses, not in the start
    if not states:
        raise failure or RobocalError("no start was found")
    return min(states, key=lambda state: misfit((view,), state))


def _name_mistake(
    task: Task, data: HandEyeData, read: Read | None, as_given: float, error: RobocalError | None
) -> None:
    """Raise with the mistake that explains a misfit, m, or an error; nothing where none does."""

    def followed(task: Task, view: TargetView) -> float:
        if not _shown(view, data):
            return np.inf
        first = task.starts(view)[0]
        if (off := misfit((view,), first)) > as_given:  # not worth following
            return off
        return misfit((view,), first_look((view,), first))

    def with_poses(T_base_flange: Array) -> float:
        other = replace(data, T_base_flange=T_base_flange)
        return followed(
            task, task.read(other).view if read is None else task.posed(read.view, other)
        )

    def as_told(other: Task) -> float:
        known = None if read is None or task.read_by_poses else read.view
        return followed(other, other.read(data).view if known is None else other.posed(known, data))

    def suspects() -> Iterator[tuple[str, Callable[[], float]]]:
        for words, poses in undone(data.T_base_flange):
            yield words, partial(with_poses, poses)
        if read is not None and error is not None:
            return  # open directions lie in the poses, whatever is told of the target
        for words, other in task.suspects():
            yield words, partial(as_told, other)

    words = explain(suspects(), as_given)
    if words is None:
        return
    if not np.isfinite(as_given):
        raise ResidualError(f"the samples do not fit: {words}") from error
    raise ResidualError(f"samples are off by {as_given * 1e3:.3g} mm: {words}")
