# SPDX-License-Identifier: Apache-2.0
"""docs/tutorials.md on the real measurements that it names: its commands, and what it shows."""

import re
import shlex
from pathlib import Path

import pytest
from command import ROOT, robocal

from bench import ur10_campaigns

pytestmark = pytest.mark.data

ROBOCAL, SCRIPT = ".venv/bin/robocal ", ".venv/bin/python bench/ur10_campaigns.py "
# Commands, and what they print.
STEP = re.compile(r"```bash\n(.*?)```\n\n((?:    [^\n]*\n)*)", re.DOTALL)


def steps(section: str) -> list[tuple[list[str], list[str]]]:
    """Lines that are typed, and lines that the page shows of what they print."""
    page = (ROOT / "docs/tutorials.md").read_text()
    text = next(part for part in page.split("\n## ") if part.startswith(section))
    return [(typed.splitlines(), shown.splitlines()) for typed, shown in STEP.findall(text)]


@pytest.mark.parametrize("section", ["A robot's model", "A line laser"])
def test_a_tutorial_runs_as_typed_and_shows_what_comes(
    section: str, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    found = steps(section)
    assert len(found) >= 4
    for typed, shown in found:
        printed = ""
        for line in typed:
            line = line.replace("$ROBOCAL_DATA", str(data_dir))
            if line.startswith(SCRIPT):
                assert ur10_campaigns.main(shlex.split(line.removeprefix(SCRIPT))) == 0
                printed += capsys.readouterr().out
                continue
            words, _, file = line.removeprefix(ROBOCAL).partition(" > ")
            done = robocal(*shlex.split(words))
            assert done.returncode == 0, (words, done.stderr)
            printed += done.stdout
            if file:
                Path(file).write_text(done.stdout)
        lines = {" ".join(line.split()) for line in printed.splitlines()}
        for line in shown:
            assert " ".join(line.split()) in lines, (line, printed)
    if section == "A robot's model":
        assert "<svg" in Path("out/ur10/joints.svg").read_text()
        assert "<robot" in Path("out/ur10/ur10.urdf").read_text()
