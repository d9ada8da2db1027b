# SPDX-License-Identifier: Apache-2.0
"""``robocal validate``: what the page says is what the replay and the truth say."""

import contextlib
import csv
import io
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign import POINTS, ROBOT, postures, true_arm
from command import ROOT, beyond_rounding, conforms
from forked import HANGS_S
from long_form import more
from recordings import (
    BETWEEN_S,
    EVENTS,
    NS,
    START_NS,
    TYPES,
    plain_bag,
    recorded_bag,
    shift,
    warmed,
    write_samples,
)

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter, read_bag
from robocal_ros.cli.main import main
from robocal_ros.cli.validate import validated
from robocal_ros.cli.validating import Job, require_finite, tool_runs
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import load_robot, save_robot
from robocal_ros.session.events import (
    Command,
    Outcome,
    arguments_text,
    bring_into_force,
    outcome_text,
)

TOOL_RUNS = ROOT / "bags/tool_runs.mcap"
EXCERPT = ROOT / "bags/golden_excerpt.mcap"
TOOL_EVENTS = "/tcf_node/session_events"
SPHERE = ROOT / "bags/hand_eye_sphere.mcap"
CHECK = postures(true_arm(), 20, 77)


def judged_bag(path: Path, visits) -> Path:
    """The plain bag, and where the tool truly was at other poses at the end of each visit."""
    with BagWriter(path) as bag:
        for part, kelvin in zip(visits, (0.0, 20.0, 30.0, 0.0), strict=True):
            write_samples(bag, part)
            flange = warmed(true_arm(), kelvin).fk(CHECK)
            truth = {
                "simulated": True,
                "tool_in_flange_m": POINTS["ball"],
                "q_rad": CHECK.tolist(),
                "position_m": (flange @ [*POINTS["ball"], 1.0])[:, :3].tolist(),
            }
            told = {"data": json.dumps(truth)}
            end_ns = part[-1].stamp_ns + NS // 10
            bag.write("/truth/check_points", "std_msgs/msg/String", told, end_ns)
    return path


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, visits = tmp_path_factory.mktemp("validated"), shift()
    plain_bag(folder / "plain.mcap", visits)
    judged_bag(folder / "judged.mcap", visits)
    recorded_bag(folder / "live.mcap", folder / "state", visits)
    return folder


@pytest.fixture(scope="module")
def validate(tmp_path_factory: pytest.TempPathFactory):
    """Run the command in this process: status, its document, the report's folder and document.

    The same words are run once.
    """

    @cache
    def run(*words: object, jobs: str = "1") -> tuple[int, Any, Path, Any]:
        out = tmp_path_factory.mktemp("report") / "new"
        given = [*map(str, words), "--report", str(out), "--jobs", jobs]
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            status = main(["validate", *given, "--json"])
        document = json.loads(printed.getvalue())
        conforms(document, "validate.json" if "bags" in document else "error.json")
        report = out / "report.json"
        return status, document, out, json.loads(report.read_text()) if report.exists() else None

    return run


def refused(stamp_ns: int, words: str) -> dict[str, Any]:
    """An event of a node whose decisions nothing can replay."""
    command = Command("run_maintenance", {}, stamp_ns)
    return {
        "stamp": ros_time(stamp_ns),
        "command": command.name,
        "arguments": arguments_text(command),
        "outcome": outcome_text(Outcome(command, Code.LIMIT_EXCEEDED, words)),
    }


def judged(bags: Path) -> tuple[object, ...]:
    """Words for a bag with a truth, and one of another robot."""
    return bags / "judged.mcap", TOOL_RUNS, "--robot", ROBOT


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


class TestRecordedSession:
    def test_it_is_the_live_one(self, bags, validate) -> None:
        status, document, _, report = validate(bags / "live.mcap")
        assert status == 0
        (row,) = document["bags"]
        assert (row["as_recorded"], row["differs"]) == (True, 0)
        assert (row["cycles"], row["accepted"]) == (2, 1)
        (session,) = report["bags"][0]["sessions"]
        commands = [decision["command"] for decision in session["decisions"]]
        assert commands == ["capture_reference", "identify", "accept", "identify"]
        assert session["settings"]["drift_parameters"] == []
        assert [c["based_on"] for c in session["cycles"]] == [0, 1]

    def test_errors_are_those_of_the_verdicts(self, bags, validate, capsys) -> None:
        """Against ``robocal replay``, which prints the same candidates."""
        _, _, _, report = validate(bags / "live.mcap")
        main(["replay", str(bags / "live.mcap"), "--json"])
        candidates = json.loads(capsys.readouterr().out)["candidates"]
        cycles = report["bags"][0]["sessions"][0]["cycles"]
        for cycle, candidate in zip(cycles, candidates, strict=True):
            assert cycle["in_force"] == candidate["in_force"]["held_out"]
            assert cycle["candidate"] == candidate["calibrated"]["held_out"]
            assert cycle["verdict"] == candidate["verdict"]
            for name, found in candidate["parameters"].items():
                moved = found["value"] - found["nominal"]
                assert cycle["drift"][name] == pytest.approx(moved, abs=1e-9)
                assert cycle["sigma"][name] == pytest.approx(found["sigma"] or 0.0)

    def test_the_accepted_model_forecasts_the_next_cycle(self, bags, validate) -> None:
        _, _, _, report = validate(bags / "live.mcap")
        first, second = report["bags"][0]["sessions"][0]["cycles"]
        assert first["measured"]["in_force"] == first["measured"]["without"]
        without, in_force = (second["measured"][k]["rms_mm"] for k in ("without", "in_force"))
        assert in_force < 0.6 * without  # 20 of 30 K are known
        assert second["forecast"]["bound_mm"] > second["forecast"]["rms_mm"] > 0.0

    @pytest.mark.long
    def test_another_payload_than_the_models_is_told_once(self, validate, tmp_path) -> None:
        """As of the robot file: the hash of a model does not hold what the arm carries."""
        load = ArmLoad(np.ones(6), np.zeros((6, 3)), 10.0, np.array([0.0, 0.0, 0.1]))
        arms, files, state = {}, {}, tmp_path / "state"
        for kg in (10, 90):
            files[kg] = tmp_path / f"carries_{kg}.yaml"
            arms[kg] = replace(load_robot(ROBOT), load=replace(load, payload_mass=float(kg)))
            save_robot(arms[kg], files[kg])
        bag, nominal = tmp_path / "loaded.mcap", arms[10]
        with CalibrationHistory.open(
            "s1", model_hash=nominal.model_hash, state_dir=state
        ) as history:
            identified = model_document(nominal)
            bring_into_force(history, THERMAL, nominal, identified, "test")
        recorded_bag(bag, state, shift(), robot=str(files[90]))
        for kg, told in ((10, 0), (90, 1)):
            status, _, _, report = validate(bag, "--robot", files[kg])
            assert status == 0
            (session,) = report["bags"][0]["sessions"]
            words = [one for one in session["warnings"] if "identified with a payload" in one]
            assert len(words) == told, session["warnings"]
        assert "payload of 10 kg at (0, 0, 100) mm" in words[0]
        assert "the robot file says 90 kg" in words[0]

    def test_a_recording_that_begins_late(self, bags, validate, tmp_path) -> None:
        """In mid-shift: latched topics send anew what is older, a command first, of all nodes.

        Another node's events, which nothing can replay, are told as recorded.
        """
        late_ns = START_NS + 2 * BETWEEN_S * NS + NS // 7
        path = tmp_path / "late.mcap"
        with BagWriter(path, latched=[EVENTS]) as bag:
            again = [r for r in read_bag(bags / "live.mcap") if r.topic == EVENTS][1:]
            again += [r for r in read_bag(TOOL_RUNS) if r.topic == TOOL_EVENTS]
            for recorded in again:
                if recorded.topic == TOOL_EVENTS:
                    recorded.message.stamp.sec = START_NS // NS  # of a run before
                elif recorded.log_time_ns >= late_ns:
                    continue
                bag.write(recorded.topic, recorded.msgtype, recorded.message, late_ns)
            for stamp_ns, words in ((START_NS, "before"), (late_ns + NS, "too short")):
                event = refused(stamp_ns, words)
                bag.write("/plc/session_events", TYPES[EVENTS], event, max(late_ns, stamp_ns))
            for recorded in read_bag(bags / "live.mcap"):
                given = recorded.topic, recorded.msgtype, recorded.message
                if recorded.log_time_ns >= late_ns:
                    bag.write(*given, recorded.log_time_ns)
        status, document, out, report = validate(path)
        assert status == 0
        row, skipped = document["bags"]
        assert (row["cycles"], row["accepted"], row["differs"]) == (1, 0, 0)
        assert skipped["node"] == TOOL_EVENTS
        assert "nobody gave its node a command" in skipped["skipped"]
        (told,) = report["bags"]
        (decision,) = told["other_decisions"]["/plc/session_events"]
        assert (decision["code"], decision["message"]) == ("LIMIT_EXCEEDED", "too short")
        page = (out / "report.html").read_text()
        told_at = datetime.fromtimestamp(late_ns / NS + 1, UTC)
        for words in (f"{told_at:%Y-%m-%d %H:%M:%S}", skipped["skipped"]):
            assert words in page
        _, _, _, whole = validate(bags / "live.mcap")
        (late,), (_, second) = (r["bags"][0]["sessions"][0]["cycles"] for r in (report, whole))
        for name in ("in_force", "candidate", "measured", "drift", "sigma", "verdict"):
            assert late[name] == second[name], name

    def test_a_maintenance_nodes_decisions_alone_are_listed(self, bags, validate, tmp_path) -> None:
        path, topic = tmp_path / "decided.mcap", "/maintenance_node/session_events"
        at_ns = START_NS + NS
        with BagWriter(path) as bag:
            for recorded in read_bag(bags / "plain.mcap"):
                given = recorded.topic, recorded.msgtype, recorded.message
                bag.write(*given, recorded.log_time_ns)
            bag.write(topic, TYPES[EVENTS], refused(at_ns, "too short"), at_ns)
        status, document, out, report = validate(path)
        assert status == 0
        (row,) = document["bags"]
        assert (row["node"], "they are listed" in row["skipped"]) == (topic, True)
        (decision,) = report["bags"][0]["other_decisions"][topic]
        assert (decision["command"], decision["message"]) == ("run_maintenance", "too short")
        assert f"Decisions of {topic}" in (out / "report.html").read_text()

    def test_a_full_tool_runs_sigma_is_the_one_that_was_told_live(self) -> None:
        """The largest of the axes, as of the action ``measure``."""
        run = {"run": 1, "stamp": 1.0, "sigma_mm": [0.02, 0.01, 0.02], "verdict": {}}
        (told,) = tool_runs({"runs": [run]}, [])
        assert told["sigma_mm"] == 0.02


class TestTruth:
    def test_true_errors_of_a_drift_that_was_made(self, bags, validate) -> None:
        status, document, _, report = validate(*judged(bags))
        assert status == 0
        row, _ = document["bags"]
        assert (row["judged_by"], row["simulated"]) == ("truth", True)
        cold, warm = (
            (warmed(true_arm(), kelvin).fk(CHECK) @ [*POINTS["ball"], 1.0])[:, :3]
            for kelvin in (0.0, 20.0)
        )
        first = report["bags"][0]["sessions"][0]["cycles"][0]
        drift_mm = np.linalg.norm(warm - cold, axis=1) * 1e3
        assert first["true"]["without"]["max_mm"] == pytest.approx(drift_mm.max())
        assert first["true"]["without"]["mean_mm"] == pytest.approx(drift_mm.mean())
        assert first["true"]["in_force"] == first["true"]["without"]
        assert first["verdict"]["accept"]
        assert first["true"]["after"]["rms_mm"] < 0.5 * first["true"]["without"]["rms_mm"]

    def test_a_bag_without_a_truth_is_judged_by_measurements(self, bags, validate) -> None:
        _, document, _, report = validate(bags / "plain.mcap", "--robot", ROBOT)
        (row,) = document["bags"]
        assert (row["judged_by"], row["simulated"]) == ("measurements", False)
        (session,) = report["bags"][0]["sessions"]
        assert session["true"] is None
        assert session["as_recorded"] is False
        taken = [c for c in session["cycles"] if c["revision"]]
        assert len(taken) == row["accepted"] > 0
        assert all(cycle["verdict"]["accept"] for cycle in taken)
        codes = [d["code"] for d in session["decisions"] if d["command"] == "accept"]
        assert codes == ["ACCEPT"] * len(taken)


def test_tools_and_sensors(validate) -> None:
    status, document, out, report = validate(TOOL_RUNS, SPHERE)
    assert status == 0
    tool, sensor = document["bags"]
    assert (tool["kind"], tool["runs"]) == ("tool", 5)
    for told in report["bags"]:
        assert not beyond_rounding(told["sessions"][0])
    assert tool["largest_change_mm"] == pytest.approx(np.sqrt(3**2 + 2**2 + 1**2), abs=0.2)
    assert tool["largest_true_error_mm"] < 0.2
    assert sensor["kind"] == "hand_eye"
    assert sensor["true_error_mm"] < 3.0 * sensor["predicted_rms_mm"]
    assert {path.name for path in out.glob("*.png")} == {"tool_runs-tool.png"}
    codes = {row["code"] for row in rows(out / "decisions.csv")}
    assert {"LIMIT_EXCEEDED", "BEAM_EDGES_WRONG"} <= codes


def test_a_bag_of_two_nodes(bags, validate, tmp_path) -> None:
    """Each session takes its own robot's joints from the topic that both write to."""
    path = tmp_path / "both.mcap"
    with BagWriter(path) as bag:
        for source in (bags / "live.mcap", TOOL_RUNS):
            for recorded in read_bag(source):
                given = recorded.topic, recorded.msgtype, recorded.message
                bag.write(*given, recorded.log_time_ns)
    status, document, out, report = validate(path)
    assert status == 0
    rows = {row["kind"]: row for row in document["bags"]}
    tool, thermal = report["bags"][0]["sessions"]
    assert thermal["differs"] == []
    assert not beyond_rounding(tool)
    assert (rows["tool"]["runs"], rows["thermal"]["cycles"]) == (5, 2)
    assert {path.name for path in out.glob("*.png")} == {
        "both-tool.png", "both-cycles.png", "both-drift.png"
    }  # fmt: skip


def test_no_figure_is_written_over_another(validate, tmp_path) -> None:
    """Two tools in one bag; the other bag's name looks like the second of them."""
    twice, other = tmp_path / "tools.mcap", tmp_path / "tools-2.mcap"
    with BagWriter(twice) as bag:
        for recorded in read_bag(TOOL_RUNS):
            given = recorded.msgtype, recorded.message, recorded.log_time_ns
            bag.write(recorded.topic, *given)
            if recorded.topic.endswith("/session_events"):
                bag.write("/other_node/session_events", *given)
    shutil.copy(TOOL_RUNS, other)
    _, document, out, _ = validate(twice, other)
    assert [row["bag"] for row in document["bags"]] == ["tools.mcap"] * 2 + ["tools-2.mcap"]
    assert {path.name for path in out.glob("*.png")} == {
        "tools-tool.png", "tools-tool-2.png", "tools-2-tool.png"
    }  # fmt: skip


class TestBadBags:
    def test_each_is_told_and_the_others_go_on(self, validate, tmp_path) -> None:
        """No bag, none there, and two with a truth that is no number."""
        no_bag, none, state, tool = (
            tmp_path / f"{name}.mcap" for name in ("no_bag", "none", "state", "tool")
        )
        no_bag.write_bytes(b"no bag at all")
        nowhere = json.dumps({"T_flange_tool": np.full((4, 4), np.nan).tolist()})
        for path, topic, told in (
            (state, "/truth/state", '{"faults": {"collision": NaN}}'),
            (tool, "/truth/tool", nowhere),
        ):
            with BagWriter(path) as bag:
                for recorded in read_bag(TOOL_RUNS):
                    if recorded.topic != topic:
                        given = recorded.msgtype, recorded.message, recorded.log_time_ns
                        bag.write(recorded.topic, *given)
                bag.write(topic, "std_msgs/msg/String", {"data": told}, recorded.log_time_ns)
        status, document, out, report = validate(TOOL_RUNS, no_bag, none, state, tool)
        assert status == 3
        assert document["error"]["code"] == "BAD_INPUT"
        assert "4 of 5 bags" in document["error"]["message"]
        good, *bad = document["bags"]
        assert (good["bag"], good["kind"], good["runs"]) == ("tool_runs.mcap", "tool", 5)
        assert [row["bag"] for row in bad] == [path.name for path in (no_bag, none, state, tool)]
        assert [row["kind"] for row in bad] == [None] * 4
        for row, *words in zip(
            bad,
            (no_bag, none, state, tool),
            ("", "", "/truth/state", "/truth/tool"),
            ("", "", "faults.collision is nan", "T_flange_tool"),
            strict=True,
        ):
            assert all(str(said) in row["error"]["message"] for said in words)
        assert "no_bag.mcap" in (out / "report.html").read_text()
        assert len(report["bags"]) == 5
        for name in ("bags.csv", "cycles.csv", "decisions.csv", "hours.csv"):
            assert (out / name).exists()

    def test_no_document_holds_what_json_cannot(self) -> None:
        found = {"sessions": [{"runs": [{"true_error_mm": 0.1}, {"true_error_mm": np.inf}]}]}
        with pytest.raises(InputError, match=r"x\.mcap: sessions\[0\]\.runs\[1\]\.true_error_mm"):
            require_finite(found, "x.mcap")

    def test_a_bag_that_does_not_say_its_robot(self, bags, validate) -> None:
        status, document, _, _ = validate(bags / "plain.mcap")
        assert status == 3
        assert "--robot" in document["error"]["message"]

    def test_a_robot_is_named_for_those_alone_that_do_not_say(self, bags, validate) -> None:
        status, document, _, _ = validate(*judged(bags))
        assert status == 0
        assert [row["robot"] for row in document["bags"]] == ["KR 150 R3100 prime", "UR10"]

    def test_a_crash_is_that_of_its_bag(self) -> None:
        """A path of a wrong type stands for a bug that one bag meets."""
        jobs = [Job(3.5, "x.mcap", None), Job(str(TOOL_RUNS), "tool_runs.mcap", None)]  # type: ignore[arg-type]
        crashed, good = (result for _, result in validated(jobs, 1, None))
        assert crashed.document["error"]["code"] == "NONE"
        assert "TypeError" in crashed.document["error"]["message"]
        assert "sessions" in good.document


def test_bags_of_one_name_are_told_apart(validate, tmp_path) -> None:
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / TOOL_RUNS.name
    other.symlink_to(TOOL_RUNS)  # a link is followed: its name is that of the bag
    _, document, out, _ = validate(TOOL_RUNS, other)
    assert [row["bag"] for row in document["bags"]] == ["tool_runs.mcap", "tool_runs-2.mcap"]
    assert {p.name for p in out.glob("*.png")} == {"tool_runs-tool.png", "tool_runs-2-tool.png"}


class TestInParallel:
    def test_two_processes_give_the_same_report(self, bags, validate, tmp_path) -> None:
        given = (bags / "live.mcap", TOOL_RUNS, tmp_path / "none.mcap")
        _, alone, one, _ = validate(*given)
        _, beside, two, _ = validate(*given, jobs="2")
        assert beside["bags"] == alone["bags"]
        names = sorted(path.name for path in one.iterdir())
        assert sorted(path.name for path in two.iterdir()) == names

        def undated(path: Path) -> bytes:
            return re.sub(rb"20\d\d-\d\d-\d\d \d\d:\d\d UTC", b"", path.read_bytes())

        for name in names:
            assert undated(one / name) == undated(two / name), name

    def test_a_cluster_that_is_there_is_used(self, bags, validate) -> None:
        from distributed import LocalCluster

        options = {"dashboard_address": None, "processes": False, "threads_per_worker": 1}
        with LocalCluster(n_workers=1, **options) as cluster:
            words = ("--scheduler", cluster.scheduler_address)
            status, document, _, _ = validate(TOOL_RUNS, *words)
        assert status == 0
        assert document["bags"][0]["runs"] == 5

    def test_a_cluster_that_is_not_there(self, validate) -> None:
        status, document, _, _ = validate(TOOL_RUNS, "--scheduler", "nonsense://nowhere:1")
        assert status == 2
        assert "--scheduler nonsense://nowhere:1" in document["error"]["message"]

    def test_a_cluster_without_a_worker(self, validate, monkeypatch) -> None:
        from distributed import LocalCluster

        monkeypatch.setattr("robocal_ros.cli.validate.PATIENCE_S", 1)
        with LocalCluster(n_workers=0, dashboard_address=None, processes=False) as cluster:
            status, document, _, _ = validate(TOOL_RUNS, "--scheduler", cluster.scheduler_address)
        assert status == 2
        assert "no worker within 1 s" in document["error"]["message"]

    @pytest.mark.long
    def test_bags_that_a_cluster_took_with_it_are_told(self, validate) -> None:
        from distributed import LocalCluster

        cluster = LocalCluster(n_workers=1, dashboard_address=None, threads_per_worker=1)
        gone = threading.Thread(target=lambda: (until(cluster_works), cluster.close()))

        def cluster_works() -> bool:
            return any(task.state == "processing" for task in cluster.scheduler.tasks.values())

        gone.start()
        status, document, out, _ = validate(
            *8 * [EXCERPT], "--scheduler", cluster.scheduler_address
        )
        gone.join()
        assert status == 3
        assert "8 of 8 bags could not be validated" in document["error"]["message"]
        assert (out / "report.html").exists()

    def test_a_bag_whose_process_is_killed_is_told(self, validate) -> None:
        def kill_one() -> None:
            until(multiprocessing.active_children)
            multiprocessing.active_children()[0].kill()

        killer = threading.Thread(target=kill_one)
        killer.start()
        status, document, _, _ = validate(EXCERPT, TOOL_RUNS, jobs="2")
        killer.join()
        assert status == 3
        assert "1 of 2 bags could not be validated" in document["error"]["message"]
        assert "was killed, for want of memory? Try --jobs 1" in document["error"]["message"]

    @pytest.mark.parametrize("how", [signal.SIGKILL, *more(signal.SIGTERM)])
    def test_no_worker_outlives_the_command(self, tmp_path, how) -> None:
        process = validating(tmp_path / "report")
        process.send_signal(how)
        process.wait(HANGS_S)

        def group_is_gone() -> bool:
            try:
                os.killpg(process.pid, 0)
            except ProcessLookupError:
                return True
            return False

        until(group_is_gone)

    def test_ctrl_c_ends_all(self, tmp_path) -> None:
        process = validating(tmp_path / "report")
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, words = process.communicate(timeout=HANGS_S)
        assert process.returncode == 130
        assert words.split("\n")[-2] == "robocal: interrupted"
        assert "Traceback" not in words


def validating(report: Path) -> subprocess.Popen[str]:
    """The command at work: of forty bags the first, which is short, is ready."""
    command = [sys.executable, "-m", "robocal_ros.cli.main", "validate", str(TOOL_RUNS)]
    process = subprocess.Popen(
        [*command, *39 * [str(EXCERPT)], "--jobs", "2", "--report", str(report)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a test run in the background has it ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    until(lambda: any(report.glob("*.png")))
    return process


def until(condition, within_s: float = 60.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_the_page_and_its_tables(bags, validate) -> None:
    _, document, out, report = validate(*judged(bags))
    html = (out / "report.html").read_text().replace("<wbr>", "")
    assert html.count("<svg") == 5
    assert not re.search(r"<(script|link|img|iframe)\b", html)
    for bag in report["bags"]:
        for session in bag["sessions"]:
            for decision in session["decisions"]:
                assert decision["message"].replace("'", "&#x27;") in html
    cycles = report["bags"][0]["sessions"][0]["cycles"]
    table = rows(out / "cycles.csv")
    assert [row["cycle"] for row in table] == [cycle["cycle"] for cycle in cycles]
    for row, cycle in zip(table, cycles, strict=True):
        assert float(row["candidate_rms_mm"]) == pytest.approx(cycle["candidate"]["rms_mm"])
        assert float(row["true_after_rms_mm"]) == pytest.approx(cycle["true"]["after"]["rms_mm"])
        assert float(row["drift_a2_mm"]) == pytest.approx(cycle["drift"]["a2_mm"])
    assert [row["bag"] for row in rows(out / "bags.csv")] == [r["bag"] for r in document["bags"]]
