"""Kept machine code never outlives an edit, also of a function in another file."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "robocal_ros"
CORE = "robocal_ros.core.compiled"
KERNELS = sorted(
    path for path in PACKAGE.rglob("*.py") if f"from {CORE} import" in path.read_text()
)

WALK = """
import numpy as np
from robocal_ros.core.kinematics.kernels import walk
T = np.empty((4, 4))
links = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]])
walk(np.array([0.5]), links, np.eye(4), np.empty(24), np.empty((1, 2, 3)), T)
print(float(T[0, 3]), sum(walk.stats.cache_hits.values()))
"""


def walk(folder: Path) -> tuple[float, int]:
    """x of a link of 1 m at 0.5 rad, and how many compiled kernels were found on disk."""
    told = subprocess.run(
        [sys.executable, "-c", WALK],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "kept")},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    ).stdout.split()
    return float(told[0]), int(told[1])


def test_an_edit_of_what_a_kernel_is_built_from_compiles_it_again(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "robocal_ros", ignore=shutil.ignore_patterns("__pycache__"))
    assert walk(tmp_path) == (pytest.approx(0.8775825618903728, abs=1e-15), 0)
    assert walk(tmp_path) == (pytest.approx(0.8775825618903728, abs=1e-15), 1)
    sines = tmp_path / "robocal_ros" / "core" / "kinematics" / "sines.py"
    text = sines.read_text()
    sines.write_text(text.replace("r = ((angle - ", "r = 0.0 * ((angle - "))
    assert sines.read_text() != text
    assert walk(tmp_path) == (1.0, 0)
    sines.write_text(text)
    assert walk(tmp_path) == (pytest.approx(0.8775825618903728, abs=1e-15), 0)


def modules(path: Path) -> set[Path]:
    """Modules of ours that a module imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            parts = name.split(".")
            file = PACKAGE.parent.joinpath(*parts).with_suffix(".py")
            if parts[0] == PACKAGE.name and file.is_file():
                found.add(file)
    return found


@pytest.mark.parametrize("path", KERNELS, ids=lambda p: p.stem)
def test_kernels_are_built_from_modules_that_the_digest_covers(path):
    assert modules(path) <= {*KERNELS, PACKAGE / "core" / "compiled.py"}


def test_nothing_else_compiles():
    assert KERNELS
    importing = {p.name for p in PACKAGE.rglob("*.py") if "numba" in imports(p)}
    assert importing == {"compiled.py"}


def imports(path: Path) -> set[str]:
    """First parts of everything that a module imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found
