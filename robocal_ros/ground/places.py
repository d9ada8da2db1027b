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


def share_folders(package: str, inside: str, source: str) -> list[Path]:
    """Existing folders ``share/<package>/<inside>`` of all prefixes, the best first.

    ``source`` is the same folder in the source tree; it comes before the installed ones.
    """
    installed = (prefix / "share" / package / inside for prefix in prefixes())
    candidates = dict.fromkeys([SOURCE_ROOT / source, *installed])
    return [folder for folder in candidates if folder.is_dir()]
