"""Shots of a recording: profiles that were taken while the robot stood still."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.samples import JOINTS, joint_sample
from robocal_ros.ground.streams import JointStream, NotStillError, StandstillRule
from robocal_ros.hand_eye.shots import PROFILE, Shot, shot_of
from robocal_ros.session import events
from robocal_ros.session.base import GAP_NS, Ignored
from robocal_ros.session.events import Command

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StandingShot:
    """A profile, named by its number in the recording, and the mean joints (n,) of its standstill.

    ``mark``: of a staircase, where the recording tells it; else empty.
    """

    name: str
    shot: Shot
    q: Array
    mark: str = ""


class Standstills:
    """Pairs profiles with standstills, as a session does for a capture.

    Attributes
    ----------
    found : shots in the order of the recording.
    rejected : name of each other profile, and why it is none.
    ignored : joint readings that were not used.
    """

    def __init__(self, joint_names: tuple[str, ...], rule: StandstillRule) -> None:
        self._stream, self._rule = JointStream(joint_names), rule
        self._waiting: deque[tuple[str, Shot]] = deque()
        self._count, self._frame = 0, ""
        self.found: list[StandingShot] = []
        self.rejected: dict[str, str] = {}
        self.ignored = Ignored()

    def take(self, kind: str, message: Any) -> None:
        """Take a message of an input; one that cannot be used is counted, or named."""
        if kind == PROFILE:
            self._take_profile(message)
        elif kind == JOINTS:
            try:
                self._stream.add(joint_sample(message), GAP_NS)
            except RobocalError as error:
                self.ignored.add(kind, str(error))
        while self._waiting and self._settled(*self._waiting[0]):
            self._waiting.popleft()

    def close(self) -> None:
        """No more messages come."""
        for name, shot in self._waiting:
            told = self.ignored.words() or "the recording ends, or its clocks differ"
            self.rejected[name] = f"no joint readings about {shot.stamp_ns} ns: {told}"
        self._waiting.clear()

    def _take_profile(self, message: Any) -> None:
        self._count += 1
        name = f"shot_{self._count:02d}"
        try:
            shot = shot_of(PROFILE, message)
            shot.read()
        except RobocalError as error:
            self.rejected[name] = str(error)
            return
        self._frame = self._frame or shot.frame
        if shot.frame == self._frame:
            self._waiting.append((name, shot))
        else:
            told = f"in frame '{shot.frame}', those before it in '{self._frame}'"
            self.rejected[name] = f"of another sensor: {told}"

    def _settled(self, name: str, shot: Shot) -> bool:
        try:
            q = self._stream.resting(shot.stamp_ns, self._rule)
        except NotStillError as error:
            self.rejected[name] = f"not at standstill: {error}"
            return True
        if q is None:
            return False
        self.found.append(StandingShot(name, shot, q))
        return True


def captured_marks(
    commands: Sequence[tuple[Command, Mapping[str, Any]]],
) -> dict[int, str] | None:
    """Stamp and mark of the shots that a recorded session holds in the end.

    ``commands``: each with its recorded outcome. None: they tell of no data set.
    """
    begun = False
    asked: dict[int, str] = {}
    stamps: dict[int, int] = {}
    for command, outcome in commands:
        name, arguments = command.name, command.arguments
        if outcome["status"] != Code.ACCEPT:
            continue
        begun |= name in (events.START, events.LOAD, events.SAMPLE)
        if name in (events.START, events.LOAD):
            asked, stamps = {}, {}
        elif name == events.CAPTURE:
            asked[int(arguments["handle"])] = str(arguments.get("mark", ""))
        elif name == events.SAMPLE:
            stamps[int(arguments["handle"])] = int(arguments["shot_ns"])
        elif name == events.REMOVE:
            stamps.pop(int(arguments["handle"]), None)
    return {at: asked.get(handle, "") for handle, at in stamps.items()} if begun else None


def first_of_each(
    found: Sequence[StandingShot], tolerance_rad: float
) -> tuple[list[StandingShot], dict[str, str]]:
    """The first shot of each standstill, and why the others are left out.

    What errs in a pose is common to all shots from it: they are not measurements of their own.
    """
    kept: list[StandingShot] = []
    rejected: dict[str, str] = {}
    for one in found:
        if kept and float(np.max(np.abs(one.q - kept[-1].q))) <= tolerance_rad:
            rejected[one.name] = f"taken at the same standstill as {kept[-1].name}"
        else:
            kept.append(one)
    return kept, rejected
