# SPDX-License-Identifier: Apache-2.0
"""The site: every page has its place, and its reference is what the programs declare."""

import importlib.util
import os
import re
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

from robocal_ros.cli.commands import COMMANDS, CliGroup

ROOT = Path(__file__).parents[1]
MKDOCS = ROOT / ".venv-docs" / "bin" / "mkdocs"


def test_every_page_has_its_place() -> None:
    placed = re.findall(r"- (?:[\w ]+: )?([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    assert len(placed) == len(set(placed))
    pages = {str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")}
    assert {page for page in placed if page.startswith("docs/")} == pages


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "tools" / "site_pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.ros
def test_the_reference_has_every_parameter(pages: ModuleType) -> None:
    text = pages.parameters()
    found = pages.nodes()
    scripts = re.findall(r'"(\w+_node) = ', (ROOT / "setup.py").read_text())
    assert sorted(scripts) == [node.NAME for node in found]
    for node in found:
        (_, section) = text.split(f"## {node.NAME}\n")
        section = section.split("\n## ")[0]
        for setting in node.SETTINGS:
            assert f"| `{setting.name}` | " in section


def test_the_reference_has_every_command(
    pages: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = pages.commands()
    for name, command in COMMANDS.items():
        assert f"## robocal {name}\n" in text
        for action in command.actions if isinstance(command, CliGroup) else ():
            assert f"### robocal {name} {action}\n" in text


def test_the_reference_has_every_interface(pages: ModuleType) -> None:
    text = pages.interfaces()
    files = [path for kind in pages.KINDS for path in (ROOT / "msg_defs" / kind).iterdir()]
    assert files
    for file in files:
        assert f"### {file.stem}\n" in text
        assert file.read_text().rstrip() in text


def test_each_numeric_room_has_a_page_and_a_place(pages: ModuleType) -> None:
    placed = (ROOT / "mkdocs.yml").read_text()
    for room in pages.NUMERIC:
        assert f"- reference/api/{room}.md\n" in placed
        files = re.findall(r"^::: robocal_ros\.(\w+)\.(\w+)$", pages.numeric(room), re.M)
        assert {folder for folder, _ in files} == {room}
        shown = {stem for _, stem in files}
        assert not shown & {"node", "services", "messages", "cli"}
        assert len(shown) > 3 - (room == "motion")
    assert "robocal_ros.kinematics.arm\n" in pages.numeric("kinematics")


@pytest.mark.ros
@pytest.mark.skipif(not MKDOCS.exists(), reason="make docs has not installed mkdocs")
def test_it_is_built_without_a_warning(pages: ModuleType, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("sys.argv", ["site_pages.py", str(tmp_path / "out" / "docs")])
    monkeypatch.setenv("COLUMNS", "100")
    pages.main()
    (tmp_path / "mkdocs.yml").write_text((ROOT / "mkdocs.yml").read_text())
    (tmp_path / "robocal_ros").symlink_to(ROOT / "robocal_ros")
    done = subprocess.run(
        [MKDOCS, "build", "--strict"],
        cwd=tmp_path, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    site = tmp_path / "out" / "site"
    assert (site / "index.html").is_file()
    for room in pages.NUMERIC:
        page = (site / "reference" / "api" / f"{room}.html").read_text()
        assert 'class="doc doc-heading"' in page
    least_squares = (site / "reference" / "api" / "estimation.html").read_text()
    assert 'id="robocal_ros.estimation.assessment.Judgement"' in least_squares
    assert "predicted_rms_m" in least_squares
