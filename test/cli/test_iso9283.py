# SPDX-License-Identifier: Apache-2.0
"""``robocal iso9283``: the figures of a table, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import conforms

from robocal_ros.cli.main import main

CROSS = ["101,2,3", "99,2,3", "100,4,3", "100,0,3"]  # as in test/identification/test_iso9283.py
HEADER = "x_mm,y_mm,z_mm"


@pytest.fixture
def measure(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Run the command on a table: exit status and its one document, checked."""

    def run(lines: list[str], *arguments: str) -> tuple[int, Any]:
        path = tmp_path / "positions.csv"
        path.write_text("\n".join(lines) + "\n")
        status = main(["iso9283", "--data", str(path), *arguments, "--json"])
        document = json.loads(capsys.readouterr().out)
        conforms(document, "iso9283.json")
        return status, document

    return run


def test_a_table_without_targets(measure) -> None:
    status, document = measure([HEADER, *CROSS], "--commanded", "97,-2,15")
    assert status == 0
    (name,) = document["targets"]
    found = document["targets"][name]
    assert found["n"] == 4
    assert found["AP_mm"] == pytest.approx(13.0)
    assert found["mean_distance_mm"] == pytest.approx(1.5)
    assert found["S_mm"] == pytest.approx(np.sqrt(1 / 3))
    assert found["RP_mm"] == pytest.approx(1.5 + 3 * np.sqrt(1 / 3))
    axes = [found[f"AP_{axis}_mm"] for axis in "xyz"]
    assert axes == pytest.approx([3.0, 4.0, -12.0])
    (warning,) = document["warnings"]
    assert "4 cycles; ISO 9283 asks for 30" in warning


def test_without_a_commanded_position_accuracy_is_null(measure) -> None:
    _, document = measure([HEADER, *CROSS * 8])
    (found,) = document["targets"].values()
    assert found["AP_mm"] is found["AP_x_mm"] is None
    assert found["RP_mm"] > 0.0
    assert document["warnings"] == []


def test_a_negative_commanded_position(measure) -> None:
    _, document = measure([HEADER, "-1,-2,-3", "-1,-2,-3"], "--commanded", "-1,-2,-4")
    (found,) = document["targets"].values()
    assert found["AP_z_mm"] == pytest.approx(1.0)


class TestSeveralTargets:
    LINES = ("target,x_mm,y_mm,z_mm", *(f"p{i},{i},{k},0" for k in (-1, 1) for i in (1, 2)))

    def test_each_has_its_own(self, measure) -> None:
        given = ("--commanded", "p1=1,0,1", "--commanded", "p2=2,0,0")
        _, document = measure(list(self.LINES), *given)
        assert list(document["targets"]) == ["p1", "p2"]
        assert document["targets"]["p1"]["AP_mm"] == pytest.approx(1.0)
        assert document["targets"]["p2"]["AP_mm"] == pytest.approx(0.0)
        assert not any("taken for" in words for words in document["warnings"])

    def test_one_that_has_none_is_null(self, measure) -> None:
        _, document = measure(list(self.LINES), "--commanded", "p2=2,0,0")
        assert document["targets"]["p1"]["AP_mm"] is None

    def test_one_position_for_all_is_said(self, measure) -> None:
        _, document = measure(list(self.LINES), "--commanded", "1,0,0")
        assert document["targets"]["p2"]["AP_mm"] == pytest.approx(1.0)
        assert any("taken for the targets p1, p2" in words for words in document["warnings"])

    @pytest.mark.parametrize("own", [("p1=1,0,0",), ("p1=1,0,0", "p2=2,0,0")])
    def test_where_at_most_one_takes_the_plain_one_nothing_is_said(
        self, measure, own: tuple[str, ...]
    ) -> None:
        arguments = [word for value in ("2,0,0", *own) for word in ("--commanded", value)]
        _, document = measure(list(self.LINES), *arguments)
        errors = [found["AP_mm"] for found in document["targets"].values()]
        assert errors == pytest.approx([0.0, 0.0], abs=1e-9)
        assert not any("taken for" in words for words in document["warnings"])

    def test_one_with_a_single_row_is_refused_by_name(self, measure) -> None:
        status, document = measure([*self.LINES, "lonely,1,2,3"])
        assert status == 3
        assert document["error"]["code"] == "TOO_FEW_SAMPLES"
        assert "positions.csv, target 'lonely': 1 position" in document["error"]["message"]


@pytest.mark.parametrize(
    ("lines", "place", "words"),
    [
        ([HEADER, "1,2,3", "1,2,x"], (3, "z_mm"), "'x' is not a number"),
        ([HEADER, "1,2,3", "1,nan,3"], (3, "y_mm"), "'nan' is not a finite number"),
        ([HEADER, "1,2,3", "1,2"], (3, None), "2 cells, but the header has 3"),
        (["x_mm,y_mm", "1,2"], (1, None), "column z_mm is missing"),
        (["x_mm,y_mm,z_m", "1,2,3"], (1, "z_m"), "z_mm"),
        ([HEADER], (None, None), "no measurements"),
        (["target,x_mm,y_mm,z_mm", ",1,2,3"], (2, "target"), "empty"),
    ],
)
def test_a_bad_table_is_refused_with_its_place(measure, lines, place, words) -> None:
    status, document = measure(lines)
    error = document["error"]
    assert (status, error["code"]) == (2, "BAD_INPUT")
    assert (error["row"], error["column"]) == place
    assert words in error["message"]
    assert error["file"].endswith("positions.csv")


@pytest.mark.parametrize("given", ["1,2", "1,2,x", "1,2,nan", "=1,2,3", "p1=", "1;2;3"])
def test_a_commanded_position_that_is_none(measure, given: str) -> None:
    status, document = measure([HEADER, *CROSS], "--commanded", given)
    assert status == 2
    assert given in document["error"]["message"]


@pytest.mark.parametrize(
    ("given", "words"),
    [(("q=1,2,3",), "no target 'q'"), (("1,2,3", "4,5,6"), "given twice")],
)
def test_commanded_positions_that_do_not_fit(measure, given, words: str) -> None:
    arguments = [word for value in given for word in ("--commanded", value)]
    status, document = measure([HEADER, *CROSS], *arguments)
    assert status == 2
    assert words in document["error"]["message"]
