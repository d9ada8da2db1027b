# SPDX-License-Identifier: Apache-2.0
"""What a stock machine with ROS 2 Jazzy, a container and the public CI are told.

None of the three can be had here: what they name must exist, and be what the pages say.
"""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
DOCKERFILE = (ROOT / "Dockerfile").read_text()
PAGE = (ROOT / "docs" / "install.md").read_text()
# docs/install.md has the release and the commit of rosdistro that they were looked up at.
RELEASED = set(re.findall(r"^\| `(\w+)` \| [\w-]+ \| \d+\.\d+\.\d+-\d+ \|$", PAGE, re.MULTILINE))
MANIFESTS = (ROOT / "package.xml", ROOT / "msg_defs" / "package.xml")
INSTALLED = re.compile(r"^(sudo )?apt-get ")


def commands(job: str) -> list[str]:
    """Lines that the job's shell runs."""
    blocks = [step["run"] for step in WORKFLOW["jobs"][job]["steps"] if "run" in step]
    return [line.strip() for block in blocks for line in block.splitlines()]


def shown() -> set[str]:
    blocks = re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    return {line.strip() for block in blocks for line in block.splitlines()}


def test_jobs_run_what_the_pages_and_the_makefile_say():
    other_stack, *run = commands("wheels")
    assert re.search(r" node-opcua-client@[\d.]+$", other_stack)
    assert run == ["bash .ci/run", "make docs"]
    targets = re.findall(r"^([\w-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE)
    of_make = {f"make {target}" for target in targets}
    assert [c for c in commands("floor") if not INSTALLED.match(c)] == ["make test-floor"]
    assert {"make test-floor", "make docs"} <= of_make
    others = {"rosdep update --rosdistro jazzy"}  # the image has it initialized
    for command in commands("jazzy"):
        if command.startswith("tools/"):
            script = ROOT / command.split()[0]
            assert script.stat().st_mode & 0o111
            assert script.name in PAGE
        elif command.startswith("for file in"):
            files = re.search(r"in ([\w ]+);", command)
            assert all((ROOT / "launch" / f"{f}.launch.py").is_file() for f in files[1].split())
        elif not INSTALLED.match(command):
            assert command in shown() | others | {"source install/setup.bash"}, command


@pytest.mark.parametrize("name", ["build_jazzy", "test_jazzy"])
def test_scripts_are_read_by_bash_and_name_files_that_exist(name):
    script = ROOT / "tools" / name
    subprocess.run(["bash", "-n", str(script)], check=True)
    files = re.findall(r"requirements/[\w.-]+|tools/[\w.]+\.xml", script.read_text())
    assert files
    assert all((ROOT / file).is_file() for file in files)


def test_a_script_says_when_ros_is_not_sourced():
    done = subprocess.run(
        [ROOT / "tools" / "build_jazzy"], env={"PATH": "/usr/bin:/bin"}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "source /opt/ros/jazzy/setup.bash first" in done.stderr


def test_packages_are_released_for_jazzy():
    texts = [*commands("jazzy"), *commands("floor"), DOCKERFILE, PAGE]
    named = {n.replace("-", "_") for t in texts for n in re.findall(r"ros-jazzy-([\w-]+)", t)}
    assert named
    assert named <= RELEASED
    needed = {
        element.text or ""
        for manifest in MANIFESTS
        for element in ElementTree.parse(manifest).iter()
        if element.tag.endswith("depend")
    }
    assert {n for n in needed if not n.startswith("python3-")} - {"robocal_msgs"} <= RELEASED


def test_the_container_is_built_as_the_page_says():
    (image,) = re.findall(r"^FROM (.*)$", DOCKERFILE, re.MULTILINE)
    assert image == WORKFLOW["jobs"]["jazzy"]["container"]
    for command in ("rosdep install --from-paths . msg_defs --ignore-src -y", "tools/build_jazzy"):
        assert command in DOCKERFILE
        assert command in shown()
    copied = re.findall(r"^COPY (\S+) ", DOCKERFILE, re.MULTILINE)
    assert all((ROOT / file).exists() for file in copied)


def test_versions_there_are_those_that_are_tested_with_the_oldest():
    floor = set((ROOT / "requirements" / "floor.txt").read_text().splitlines())
    lines = [
        line
        for name in ("jazzy", "jazzy-test")
        for line in (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
        if not line.startswith(("#", "pytest-"))
    ]
    assert lines
    assert set(lines) <= floor
    assert "pytest==7.4.4" in floor  # apt's, which test_jazzy has


@pytest.mark.ros
@pytest.mark.parametrize("place", ["the clone", "a workspace"])
def test_colcon_finds_both_packages_without_arguments(place, tmp_path):
    assert find_spec("colcon_core")
    folder = ROOT
    if place == "a workspace":
        folder = tmp_path
        (folder / "src").mkdir()
        (folder / "src" / "robocal_ros").symlink_to(ROOT)
        (folder / "colcon_defaults.yaml").symlink_to("src/robocal_ros/colcon_defaults.yaml")
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "--log-base", str(tmp_path / "log"), "list", "-n"],
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["robocal_msgs", "robocal_ros"]
