# SPDX-License-Identifier: Apache-2.0
"""Write requirements/constraints.txt: every version that pip put into this venv.

Run with the venv's Python after a change of a requirement (CONTRIBUTING.md).
"""

from importlib.metadata import distributions
from pathlib import Path

HEADER = "# Made by tools/lock_requirements.py; the versions that `make` was tested with.\n"


def lock() -> list[str]:
    """Return name==version of each installed distribution but this project's own."""
    lines = {
        f"{dist.name}=={dist.version}"
        for dist in distributions()
        if (dist.read_text("INSTALLER") or "").strip() == "pip"
        and dist.name not in {"pip", "robocal_ros"}
    }
    return sorted(lines, key=str.lower)


if __name__ == "__main__":
    target = Path(__file__).parent.parent / "requirements" / "constraints.txt"
    target.write_text(HEADER + "\n".join(lock()) + "\n")
