# SPDX-License-Identifier: Apache-2.0
"""The commands of the documentation run as they are typed, after ``make demo``."""

import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from command import ROOT, environment, robocal
from long_form import more

PREFIX = ".venv/bin/robocal "
PAGES = [
    f"docs/{name}.md" for name in ("README", "install", *more("identify", "history", "replay"))
]
# Sections of docs/replay.md that show what their first command prints.
SHOWN = ("replay", "validate")
REPLAY = ("replay", "bags/demo_shift.mcap", "--robot", "kr150_r3100", "--auto")


def test_tests_that_pages_name_are_there() -> None:
    """Who looks for what shows a promise finds it."""
    named = [
        (page.name, *found)
        for page in (ROOT / "docs").glob("*.md")
        for found in re.findall(r"`(test/[\w/]+\.py)(?:::(\w+))?`", page.read_text())
    ]
    assert len(named) > 20
    for page, path, name in named:
        file = ROOT / path
        assert file.is_file(), f"{page}: {path}"
        assert not name or f"def {name}(" in file.read_text(), f"{page}: {path}::{name}"


@pytest.mark.parametrize(
    "node", ["thermal_node", "tcf_node", "hand_eye_node", "adapter_node", "cell_sim_node"]
)
def test_the_page_of_a_node_has_its_outputs_and_services(node: str) -> None:
    """But the twins for a PLC of services that are there."""
    page = (ROOT / "docs" / f"{node}.md").read_text()
    names = (ROOT / "test" / "public_names.txt").read_text()
    declared = {*re.findall(rf"^{node} (?:publishes|serves|executes) (\S+)", names, re.MULTILINE)}
    wanted = {name for name in declared if name.removesuffix("_trigger") not in declared - {name}}
    assert wanted
    assert {name for name in wanted if f"`{name}`" not in page} == set()


def commands(page: str) -> list[list[str]]:
    text = (ROOT / page).read_text().replace("\\\n", " ")
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    typed = [line.removeprefix(PREFIX) for line in lines if line.startswith(PREFIX)]
    return [shlex.split(line.split(" > ")[0], comments=True) for line in typed]


def test_the_thermal_page_runs_as_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bags").symlink_to(ROOT / "bags")
    make = [sys.executable, ROOT / "docs/examples/make_thermal.py", "out/thermal"]
    subprocess.run(make, check=True, env=environment())
    typed = commands("docs/thermal.md")
    assert len(typed) == 7
    printed = {}
    for words in typed:
        done = robocal(*words)
        assert done.returncode == 0, (words, done.stderr)
        printed.setdefault(words[1], done.stdout)
    assert printed["identify"].splitlines()[0] in (ROOT / "docs/thermal.md").read_text()


@pytest.mark.long
def test_the_hand_eye_page_runs_as_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bags").symlink_to(ROOT / "bags")
    make = [sys.executable, ROOT / "bags/make_hand_eye.py", "--csv", "out/hand_eye"]
    subprocess.run(make, check=True, env=environment())
    page = (ROOT / "docs/hand_eye.md").read_text()
    typed = re.findall(rf"^{re.escape(PREFIX)}(.*)$", page, re.MULTILINE)
    assert len(typed) == 9
    printed = []
    for line in typed:
        words, _, file = line.partition(" > ")
        done = robocal(*shlex.split(words))
        assert done.returncode == 0, (words, done.stderr)
        printed.append(done.stdout)
        if file:
            Path(file).write_text(done.stdout)
    assert printed[0].splitlines()[0] in page


@cache
def run_once(*words: str) -> subprocess.CompletedProcess[str]:
    """What several pages say, of files of the repository alone."""
    return robocal(*words)


@pytest.fixture(scope="module")
def demo_state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A history that stands for the demo's."""
    state = tmp_path_factory.mktemp("demo") / "state"
    assert robocal("replay", str(ROOT / REPLAY[1]), *REPLAY[2:], "--state", state).returncode == 0
    return state


@pytest.mark.parametrize("page", PAGES)
def test_commands_run_as_typed(
    page: str, demo_state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("docs", "bags"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    typed = commands(page)
    assert typed
    shutil.copytree(demo_state, "out/state")
    printed = []
    for words in typed:
        run = robocal if any(word.startswith("out/") for word in words) else run_once
        done = run(*words)
        assert done.returncode == 0, (words, done.stderr)
        printed.append(done.stdout)
    if page == "docs/replay.md":
        for name in SHOWN:
            first = [words[0] for words in typed].index(name)
            assert_shown(page, name, printed[first].splitlines())


def assert_shown(page: str, section: str, printed: list[str]) -> None:
    """A section's first indented lines are what was printed; "…" stands for lines left out."""
    (_, text) = (ROOT / page).read_text().split(f"## robocal {section}\n")
    block = re.search(r"(?:^    .*\n)+", text, re.MULTILINE)[0]
    at, left_out = 0, False
    for line in block.splitlines():
        if line.strip() == "…":
            left_out = True
            continue
        while left_out and at < len(printed) and not alike(line, printed[at]):
            at += 1
        assert at < len(printed), (page, line)
        assert alike(line, printed[at]), (line, printed[at])
        at, left_out = at + 1, False
    assert at == len(printed), printed[at:]


def alike(shown: str, printed: str) -> bool:
    """The same words; of numbers another machine may round the last digit the other way."""
    words, others = shown.split(), printed.split()
    pairs = zip(words, others, strict=False)
    return len(words) == len(others) and all(one == two or nearly(one, two) for one, two in pairs)


def nearly(shown: str, printed: str) -> bool:
    number = re.compile(r"-?\d+\.(\d+)(%?)")
    one, two = number.fullmatch(shown), number.fullmatch(printed)
    if one is None or two is None or (len(one[1]), one[2]) != (len(two[1]), two[2]):
        return False
    away = float(shown.rstrip("%")) - float(printed.rstrip("%"))
    return abs(away) < 1.5 * 10.0 ** -len(one[1])
