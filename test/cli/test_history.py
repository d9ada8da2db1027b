# SPDX-License-Identifier: Apache-2.0
import getpass
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import conforms, environment, robocal, robocal_json
from forked import HANGS_S
from jsonschema import ValidationError

from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import CalibrationState, CorrectionRecord, Proposal

SERIAL = "KR/7"
STAMP_NS = 1_700_000_000_123_456_789


def proposal(**changes: Any) -> Proposal:
    plain: dict[str, Any] = {
        "model_hash": "0123456789abcdef",
        "based_on": 0,
        "cycle_id": "morning [bold]",
        "stamp_ns": STAMP_NS,
        "created_ns": STAMP_NS + 1,
        "software": "0.1.0",
        "method": "map",
        "code": Code.ACCEPT,
        "reason": "0.11 mm instead of 0.31 mm",
        "candidate_rms_mm": 0.11,
        "document": {"verdict": {"accept": True}},
        "model": {"d": [0.1, 1 / 3]},
        "inputs": {"q": np.zeros((5, 6))},
    }
    return Proposal(**(plain | changes))


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """One calibration in force (1), one pending (2), one refused by its verdict (3)."""
    with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
        first = history.propose(proposal())
        history.accept(first, by="node", reason="", wall_ns=STAMP_NS + 2)
        history.propose(proposal(based_on=1))
        history.propose(
            proposal(based_on=1, code=Code.WORSE_THAN_CURRENT, candidate_rms_mm=None, reason="no")
        )
    return tmp_path


def head(state: Path) -> tuple[int, int | None]:
    with CalibrationHistory.open(SERIAL, state_dir=state) as history:
        found = history.head()
    return found.revision, found.calibration_id


class TestReading:
    def test_list(self, state):
        document = robocal_json("history.list.json", "history", "list", "--state", state)
        assert document["serial"] == SERIAL
        assert document["file"] == str(state / "KR%2F7.sqlite")
        assert document["damaged"] is None
        assert document["in_force"] == [{"kind": "thermal", "revision": 1, "calibration_id": 1}]
        found = [(c["id"], c["state"], c["code"]) for c in document["calibrations"]]
        assert found == [
            (3, "refused", "WORSE_THAN_CURRENT"),
            (2, "pending", "ACCEPT"),
            (1, "in_force", "ACCEPT"),
        ]
        first = document["calibrations"][2]
        assert first["stamp_ns"] == STAMP_NS
        assert first["decisions"][0]["by"] == "node"
        one = robocal_json("history.list.json", "history", "list", "--state", state, "--limit", "1")
        assert [c["id"] for c in one["calibrations"]] == [3]
        most = str(2**70)  # beyond what SQLite counts to
        every = ("history", "list", "--state", state, "--limit", most)
        assert robocal_json("history.list.json", *every) == document

    def test_corrections(self, state):
        name = "history.corrections.json"
        call = ("history", "corrections", "--state", state)
        assert robocal_json(name, *call)["corrections"] == []
        assert "Nothing yet" in robocal(*call).stdout
        first = CorrectionRecord(
            wall_ns=STAMP_NS,
            software="0.1.0",
            model_hash="0123456789abcdef",
            enabled=False,
            shadow=False,
            model_revision=0,
            tool_revision=0,
            reference="calibrated",
            reference_source="/robots/cold [1].yaml",
            reference_name="cold",
            reference_hash="fedcba9876543210",
            taught_tool=(0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0),
        )
        second = replace(first, wall_ns=STAMP_NS + 1, enabled=True, model_revision=3)
        with CalibrationHistory.open(SERIAL, state_dir=state) as history:
            for record in (first, second):
                history.note_correction(record)
        found = robocal_json(name, *call)["corrections"]
        assert [c["model_revision"] for c in found] == [3, 0]
        assert [
            CorrectionRecord(**c | {"taught_tool": tuple(c["taught_tool"])}) for c in found
        ] == [
            second,
            first,
        ]
        assert robocal_json(name, *call, "--limit", "1")["corrections"] == found[:1]
        assert robocal_json(name, *call, "--limit", str(2**70))["corrections"] == found
        lines = robocal(*call).stdout.splitlines()
        for line, words in zip(lines[-2:], (("on", "3"), ("off", "none")), strict=True):
            assert {*words, "taught", "calibrated", "[1].yaml", "fedcba98"} <= set(line.split())
            assert "2023-11-14 22:13:20" in line

    def test_list_for_people(self, state):
        done = robocal("history", "list", ROBOCAL_STATE=str(state))
        assert done.returncode == 0
        assert "Robot KR/7" in done.stdout
        assert "morning [bold]" in done.stdout  # not taken for markup
        assert "2023-11-14 22:13:20" in done.stdout
        assert "In force: calibration 1, thermal revision 1" in done.stdout
        assert done.stderr == ""

    def test_show(self, state):
        document = robocal_json("history.show.json", "history", "show", "1", "--state", state)
        assert document["calibration"]["state"] == "in_force"
        assert document["model"] == {"d": [0.1, 1 / 3]}
        assert document["document"] == {"verdict": {"accept": True}}
        assert document["inputs"] == {"q": {"dtype": "float64", "shape": [5, 6]}}
        done = robocal("history", "show", "3", "--state", state)
        assert done.returncode == 0
        assert "WORSE_THAN_CURRENT" in done.stdout
        assert "float64 5 x 6" in done.stdout

    def test_reading_starts_no_history(self, tmp_path):
        for more in ((), ("--robot-serial", "KR-8")):
            robocal_json(
                "error.json", "history", "list", "--state", tmp_path / "new", *more, status=2
            )
        assert not (tmp_path / "new").exists()

    def test_serial_must_be_named_among_several(self, state):
        with CalibrationHistory.open("UR-2", state_dir=state) as history:
            history.propose(proposal())
        document = robocal_json("error.json", "history", "list", "--state", state, status=2)
        assert "KR/7, UR-2" in document["error"]["message"]
        document = robocal_json(
            "history.list.json", "history", "list", "--state", state, "--robot-serial", "UR-2"
        )
        assert document["serial"] == "UR-2"
        assert document["in_force"] == []

    def test_schema_is_strict(self, state):
        document = robocal_json("history.list.json", "history", "list", "--state", state)
        for change in ({"extra": 1}, {"in_force": None}, {"calibrations": [{"id": 1}]}):
            with pytest.raises(ValidationError):
                conforms(document | change, "history.list.json")
        with pytest.raises(ValidationError):
            conforms({"error": {"code": "CONFLICT"}}, "history.list.json")


class TestDeciding:
    def test_accept(self, state):
        before = time.time_ns()
        document = robocal_json(
            "history.decision.json",
            *("history", "accept", "2", "--state", state),
            *("--by", "Ada", "--reason", "probe", "--expect-revision", "1"),
        )
        assert head(state) == (2, 2)
        assert (document["revision"], document["calibration_id"]) == (2, 2)
        assert document["verdict"]["accept"]
        with CalibrationHistory.open(SERIAL, state_dir=state) as history:
            decision = history.get(2).decisions[-1]
            assert history.get(1).state is CalibrationState.SUPERSEDED
        assert (decision.by, decision.reason) == ("Ada", "probe")
        assert before < decision.wall_ns < time.time_ns()

    def test_default_name(self, state):
        document = robocal_json("history.decision.json", "history", "reject", "2", "--state", state)
        assert document["by"] == getpass.getuser()
        assert head(state) == (1, 1)

    def test_for_people(self, state):
        done = robocal("history", "accept", "2", "--state", state)
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == "Calibration 2 is in force as thermal revision 2\n"
        done = robocal("history", "rollback", "--state", state)
        assert done.stdout == "Calibration 1 is in force again, as thermal revision 3\n"

    @pytest.mark.parametrize(
        ("arguments", "status", "code"),
        [
            (("accept", "1"), 3, "CONFLICT"),
            (("accept", "2", "--expect-revision", "0"), 3, "CONFLICT"),
            (("accept", "3"), 3, "WORSE_THAN_CURRENT"),
            (("accept", "9"), 2, "BAD_INPUT"),
            (("accept", "-1"), 2, "BAD_INPUT"),
            (("accept", "99999999999999999999"), 2, "BAD_INPUT"),
            (("show", "9"), 2, "BAD_INPUT"),
            (("reject", "1"), 3, "CONFLICT"),
            (("rollback", "--to", "2"), 3, "CONFLICT"),
            (("rollback", "--kind", "camera"), 2, "BAD_INPUT"),
            (("rollback", "--expect-revision", "7"), 3, "CONFLICT"),
            (("accept", "2", "--by", os.fsdecode(b"\xff")), 2, "BAD_INPUT"),
        ],
    )
    def test_refusals_change_nothing(self, state, arguments, status, code):
        document = robocal_json(
            "error.json", "history", *arguments, "--state", state, status=status
        )
        assert document["error"]["code"] == document["verdict"]["code"] == code
        assert head(state) == (1, 1)

    def test_a_tool_of_another_thermal_model(self, state):
        with CalibrationHistory.open(SERIAL, state_dir=state) as history:
            tools = [
                history.propose(proposal(kind="tool", model={"thermal_revision": revision}))
                for revision in (0, 1)
            ]
        given = ("history", "accept", tools[0], "--state", state)
        document = robocal_json("error.json", *given, status=3)
        assert document["error"]["code"] == "STALE"
        assert "thermal revision 0, in force is 1: measure it again" in document["error"]["message"]
        done = robocal("history", "accept", tools[1], "--state", state)
        assert done.stdout == f"Calibration {tools[1]} is in force as tool revision 1\n"

    def test_a_kind_is_told_as_it_is_named(self, state):
        kind = "hand_eye/LLT30_front"
        with CalibrationHistory.open(SERIAL, state_dir=state) as history:
            sensor = history.propose(proposal(kind=kind))
        done = robocal("history", "accept", sensor, "--state", state)
        assert done.stdout == f"Calibration {sensor} is in force as {kind} revision 1\n"

    def test_rollbacks(self, state):
        def rollback(*more):
            return robocal_json(
                "history.decision.json", "history", "rollback", "--state", state, *more
            )

        assert rollback()["calibration_id"] is None
        assert rollback("--to", "1")["revision"] == 3
        assert rollback("--to", "nominal")["revision"] == 4
        assert rollback("--to", "1", "--expect-revision", "4")["revision"] == 5
        assert rollback("--to", "previous")["calibration_id"] is None
        assert head(state) == (6, None)
        document = robocal_json("history.list.json", "history", "list", "--state", state)
        assert document["in_force"] == [{"kind": "thermal", "revision": 6, "calibration_id": None}]
        assert (
            "the nominal model, thermal revision 6"
            in robocal("history", "list", "--state", state).stdout
        )

    def test_two_commands_at_once(self, state):
        command = [sys.executable, "-m", "robocal_ros.cli.main", "history", "accept", "2", "--json"]
        both = [
            subprocess.Popen(
                [*command, "--state", str(state)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment(),
            )
            for _ in range(2)
        ]
        said = [json.loads(process.communicate(timeout=HANGS_S)[0]) for process in both]
        assert sorted(process.returncode for process in both) == [0, 3]
        for document in said:
            conforms(document, "history.decision.json")
        assert sorted(document["verdict"]["code"] for document in said) == ["ACCEPT", "CONFLICT"]
        assert head(state) == (2, 2)


class TestTrouble:
    def test_damaged_file_is_reported_and_not_touched(self, state):
        path = state / "KR%2F7.sqlite"
        path.write_bytes(b"\xff" * 5000)
        document = robocal_json("error.json", "history", "list", "--state", state, status=2)
        assert document["error"]["code"] == "STORAGE_FAILED"
        assert "thermal_node" in document["error"]["message"]
        assert path.read_bytes() == b"\xff" * 5000
        assert not list(state.glob("*damaged*"))

    def test_what_an_owner_set_aside_is_told_until_it_is_acknowledged(self, state):
        path = state / "KR%2F7.sqlite"
        path.write_bytes(b"\xff" * 5000)
        CalibrationHistory.open(SERIAL, state_dir=state).close()
        for _ in range(2):
            document = robocal_json("history.list.json", "history", "list", "--state", state)
            assert Path(document["damaged"]).read_bytes() == b"\xff" * 5000
            assert document["calibrations"] == []
        done = robocal("history", "list", "--state", state)
        assert "The history was damaged and is kept as" in done.stdout
        given = "history", "acknowledge", "--by", "Ada", "--state", state
        document = robocal_json("history.acknowledge.json", *given)
        (aside,) = document["acknowledged"]
        assert Path(aside).read_bytes() == b"\xff" * 5000
        assert document["damaged"] is None
        assert robocal_json("history.acknowledge.json", *given)["acknowledged"] == []
        document = robocal_json("history.list.json", "history", "list", "--state", state)
        assert document["damaged"] is None

    def test_state_is_no_folder(self, tmp_path):
        place = tmp_path / "file"
        place.write_text("")
        more = ("--robot-serial", "x", "--state", place)
        document = robocal_json("error.json", "history", "list", *more, status=2)
        assert document["error"]["code"] in ("BAD_INPUT", "STORAGE_FAILED")
        assert place.read_text() == ""
