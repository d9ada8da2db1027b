# SPDX-License-Identifier: Apache-2.0
"""docs/tutorials.md on the real measurements that it names: its commands, and what it shows."""

import re
import shlex
from pathlib import Path

import pytest
from command import ROOT, robocal

pytestmark = pytest.mark.data

ROBOCAL = ".venv/bin/robocal "
# Commands, and what they print.
STEP = re.compile(r"```bash\n(.*?)```\n\n((?:    [^\n]*\n)*)", re.DOTALL)


def steps(section: str) -> list[tuple[list[str], list[str]]]:
    """Lines that are typed, and lines that the page shows of what they print."""
    page = (ROOT / "docs/tutorials.md").read_text()
    text = next(part for part in page.split("\n## ") if part.startswith(section))
    return [(typed.splitlines(), shown.splitlines()) for typed, shown in STEP.findall(text)]


@pytest.mark.parametrize("section", ["A robot's model", "A line laser"])
def test_a_tutorial_runs_as_typed_and_shows_what_comes(
    section: str, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    found = steps(section)
    assert len(found) >= 4
    for typed, shown in found:
        printed = ""
        for line in typed:
            words, _, file = line.removeprefix(ROBOCAL).partition(" > ")
            done = robocal(*shlex.split(words), ROBOCAL_DATA=str(data_dir))
            assert done.returncode == 0, (words, done.stderr)
            printed += done.stdout
            if file:
                Path(file).write_text(done.stdout)
        lines = {" ".join(line.split()) for line in printed.splitlines()}
        for line in shown:
            assert " ".join(line.split()) in lines, (line, printed)
    if section == "A robot's model":
        assert "<svg" in Path("out/ur10/joints.svg").read_text()
        assert "<svg" in Path("out/ur10/errors.svg").read_text()
        assert "<robot" in Path("out/ur10/ur10.urdf").read_text()
