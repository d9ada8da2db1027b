# SPDX-License-Identifier: Apache-2.0
"""No name that others rely on comes or goes unnoticed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from domains import free_domain

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "test" / "public_names.txt"
SCRIPT = ROOT / "tools" / "public_names.py"


def test_the_kept_list_is_what_the_programs_have() -> None:
    with free_domain() as domain:
        done = subprocess.run(
            [sys.executable, SCRIPT],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    found, kept = ({*text.splitlines()} for text in (done.stdout, KEPT.read_text()))
    if found != kept:
        said = [
            *(f"gone: {name}" for name in sorted(kept - found)),
            *(f"new: {name}" for name in sorted(found - kept)),
            "write what is meant, with its reason, into CHANGELOG.md, and the list by",
            "tools/with_ros python tools/public_names.py >test/public_names.txt",
        ]
        pytest.fail("\n".join(said))
