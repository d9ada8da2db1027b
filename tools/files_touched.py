# SPDX-License-Identifier: Apache-2.0
"""Which files of ours one piece of work passes through.

    tools/with_ros python tools/files_touched.py [-v]

Beam events to tool frames and spheres to models by ``robocal replay`` of the bags in bags/ (the
command and the reading of a bag count too), a trajectory through a correction session, and
``robocal identify``. Counted are functions that ran (`sys.setprofile`), generators and lambdas
too; compiled kernels, other threads and what a file does when it is imported are not. ``-v``
names the files.
"""

import contextlib
import io
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np

import robocal_ros
from robocal_ros.cli.main import main
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, OfferedModel, TrajectoryCommand
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.kinematics.robots import load_description

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(robocal_ros.__file__).parent  # the one that runs


def touched(work: Callable[[], object]) -> dict[Path, set[str]]:
    """Functions that ran, by file."""
    found: dict[Path, set[str]] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        name = frame.f_code.co_name
        if event == "call" and name != "<module>":
            file = Path(frame.f_code.co_filename)
            if file.is_relative_to(PACKAGE):
                found.setdefault(file.relative_to(PACKAGE), set()).add(frame.f_code.co_qualname)

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return found


def command(*words: str) -> None:
    """Run ``robocal``, silently. Raises when it gives no answer."""
    with contextlib.redirect_stdout(io.StringIO()):
        status = main([*words, "--json"])
    if status:
        raise SystemExit(f"robocal {' '.join(words)}: exit status {status}")


def trajectory() -> Callable[[], object]:
    """A drifted arm's correction, enabled; what is left is to correct one trajectory."""
    robot = load_description("kr150_r3100")
    arm = robot.arm
    config = CorrectionConfig(
        velocity_limits=robot.max_velocity, acceleration_limits=robot.max_acceleration
    )
    session = CorrectionSession(arm, arm, "s1", config)
    names, home = arm.joint_names, np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])
    mdh = arm.mdh.copy()
    mdh[1, 0] += 1e-4
    session.offer_model(OfferedModel(arm.name, "s1", arm.model_hash, 1, True, names, mdh))
    for k in range(200):
        session.reading(JointCommand(names, home), 100.0 + 0.01 * k)
    session.look(102.0, 0)
    session.enable(True)
    session.reading(JointCommand(names, home), 102.01)
    path = home + np.linspace(0.0, 0.2, 50)[:, None]
    sent = TrajectoryCommand(names, path, np.linspace(0.0, 5.0, 50))
    return lambda: session.trajectory(sent, 102.02)


WORK: dict[str, Callable[[], object]] = {
    "beam events to tools": lambda: command("replay", str(ROOT / "bags" / "tool_runs.mcap")),
    "spheres to models": lambda: command(
        *("replay", str(ROOT / "bags" / "golden_excerpt.mcap")),
        *("--topic", "session_events:=/thermal_node/session_events"),
    ),
    "a trajectory": trajectory(),
    "robocal identify": lambda: command(
        "identify", "--robot", "ur10", "--data", str(ROOT / "docs" / "examples" / "measured.csv")
    ),
}

if __name__ == "__main__":
    for what, work in WORK.items():
        if what != "a trajectory":
            work()  # what is imported late is there from now on
        found = touched(work)
        print(f"{what}: {len(found)} files, {sum(map(len, found.values()))} functions")
        if "-v" in sys.argv:
            print(*(f"    {file} {len(names)}" for file, names in sorted(found.items())), sep="\n")
