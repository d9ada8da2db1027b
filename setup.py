# SPDX-License-Identifier: Apache-2.0
"""Package robocal_ros for ament and pip."""

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "robocal_ros"
SHARE = Path("share", NAME)
ROOT = Path(__file__).resolve().parent  # colcon builds in a folder of links to some of the files


def shared_files() -> list[tuple[str, list[str]]]:
    """List what the share folder has, by folder."""
    folders: dict[str, list[str]] = {}
    for path in sorted([*Path("config").rglob("*"), *Path("launch").glob("*.launch.py")]):
        if path.is_file():
            folders.setdefault(str(SHARE / path.parent), []).append(str(path))
    folders[str(SHARE / "schemas")] = sorted(map(str, Path("docs/schemas").glob("*.json")))
    return list(folders.items())


def demo_files() -> list[tuple[str, list[str]]]:
    """The demo, a recording to try things on, and of the benches what the demo needs."""
    bench = [Path("bench", *name.split(".")).with_suffix(".py") for name in DEMO_NEEDS]
    folders = {str(SHARE / "bags"): ["bags/demo_shift.mcap"]}
    for path in (Path("bags/demo.py"), Path("bags/demo_output.py"), *bench):
        folders.setdefault(str(SHARE / "demo" / path.parent), []).append(str(path))
    return list(folders.items())


def requirements(file: str) -> dict[str, str]:
    """Versions by name, of a file of pins."""
    lines = (ROOT / "requirements" / file).read_text().splitlines()
    found = (re.fullmatch(r"([\w.-]+)==([\w.]+)(;.*)?", line.strip()) for line in lines)
    return {match[1]: match[2] for match in reversed([*filter(None, found)])}


OLDEST, CORE, LINE, DEV = map(requirements, ("floor.txt", "core.txt", "line.txt", "dev.txt"))
# From the version of Ubuntu 24.04 on, below the major one after that which make pins.
NEEDED = [
    f"{name}>={OLDEST[name]},<{int(pinned.split('.')[0]) + 1}" for name, pinned in CORE.items()
]
CLUSTER = ("dask", "distributed")  # for `robocal validate --scheduler`; versions are dates

DEMO_NEEDS = (
    "__init__", "cell_samples", "demo", "measured_fixture", "measured_runs", "processes", "startup",
    "tables",
    "closed_loop.__init__", "closed_loop.carrying", "closed_loop.plant", "closed_loop.setting",
    "closed_loop.suite", "closed_loop.words",
    "live.__init__", "live.cell", "live.graph", "live.lines", "live.opc_ua", "live.plc",
    "live.running",
)  # fmt: skip

# Of ament's layout. In a wheel the second would take the place of pip's own script.
AMENT_FILES = [
    ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
    ("bin", ["resource/bin/robocal"]),
    *demo_files(),
]
WHEEL = {"bdist_wheel", "editable_wheel"} & {*sys.argv}

setup(
    name=NAME,
    version=ElementTree.parse("package.xml").findtext("version"),
    description="On-line accuracy maintenance for industrial robots",
    license="Apache-2.0",
    maintainer="robocal_ros maintainers",
    maintainer_email="maintainers@robocal-ros.example",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "cell_sim/*.csv", "panel/panel.*", "panel/words.yaml"]},
    data_files=[
        *([] if WHEEL else AMENT_FILES),
        (str(SHARE), ["package.xml"]),
        *shared_files(),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools", *NEEDED],
    extras_require={
        "cluster": [f"{name}>={OLDEST[name]}" for name in CLUSTER],
        "completion": [f"argcomplete>={OLDEST['argcomplete']}"],
        "plc": [f"asyncua~={OLDEST['asyncua']}"],  # its inner parts are used
        "panel": [f"{name}>={OLDEST[name]}" for name in ("aiohttp", "cryptography")],
        "dev": [f"{name}=={version}" for name, version in (LINE | DEV).items()],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "robocal = robocal_ros.cli.main:main",
            "tcf_node = robocal_ros.tool.node:main",
            "hand_eye_node = robocal_ros.hand_eye.node:main",
            "thermal_node = robocal_ros.thermal.node:main",
            "joint_correction_node = robocal_ros.correction.node:main",
            "plc_bridge_node = robocal_ros.plc.node:main",
            "panel_node = robocal_ros.panel.node:main",
            "adapter_node = robocal_ros.adapter.node:main",
            "cell_sim_node = robocal_ros.cell_sim.node:main",
            "fixture_node = robocal_ros.fixture.node:main",
            "sharing_node = robocal_ros.maintenance.sharing_node:main",
            "maintenance_node = robocal_ros.maintenance.node:main",
            "replay_node = robocal_ros.bags.replay_node:main",
            "recorder_node = robocal_ros.bags.recorder_node:main",
            *([] if WHEEL else ["demo = robocal_ros.cli.demo:main"]),
        ]
    },
)
