# SPDX-License-Identifier: Apache-2.0
"""Programs of other people's robots: where nothing is to be corrected not a byte changes.

They are not shipped: the folder that `ROBOCAL_PROGRAMS` names holds them, such as clones of the
repositories that docs/programs.md names; without it the test is skipped. The robots of these
programs are unknown here: a KR 150 runs what it reaches of them, with frames that are not given at
its base and flange.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from bench.robot_programs import NOMINAL
from robocal_ros.programs.correcting import DIALECTS, ProgramCorrection, report
from robocal_ros.programs.points import Dialect
from robocal_ros.programs.postures import CorrectionModels

pytestmark = pytest.mark.data
FOLDER = os.environ.get("ROBOCAL_PROGRAMS", "")
LEAST_FILES, MOST_FILES, MOST_POINTS = 3, 40, 120  # of a maker; of a file: each is solved
MAKERS = [dialect for dialect in DIALECTS if dialect.maker != "ur"]  # of which none are public


def texts(dialect: Dialect) -> list[tuple[Path, str]]:
    """Programs of a maker with points, spread over the folder; long ones where few are short."""
    found, short = [], []
    for path in sorted(p for p in Path(FOLDER).rglob("*") if p.suffix.lower() in dialect.suffixes):
        data = path.read_bytes()
        if b"\0" in data:  # of two bytes a character, or none
            continue
        text = data.decode("latin-1")
        if count := len(dialect.read(text).points):
            found.append((path, text))
            short += found[-1:] if count <= MOST_POINTS else []
    found = short if len(short) >= LEAST_FILES else found
    return found[:: max(1, len(found) // MOST_FILES)][:MOST_FILES]


@pytest.mark.skipif(not FOLDER, reason="ROBOCAL_PROGRAMS names no folder of programs")
@pytest.mark.parametrize("dialect", MAKERS, ids=lambda dialect: dialect.maker)
def test_where_nothing_is_to_be_corrected_not_a_byte_changes(dialect: Dialect) -> None:
    models = CorrectionModels(NOMINAL, NOMINAL, NOMINAL)
    still, programs = {number: np.zeros(3) for number in range(1, 7)}, texts(dialect)
    assert len(programs) >= LEAST_FILES
    unchanged = points = 0
    for path, text in programs:
        read = dialect.read(text)
        for point in read.points:
            assert all(text[one.start : one.end] == one.text for one in point.fields), path
        names = {name for p in read.points for name in (p.tool, p.frame) if name is not None}
        given = {name: np.eye(4) for name in (*names, "none") if name not in read.frames}
        correction = ProgramCorrection(
            dialect, models, given, "none", "none", np.zeros(NOMINAL.n), still
        )
        done = correction.correct(text)
        assert done.text == text, path
        count = report(done)["count"]
        assert count["corrected"] == 0, path
        unchanged, points = unchanged + count["unchanged"], points + len(read.points)
    print(f"{dialect.maker}: {len(programs)} files, {points} points, {unchanged} reached")
    assert unchanged > 0
