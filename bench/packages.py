# SPDX-License-Identifier: Apache-2.0
"""The command alone, by pip: how long until it has answered, and how large its venv is.

Of what is committed, in a fresh folder, without ROS and without anything that was compiled before.
What pip has to fetch is fetched once before, as it is where it was installed before: the speed of a
network is not measured.
"""

import compileall
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench.tables import ROOT, Goal, Table

GOAL_S = 60.0
GOAL_MB = 900.0
# Of a workspace that is sourced, or of a cache of compiled kernels: a new user has none.
FOREIGN = ("PYTHONPATH", "PYTHONHOME", "AMENT_PREFIX_PATH", "NUMBA_CACHE_DIR", "ROBOCAL_CONFIG")
IDENTIFY = ("identify", "--robot", "ur10", "--data", "docs/examples/measured.csv")


def tables() -> Sequence[Table]:
    """All tables of this module."""
    with tempfile.TemporaryDirectory() as folder:
        return _measured(Path(folder))


def _measured(folder: Path) -> Sequence[Table]:
    before, source, venv = folder / "before", folder / "source", folder / "venv"
    for clone in (before, source):
        _took_s(folder, "git", "clone", "--quiet", ROOT, clone)
    pip = (sys.executable, "-m", "pip")
    _took_s(folder, *pip, "download", "--dest", folder / "fetched", before)

    build_s = _took_s(folder, *pip, "wheel", "--no-deps", "--wheel-dir", folder / "wheels", source)
    (wheel,) = (folder / "wheels").glob("*.whl")
    venv_s = _took_s(folder, sys.executable, "-m", "venv", venv)
    install_s = _took_s(folder, venv / "bin" / "pip", "install", "--no-compile", wheel)
    new_user = ("env", f"HOME={folder}", f"XDG_CACHE_HOME={folder}")  # no kernels of another venv
    first_s = _took_s(source, *new_user, venv / "bin" / "robocal", *IDENTIFY)
    again_s = _took_s(source, *new_user, venv / "bin" / "robocal", *IDENTIFY)

    table = Table(
        "packages",
        "From the sources to the first answer of `robocal identify`, by pip",
        ("step", "took, s", "goal"),
        f"Once, of a fresh clone, with pip's cache warm, without ROS: `{' '.join(IDENTIFY)}`.",
    )
    table.add("the wheel is built", build_s, None)
    table.add("venv is made, the wheel and what it needs are installed", venv_s + install_s, None)
    table.add("first answer, whose kernels are compiled", first_s, None)
    total_s = build_s + venv_s + install_s + first_s
    table.add("all of these", total_s, Goal(total_s, GOAL_S))
    table.add("the same answer again", again_s, None)
    return table, _sizes(venv)


def _sizes(venv: Path) -> Table:
    table = Table(
        "venv",
        "Size of that venv, with pip and what was compiled for the first answer",
        ("Python files", "MB", "goal"),
        "The sum of its files' bytes; 1 MB = 10^6.",
    )
    as_installed = _size_mb(venv)
    table.add("as installed (`--no-compile`)", as_installed, Goal(as_installed, GOAL_MB))
    compileall.compile_dir(venv / "lib", quiet=2)  # as pip does without --no-compile
    compiled = _size_mb(venv)
    table.add("compiled", compiled, Goal(compiled, GOAL_MB))
    return table


def _size_mb(folder: Path) -> float:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _took_s(folder: Path, *command: str | Path) -> float:
    """Seconds of a command in this folder, to its end, as one runs it who has no ROS.

    Raises `CalledProcessError` where it fails.
    """
    given = {name: value for name, value in os.environ.items() if name not in FOREIGN}
    begin_s = time.monotonic()
    subprocess.run(command, cwd=folder, env=given, capture_output=True, text=True, check=True)
    return time.monotonic() - begin_s
