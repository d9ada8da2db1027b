# SPDX-License-Identifier: Apache-2.0
"""``ros2 run robocal_ros demo``: the demo of `make demo`, from an installed workspace.

What it simulates and judges with is the benches' code, which lies in the share folder and on nobody
else's path.
"""

import os
import runpy
import sys
from pathlib import Path

from robocal_ros.ground.files import share_folders

# A graph of its own on this machine: its cell must neither find nor be found by a real one.
DOMAIN = {"ROS_DOMAIN_ID": "87", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
OUT = "robocal_demo"  # in the folder where it is started


def main() -> None:
    """Run it, with the arguments of ``bags/demo.py``."""
    folders = share_folders("robocal_ros", "demo/bags", "bags")
    script = next((f / "demo.py" for f in folders if (f / "demo.py").is_file()), None)
    if script is None:
        sys.exit(f"no demo.py in {', '.join(map(str, folders))}: build the workspace anew")
    for name, value in DOMAIN.items():
        os.environ.setdefault(name, value)
    sys.argv = [str(script), "--out", str(Path.cwd() / OUT), *sys.argv[1:]]
    sys.path.insert(0, str(script.parent))
    runpy.run_path(str(script), run_name="__main__")
