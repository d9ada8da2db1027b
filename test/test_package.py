# SPDX-License-Identifier: Apache-2.0
"""The package says the same of itself in every place."""

import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest

import robocal_ros
from robocal_ros.ground.errors import Code

ROOT = Path(__file__).parent.parent
KINDS = ("msg", "srv", "action")


def test_one_version_everywhere() -> None:
    manifests = [ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"]
    versions = [ElementTree.parse(path).findtext("version") for path in manifests]
    assert versions == [robocal_ros.__version__] * 2


def test_every_source_file_names_its_licence() -> None:
    assert ElementTree.parse(ROOT / "package.xml").findtext("license") == "Apache-2.0"
    code = [ROOT / "setup.py", ROOT / "Makefile", ROOT / "Dockerfile", ROOT / ".ci" / "run"]
    for folder in ("robocal_ros", "launch", "bags", "bench", "tools", "test", "resource"):
        code += [path for path in (ROOT / folder).rglob("*") if path.is_file()]
    scripts = [path for path in code if path.read_bytes().startswith(b"#!")]
    named = [path for path in code if path.suffix == ".py" or path in code[:4] or path in scripts]
    named += [
        *(ROOT / "msg_defs").glob("CMakeLists.txt"),
        *(ROOT / "tools").rglob("CMakeLists.txt"),
    ]
    assert len(named) > 600
    line = "# SPDX-License-Identifier: Apache-2.0"
    assert not [path for path in named if line not in path.read_text().splitlines()[:2]]


def test_the_codes_of_the_message_are_the_codes_of_the_core() -> None:
    text = (ROOT / "msg_defs" / "msg" / "CalibrationQuality.msg").read_text()
    constants = {name: int(value) for name, value in re.findall(r"^uint8 (\w+)=(\d+)$", text, re.M)}
    assert constants == {code.name: code.value for code in Code}


def test_every_interface_is_built() -> None:
    listed = (ROOT / "msg_defs" / "CMakeLists.txt").read_text()
    built = set(re.findall(r'"((?:msg|srv|action)/\w+\.\w+)"', listed))
    files = [path for kind in KINDS for path in (ROOT / "msg_defs" / kind).iterdir()]
    assert built == {f"{path.parent.name}/{path.name}" for path in files}


@pytest.mark.ros
def test_every_ros_package_that_is_imported_is_required() -> None:
    """Else rosdep does not install it on a machine with Jazzy."""
    from ament_index_python.packages import get_packages_with_prefixes

    code = "".join(path.read_text() for path in (ROOT / "robocal_ros").rglob("*.py"))
    imported = set(re.findall(r"^\s*(?:from|import) (\w+)", code, re.MULTILINE))
    of_ros = imported & set(get_packages_with_prefixes()) - {"robocal_ros"}
    assert "rclpy" in of_ros
    manifest = ElementTree.parse(ROOT / "package.xml")
    assert of_ros <= {element.text for element in manifest.iter("exec_depend")}


@pytest.mark.ros
def test_the_command_is_on_the_path_of_a_sourced_workspace() -> None:
    script = "source install/setup.bash && command -v robocal && robocal --version"
    done = subprocess.run(
        ["/bin/bash", "-c", script],
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    place, version = done.stdout.splitlines()
    assert Path(place).parts[-3:] == ("robocal_ros", "bin", "robocal")
    assert version == f"robocal {robocal_ros.__version__}"


def test_a_folder_called_like_the_package_does_not_hide_it(tmp_path: Path) -> None:
    """As beside a clone: git names its folder robocal_ros too."""
    try:
        metadata.distribution("robocal-ros")
    except metadata.PackageNotFoundError:
        pytest.skip("robocal_ros is not installed here")
    (tmp_path / "robocal_ros" / "robocal_ros").mkdir(parents=True)
    found = subprocess.run(
        [sys.executable, "-c", "import robocal_ros; print(robocal_ros.__version__)"],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (found.stdout.strip(), found.stderr) == (robocal_ros.__version__, "")


def anchors(page: Path) -> set[str]:
    """Of its headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    bare = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", head).replace("`", "") for head in heads)
    return {re.sub(r"[^\w\- ]", "", head.strip().lower()).replace(" ", "-") for head in bare}


PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_what_is_there(page: Path) -> None:
    for file, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)]*)\)", page.read_text()):
        if not file.startswith("http"):
            led_to = page.parent / file if file else page
            assert led_to.exists(), file
            assert not anchor or led_to.suffix != ".md" or anchor in anchors(led_to), (file, anchor)
