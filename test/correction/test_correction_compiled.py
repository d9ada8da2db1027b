# SPDX-License-Identifier: Apache-2.0
"""What is compiled before the first command is all that a correction ever calls."""

import gc
import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from correction_robot import HOME, NOMINAL, Robot, bent_tool, drifted, good_here_only, offer, swing
from numba.core.dispatcher import Dispatcher

from robocal_ros.cli import warm
from robocal_ros.correction.bounds import Policy
from robocal_ros.correction.interface import RefusedError
from robocal_ros.correction.session import load_kernels


def compiled() -> dict[str, int]:
    """For how many signatures each kernel of ours is there."""
    found = {}
    for kernel in gc.get_objects():
        if isinstance(kernel, Dispatcher) and kernel.__module__.startswith("robocal_ros."):
            found[f"{kernel.__module__}.{kernel.__name__}"] = len(kernel.signatures)
    return found


def use(policy: Policy, free_axis: bool) -> None:
    """A session's life: model, tool, streams through a singularity, trajectories, states, off."""
    robot = Robot(policy=policy, free_axis=free_axis)
    session = robot.session
    session.offer_model(offer(drifted()))
    session.enable(True)
    robot.settle()
    robot.change_tool(bent_tool())
    robot.settle()
    speed = np.array([0.0, 0.0, 0.0, 0.0, -1.5, 0.0])
    q = HOME.copy()
    while q[4] > -0.3:
        q = q + speed * 0.004
        fields = {"velocity": speed} if q[4] < 0.5 else {}
        robot.stream(q, **fields)
        robot.read(robot.at, velocity=speed)
    robot.stream(q[:3], names=NOMINAL.joint_names[:3])
    robot.settle(q)
    back = np.linspace(0.0, 1.0, 300)[:, None]
    for row in q + back * (HOME - q):
        robot.stream(row)
    robot.settle()
    robot.rest()
    moved = session.trajectory(swing(), robot.now)
    assert np.isfinite(moved.position).all()
    arm, _ = good_here_only()
    session.offer_model(offer(arm, 2))
    session.enable(False)
    for _ in range(100):
        robot.stream(HOME)


def main() -> None:
    """As a node: print which kernels were compiled, or loaded, later than they should."""
    load_kernels(NOMINAL)
    before = compiled()
    for policy, free_axis in zip(Policy, itertools.cycle((False, True)), strict=False):
        try:
            use(policy, free_axis)
        except RefusedError as refused:
            print("refused", policy, free_axis, refused)
            raise
    after = compiled()
    assert sum(after.values()) > 5
    print(sorted(name for name, count in after.items() if count > before.get(name, 0)))


def test_an_installation_compiles_what_a_node_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    assert warm.load_kernels is load_kernels
    loaded: list[int] = []
    monkeypatch.setattr(warm, "load_kernels", lambda arm: loaded.append(arm.n))
    warm.warming()["joint correction"]()
    assert loaded == [6]


def test_nothing_is_compiled_while_commands_are_corrected() -> None:
    """In a process of its own: here other tests have called the kernels."""
    run = [sys.executable, __file__]
    worlds = str(Path(__file__).parents[1] / "worlds")
    found = os.pathsep.join(filter(None, (worlds, os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"PYTHONPATH": found}
    said = subprocess.run(run, capture_output=True, text=True, timeout=300, env=environment)
    assert said.returncode == 0, said.stderr
    assert said.stdout.splitlines()[-1] == "[]"


if __name__ == "__main__":
    main()
