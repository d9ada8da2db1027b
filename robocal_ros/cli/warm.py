# SPDX-License-Identifier: Apache-2.0
"""``robocal warm``: compile the kernels before a node or a command has to.

Numba keeps the machine code (``ground.compiled`` says where), for the array types that a kernel was
called with: so each is called once, as nodes and commands do.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import replace
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

import numpy as np

from robocal_ros.cli.main import CliResult, Document, print_words, progress_console
from robocal_ros.correction import limiter, solution
from robocal_ros.correction.session import load_kernels
from robocal_ros.ground import compiled, frames, mcap_records, serialized_joints
from robocal_ros.ground.samples import Measurements
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.camera_fit import fit_pairs
from robocal_ros.identification import identify, row_kernels
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.joint_functions import JointFunctions

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.documents import WarmDocument, WarmStepDocument

POSES = 30
LINE_EVERY = 10  # kernels, where no terminal shows each
LOOK_S = 0.2
FIRST = "the arm"  # all others call its kernels, too


def arm_of_six_joints() -> SerialArm:
    """Return a small arm with a parallel pair; only its shape matters."""
    turn = np.pi / 2
    mdh = [
        (0.3, 0.0, 0.0, turn, 0.0),
        (0.0, 0.0, -0.6, 0.0, 0.0),
        (0.1, 0.0, -0.5, turn, 0.0),
        (0.2, 0.0, 0.0, -turn, 0.0),
        (0.1, 0.0, 0.0, turn, 0.0),
        (0.1, 0.0, 0.0, 0.0, 0.0),
    ]
    return SerialArm(
        name="warm",
        joint_names=tuple(f"joint_{i}" for i in range(6)),
        mdh=np.array(mdh),
        sign=np.ones(6),
        prismatic=np.zeros(6, dtype=np.bool_),
        lower=np.full(6, -np.pi),
        upper=np.full(6, np.pi),
    )


def compile_streams() -> None:
    """Compile for other processes what joint correction would come to last."""
    one, row, table, stack = "f8", "f8[::1]", "f8[:,::1]", "f8[:,:,::1]"
    limited = (row, row, one, one, table, table, row, table, table, table, row)
    kernels: Sequence[tuple[Any, tuple[str, ...]]] = (
        (limiter.step_out, (*limited, table, "b1", table, stack, row)),
        (solution.uncorrect_staged, (row, table, "b1", table, "i8", one, table, row)),
        (
            solution.taught_velocity,
            (row, row, row, table, "b1", table, table, table, table, row),
        ),
    )
    for function, given in kernels:
        function.compile(f"({', '.join(given)})")


def warming() -> Mapping[str, Callable[[], object]]:
    """What nodes and commands call first, by what it is for; what takes longest comes first."""
    arm = arm_of_six_joints()
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

    def messages() -> None:
        for serialized in (mcap_records, serialized_joints):
            serialized.load_kernels()

    return {
        FIRST: arms,
        "joint correction": lambda: load_kernels(arm),
        "streams of joint correction": compile_streams,
        "hand-eye": cameras,
        "the arm's inverse": back,
        "identification": models,
        "messages": messages,
    }


def add_warm(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``warm``: none."""


def run_warm(args: argparse.Namespace) -> CliResult:
    """Do ``warm`` on all cores, telling on standard error how far it is."""
    console, steps = progress_console(), warming()
    done, told, context = list["WarmStepDocument"](), list[str](), get_context("spawn")
    names: Any = context.Queue()
    with (
        console.status("") as status,
        ProcessPoolExecutor(os.cpu_count(), context, _tell_to, (names,)) as pool,
    ):

        def tell() -> None:
            while not names.empty():
                told.append(names.get())
                words = f"{len(told)} kernels, {told[-1]}"
                status.update(words)
                if not console.is_terminal and len(told) % LINE_EVERY == 0:
                    console.print(words)

        for these in ([FIRST], [name for name in steps if name != FIRST]):
            for step in _each_done(pool, these, tell):
                done.append(step)
                console.print(f"{len(done)} of {len(steps)}: {_in_words(step)}")
    for call in steps.values():  # of what two processes kept at once that of one may be lost
        call()
    document: WarmDocument = {
        "steps": done, "compiled": sum(step["compiled"] for step in done), "warnings": []
    }  # fmt: skip
    return CliResult(document, _show)


def _each_done(
    pool: ProcessPoolExecutor, these: Sequence[str], tell: Callable[[], None]
) -> "Iterator[WarmStepDocument]":
    under_way = {pool.submit(_warmed, name) for name in these}
    while under_way:
        done, under_way = wait(under_way, LOOK_S, FIRST_COMPLETED)
        tell()
        yield from (step.result() for step in done)


def _tell_to(names: Any) -> None:
    _names.append(names)


_names: list[Any] = []  # of a process of the pool: where it tells what it compiles


def _warmed(name: str) -> "WarmStepDocument":
    count, begun_s = 0, time.monotonic()

    def tell(kernel: str) -> None:
        nonlocal count
        count += 1
        _names[0].put(kernel)

    with compiled.compiling(tell):
        warming()[name]()
    return {"name": name, "compiled": count, "seconds": time.monotonic() - begun_s}


def _in_words(step: "WarmStepDocument") -> str:
    return f"{step['name']}, {step['compiled']} kernels compiled, {step['seconds']:.1f} s"


def _show(console: "Console", document: Document) -> None:
    count = document["compiled"]
    found = f"{count} kernels were compiled" if count else "All kernels were compiled already"
    print_words(console, f"{found}: nodes and commands load their machine code.")
