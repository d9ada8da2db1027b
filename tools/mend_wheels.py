# SPDX-License-Identifier: Apache-2.0
"""Point the ROS wheels' CMake files at this machine's Python and NumPy headers.

The wheels were built elsewhere and name that machine's paths. A wheel holds no links either: of a
library that has several names it holds as many copies, and eight wheels bring the same ones: these
become links to one. CMake's ctest and cpack go: nothing here runs them. Run once with the venv's
Python; a second run finds nothing to do.
"""

import filecmp
import os
import sys
import sysconfig
from pathlib import Path

import numpy as np

MAJOR, MINOR = sys.version_info[:2]
BUILT_AT = f"/opt/python/cp{MAJOR}{MINOR}-cp{MAJOR}{MINOR}"
PYTHON = f"python{MAJOR}.{MINOR}"
HERE = {
    f"{BUILT_AT}/include/{PYTHON}": sysconfig.get_path("include"),
    f"{BUILT_AT}/lib/{PYTHON}/site-packages/numpy/_core/include": np.get_include(),
}


def mend(share: Path) -> int:
    """Mend every CMake file under ``share``; return how many were changed."""
    changed = 0
    for path in share.rglob("*.cmake"):
        text = path.read_text()
        mended = text
        for there, here in HERE.items():
            mended = mended.replace(there, here)
        if BUILT_AT in mended:
            raise SystemExit(f"{path} names a path of its build machine that is not known here")
        if mended != text:
            path.write_text(mended)
            changed += 1
    return changed


def link(folder: Path) -> int:
    """Make links of names of a library, ``x.so``, that are copies of ``x.so.2``; how many."""
    linked = 0
    for path in sorted(folder.glob("*.so*"), key=lambda path: len(path.name), reverse=True):
        for shorter in folder.glob("*.so*"):
            is_name = path.name.startswith(f"{shorter.name}.")
            if is_name and not shorter.is_symlink() and filecmp.cmp(path, shorter, shallow=False):
                shorter.unlink()
                shorter.symlink_to(path.name)
                linked += 1
    return linked


def share(packages: Path) -> int:
    """Keep one file of libraries that several wheels bring under one name; how many were spared.

    Hard links: what pip takes away with one wheel stays for the others.
    """
    first: dict[str, Path] = {}
    spared = 0
    for path in sorted(packages.glob("*.libs/*.so*")):
        other = first.setdefault(path.name, path)
        if not other.samefile(path) and filecmp.cmp(other, path, shallow=False):
            path.unlink()
            os.link(other, path)
            spared += 1
    return spared


if __name__ == "__main__":
    packages = Path(sysconfig.get_path("platlib"))
    print(f"mended {mend(Path(sys.prefix, 'share'))} CMake files")
    print(f"made links of {link(Path(sys.prefix, 'lib')) + share(packages)} copies of libraries")
    for unused in ("ctest", "cpack"):
        (packages / "cmake" / "data" / "bin" / unused).unlink(missing_ok=True)
