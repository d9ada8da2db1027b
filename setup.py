"""Package robocal_ros for ament and pip."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "robocal_ros"
SHARE = Path("share", NAME)


def shared_files() -> list[tuple[str, list[str]]]:
    """List what lies in config/ and launch/, by folder, with its place in the share folder."""
    folders: dict[str, list[str]] = {}
    for path in sorted([*Path("config").rglob("*"), *Path("launch").glob("*.launch.py")]):
        if path.is_file():
            folders.setdefault(str(SHARE / path.parent), []).append(str(path))
    return list(folders.items())


setup(
    name=NAME,
    version=ElementTree.parse("package.xml").findtext("version"),
    description="On-line accuracy maintenance for industrial robots",
    license="Apache-2.0",
    maintainer="robocal_ros maintainers",
    maintainer_email="maintainers@robocal-ros.example",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "cell_sim/*.csv"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (str(SHARE), ["package.xml"]),
        ("bin", ["resource/bin/robocal"]),
        *shared_files(),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "robocal = robocal_ros.cli.main:main",
            "tcf_node = robocal_ros.tool.node:main",
            "hand_eye_node = robocal_ros.hand_eye.node:main",
            "thermal_node = robocal_ros.thermal.node:main",
            "joint_correction_node = robocal_ros.correction.node:main",
            "adapter_node = robocal_ros.adapter.node:main",
            "cell_sim_node = robocal_ros.cell_sim.node:main",
            "maintenance_node = robocal_ros.maintenance.node:main",
            "replay_node = robocal_ros.bags.replay_node:main",
            "recorder_node = robocal_ros.bags.recorder_node:main",
        ]
    },
)
