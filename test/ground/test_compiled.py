# SPDX-License-Identifier: Apache-2.0
"""Kept machine code never outlives an edit, also of a function in another file."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from long_form import more

PACKAGE = Path(__file__).parents[2] / "robocal_ros"
CORE = "robocal_ros.ground.compiled"
KERNELS = sorted(
    path for path in PACKAGE.rglob("*.py") if f"from {CORE} import" in path.read_text()
)

WALK = """
import numpy as np
from robocal_ros.kinematics.kernels import walk
T = np.empty((4, 4))
links = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]])
walk(np.array([0.5]), links, np.eye(4), np.empty(24), np.empty((1, 2, 3)), T)
print(float(T[0, 3]), sum(walk.stats.cache_hits.values()))
"""

AGAIN = """
import numba
@numba.njit(error_model="numpy")
def again(q, links, root, turns, frames, T):
    walk(2.0 * q, links, root, turns, frames, T)
    return T[0, 3]
x = again(np.array([0.25]), links, np.eye(4), np.empty(24), np.empty((1, 2, 3)), T)
print(float(x), sum(walk.stats.cache_hits.values()))
"""


def walk(folder: Path, script: str = WALK) -> tuple[float, int]:
    """x of a link of 1 m at 0.5 rad, and how many compiled kernels were found on disk."""
    told = (
        subprocess.run(
            [sys.executable, "-c", script],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "kept")},
            stdout=subprocess.PIPE,
            check=True,
            text=True,
        )
        .stdout.splitlines()[-1]
        .split()
    )
    return float(told[0]), int(told[1])


CALLER = """
import numpy as np
from robocal_ros.kinematics.kernels import _turn_block, fk_batch
T = np.empty((1, 4, 4))
links = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]])
fk_batch(np.array([[0.5]]), links, np.eye(4), T)
print(float(T[0, 0, 3]), sum(sum(k.stats.cache_hits.values()) for k in (fk_batch, _turn_block)))
"""


RIGHT = pytest.approx(0.8775825618903728, abs=1e-15)


def test_kept_code_of_a_kernel_that_was_edited_is_made_again(tree):
    assert walk(tree, CALLER) == (RIGHT, 0)
    kernels = tree / "robocal_ros" / "kinematics" / "kernels.py"
    text = kernels.read_text()
    kernels.write_text(text.replace("r = ((angle - ", "r = 0.0 * ((angle - "))
    assert kernels.read_text() != text
    assert walk(tree) == (1.0, 0)
    kernels.write_text(text)
    assert walk(tree)[0] == RIGHT


@pytest.mark.long
def test_a_kernel_is_built_from_kept_code_and_made_again_where_that_is_gone(tree):
    assert walk(tree, CALLER) == (RIGHT, 0)
    assert walk(tree, CALLER) == (RIGHT, 2)
    called = list((tree / "kept").rglob("kernels._turn_block-*"))
    assert called
    for path in called:
        path.unlink()
    # by another name than before, as other kernels are compiled first
    assert walk(tree, WALK + CALLER) == (RIGHT, 0)
    assert walk(tree, CALLER) == (RIGHT, 2)
    assert walk(tree, WALK + AGAIN) == (RIGHT, 1)


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
    assert modules(path) <= {*KERNELS, PACKAGE / "ground" / "compiled.py"}


def test_nothing_else_compiles():
    assert KERNELS
    naming = [path for path in PACKAGE.rglob("*.py") if "numba" in path.read_text()]
    importing = {path.name for path in naming if "numba" in imports(path)}
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


CALL = """
import json, sys, tempfile, warnings
from pathlib import Path
from typing import Any
if len(sys.argv) > 1:
    tempfile.tempdir = sys.argv[1]
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import numpy as np
    from robocal_ros.ground import compiled
    from robocal_ros.kinematics.newton import copy
    cold = compiled.is_cold()
    out = np.empty((2, 3))
    copy(np.ones((2, 3)), out)
print(json.dumps({
    "right": bool((out == 1.0).all()), "cold": cold, "hits": sum(copy.stats.cache_hits.values()),
    "path": str(copy.stats.cache_path), "told": [str(w.message) for w in told],
}))
"""
NOWHERE = "/proc/nowhere"  # nobody makes a folder there, root neither


def call(folder: Path, *before: str, **given: str) -> dict[str, Any]:
    """Call a kernel of a tree where no home can be written; ``before``: command to run it with."""
    kept = {n: v for n, v in os.environ.items() if n not in ("HOME", "NUMBA_CACHE_DIR")}
    python = [sys.executable, "-P", "-c", CALL]
    found = subprocess.run(
        [*before, *python, *given.pop("arguments", "").split()],
        env=kept | {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": NOWHERE} | given,
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return dict(json.loads(found.stdout))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """The package without kept code, in a folder with nothing else."""
    folder = tmp_path / "tree"
    shutil.copytree(PACKAGE, folder / "robocal_ros", ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Code that the first call kept beside its source."""
    folder = tmp_path_factory.mktemp("kept")
    shutil.copytree(PACKAGE, folder / "robocal_ros", ignore=shutil.ignore_patterns("__pycache__"))
    assert call(folder)["hits"] == 0
    return folder / "robocal_ros" / "kinematics" / "__pycache__"


@pytest.fixture
def read_only(tree: Path) -> list[str]:
    """What runs a command with the tree read-only; skipped where that cannot be had."""
    if os.geteuid():
        for path in [tree, *tree.rglob("*")]:
            if path.is_dir():
                path.chmod(0o555)
        return []
    script = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'
    before = ["unshare", "--mount", "sh", "-c", script, str(tree)]
    tried = subprocess.run([*before, "true"], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f"this root may mount nothing: {tried.stderr.strip()}")
    return before


def test_a_read_only_tree_without_a_home_keeps_its_code_in_a_private_folder(
    tree: Path, read_only: list[str], tmp_path: Path
) -> None:
    """Numba's own cache fails there at the import."""
    first = call(tree, *read_only, TMPDIR=str(tmp_path))
    assert (first["right"], first["cold"], first["hits"], first["told"]) == (True, True, 0, [])
    (folder,) = tmp_path.glob("robocal_kernels_*")
    assert first["path"].startswith(str(folder))
    assert folder.stat().st_mode & 0o777 == 0o700
    again = call(tree, *read_only, TMPDIR=str(tmp_path))
    assert (again["right"], again["cold"], again["hits"]) == (True, False, 1)
    folder.chmod(0o777)  # others could have put code there: it is not run
    open_to_all = call(tree, *read_only, TMPDIR=str(tmp_path))
    assert (open_to_all["right"], open_to_all["hits"]) == (True, 0)
    assert any("cannot be kept" in words for words in open_to_all["told"])


@pytest.mark.long
def test_code_that_was_compiled_at_the_installation_is_used_from_a_read_only_tree(
    tree: Path, read_only: list[str], tmp_path: Path, kept: Path
) -> None:
    beside = tree / "robocal_ros" / "kinematics"
    beside.chmod(0o755)
    shutil.copytree(kept, beside / "__pycache__")
    beside.chmod(0o555)
    for temporary in (str(tmp_path), NOWHERE):  # with and without a place for new code
        found = call(tree, *read_only, arguments=temporary)
        assert (found["right"], found["cold"], found["hits"]) == (True, False, 1)


def test_where_nothing_can_be_kept_kernels_work_and_it_is_told_once(
    tree: Path, read_only: list[str]
) -> None:
    found = call(tree, *read_only, arguments=NOWHERE)
    assert (found["right"], found["hits"]) == (True, 0)
    (words,) = found["told"]
    assert "cannot be kept" in words


@pytest.mark.parametrize("content", [b"junk", *more(b"")])
def test_kept_code_that_a_power_cut_left_in_pieces_is_made_again(
    tree: Path, kept: Path, content: bytes
) -> None:
    folder = tree / "robocal_ros" / "kinematics" / "__pycache__"
    shutil.copytree(kept, folder)
    for end in ("nbi", "nbc"):
        (path,) = folder.glob(f"newton.copy*.{end}")
        path.write_bytes(content)
        again = call(tree)
        assert (again["right"], again["hits"]) == (True, 0)
        assert path.read_bytes() != content
    assert call(tree)["hits"] == 1


def test_a_full_disk_stops_no_kernel(tree: Path, small_disk: Path) -> None:
    with pytest.raises(OSError, match="No space"):
        (small_disk / "theirs").write_bytes(bytes(3_000_000))
    found = call(tree, NUMBA_CACHE_DIR=str(small_disk))
    assert found["right"]
