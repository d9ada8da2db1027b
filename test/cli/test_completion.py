# SPDX-License-Identifier: Apache-2.0
"""What a real bash is offered behind `robocal`, by argcomplete's own registration."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command import ROOT
from forked import HANGS_S

pytest.importorskip("argcomplete")
SHELL = """
eval "$(register-python-argcomplete robocal)"
COMP_LINE=$1 COMP_POINT=${#1} COMP_TYPE=9 _python_argcomplete robocal
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def offered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bin")
    command = folder / "robocal"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m robocal_ros.cli.main "$@"\n')
    command.chmod(0o755)
    scripts = Path(sys.executable).parent
    paths = {"PATH": f"{folder}:{scripts}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}

    def ask(line, **variables):
        done = subprocess.run(
            ["bash", "-c", SHELL, "bash", line],
            env=os.environ | paths | variables,
            cwd=folder, capture_output=True, text=True, timeout=HANGS_S, check=True,
        )  # fmt: skip
        assert not done.stderr
        return {word.strip() for word in done.stdout.splitlines() if word.strip()}

    return ask


@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("robocal han", {"hand-eye"}),
        ("robocal hand-eye ", {"sphere", "step", "line", "camera", "tracker", "verify"}),
        ("robocal hand-eye sphere --pr", {"--profiles"}),
        ("robocal tool export --format ka", {"kawasaki"}),
        ("robocal identify --method ", {"map", "lsq"}),
        ("robocal --json history ac", {"accept", "acknowledge"}),
        ("robocal no-such-command --", set()),
    ],
)
def test_what_a_shell_is_offered(offered, line, some):
    found = offered(line)
    assert found >= some
    begun = line.rpartition(" ")[2]
    assert all(word.startswith(begun) for word in found)


def test_files_are_offered_where_a_file_is_wanted(offered, tmp_path):
    (tmp_path / "poses.csv").touch()
    assert offered(f"robocal identify --data {tmp_path}/po") == {f"{tmp_path}/poses.csv"}


def test_nothing_is_loaded_for_it_otherwise():
    asked = "import sys; from robocal_ros.cli import main; print('argcomplete' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
