# SPDX-License-Identifier: Apache-2.0
"""``robocal warm``: compile the kernels before a node or a command has to.

Numba keeps the machine code (``ground.compiled`` says where), for the array types that a kernel was
called with: so each is called once, as nodes and commands do.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.cli.main import CliResult, Document, print_words, progress_console
from robocal_ros.correction.session import load_kernels
from robocal_ros.ground import compiled, frames, serialized
from robocal_ros.ground.samples import Measurements
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.camera_fit import fit_pairs
from robocal_ros.identification import identify, row_kernels
from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_robot

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.documents import WarmDocument, WarmStepDocument

POSES = 30
LINE_EVERY = 10  # kernels, where no terminal shows each


def warming() -> Mapping[str, Callable[[], object]]:
    """What nodes and commands call first, by what it is for; in this order."""
    arm = load_robot("ur10")  # only its shape matters, six joints
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (POSES, 6))
    names = tuple(str(i) for i in range(POSES))

    def arms() -> None:
        for made in (arm.jacobian, arm.parameter_jacobian, arm.fk):
            made(q)
        functions = JointFunctions(np.zeros(6), np.ones(6), np.zeros((6, 4)), np.zeros(6))
        turning = replace(arm, functions=functions)
        turning.jacobian(turning.read(q))

    def back() -> None:
        here = np.array([0.1, -1.2, 1.0, 0.4, 1.2, 0.3])
        inverse(arm, arm.fk(here)[None], here)

    def models() -> None:
        T = arm.fk(q)
        noise = 1e-5 * rng.standard_normal((POSES, 3))
        position = T[:, :3, 3] + 0.1 * T[:, :3, 2] + noise
        data = Measurements(q=q, position=position, target=("tool",) * POSES, sample=names)
        identify(arm, data).cell.residual(data)
        row_kernels.load_kernels()

    def cameras() -> None:
        T = arm.fk(q)
        fit_pairs(PosePairs(T, frames.invert(T), names))

    return {
        "the arm": arms,
        "its inverse": back,
        "identification": models,
        "hand-eye": cameras,
        "joint correction": lambda: load_kernels(arm),
        "messages": serialized.load_kernels,
    }


def add_warm(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``warm``: none."""


def run_warm(args: argparse.Namespace) -> CliResult:
    console, steps, names = progress_console(), warming(), list[str]()
    with console.status("") as status:

        def tell(name: str) -> None:
            names.append(name)
            words = f"{len(names)} kernels, {name}"
            status.update(words)
            if not console.is_terminal and len(names) % LINE_EVERY == 0:
                console.print(words)

        done: list[WarmStepDocument] = []
        with compiled.compiling(tell):
            for number, (name, call) in enumerate(steps.items(), start=1):
                before, begun_s = len(names), time.monotonic()
                call()
                step: WarmStepDocument = {
                    "name": name,
                    "compiled": len(names) - before,
                    "seconds": time.monotonic() - begun_s,
                }
                done.append(step)
                console.print(f"{number} of {len(steps)}: {_in_words(step)}")
    document: WarmDocument = {"steps": done, "compiled": len(names), "warnings": []}
    return CliResult(document, _show)


def _in_words(step: "WarmStepDocument") -> str:
    return f"{step['name']}, {step['compiled']} kernels compiled, {step['seconds']:.1f} s"


def _show(console: "Console", document: Document) -> None:
    count = document["compiled"]
    found = f"{count} kernels were compiled" if count else "All kernels were compiled already"
    print_words(console, f"{found}: nodes and commands load their machine code.")
