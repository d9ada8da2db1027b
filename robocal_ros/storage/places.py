"""Where files that come with the packages are found, with and without ROS."""

import os
import sys
from pathlib import Path

SOURCE_ROOT = Path(__file__).resolve().parents[2]


def prefixes() -> list[Path]:
    """Prefixes that may hold ``share/<package>``: of ROS, of this installation, of Python."""
    named = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    found = [Path(prefix) for prefix in named if prefix]
    found += [folder for folder in SOURCE_ROOT.parents if (folder / "share").is_dir()]
    return [*found, Path(sys.prefix)]


def share_folders(package: str, source: str) -> list[Path]:
    """Existing folders of a package's files, the best first.

    ``source`` is the folder in the source tree; it comes before the installed ones.
    """
    candidates = [SOURCE_ROOT / source, *(prefix / "share" / package for prefix in prefixes())]
    return [folder for folder in dict.fromkeys(candidates) if folder.is_dir()]
