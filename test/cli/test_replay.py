# SPDX-License-Identifier: Apache-2.0
"""``robocal replay`` on bags: the live session's results, windows, --auto, and bad recordings."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign import ROBOT
from command import conforms, environment, robocal, robocal_json
from forked import HANGS_S
from recordings import (
    BETWEEN_S,
    EVENTS,
    JOINTS,
    NS,
    POINT,
    POSES,
    START_NS,
    TYPES,
    message,
    plain_bag,
    recorded_bag,
    shift,
    write_samples,
)

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cli.main import main
from robocal_ros.ground.samples import JointSample


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bags")


@pytest.fixture(scope="module")
def visits():
    return shift()


@pytest.fixture(scope="module")
def plain(folder: Path, visits) -> Path:
    return plain_bag(folder / "plain.mcap", visits)


@pytest.fixture(scope="module")
def live(folder: Path, visits) -> tuple[Path, list[dict[str, Any]]]:
    path = folder / "live.mcap"
    return path, recorded_bag(path, folder / "live_state", visits)


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]):
    """Run the command in this process: exit status and its one document, checked."""

    def run(*arguments: object) -> tuple[int, Any]:
        status = main(["replay", *map(str, arguments), "--json"])
        document = json.loads(capsys.readouterr().out)
        conforms(document, "replay.json")
        if status:
            conforms(document, "error.json")
        return status, document

    return run


def identified(candidate: dict[str, Any]) -> dict[str, Any]:
    """The identification alone, without when and in which cycle."""
    return {k: v for k, v in candidate.items() if k not in ("stamp", "stamp_ns", "cycle_id")}


def long_bag(path: Path, visits, idle: int) -> Path:
    """The visits, then the robot stands for ``idle`` joint readings at 100 Hz."""
    last, end_ns = visits[-1][0], visits[-1][-1].stamp_ns
    with BagWriter(path) as bag:
        for part in visits:
            write_samples(bag, part)
        for i in range(1, idle + 1):
            stamp_ns = end_ns + i * NS // 100
            write_samples(bag, [JointSample(stamp_ns, last.names, last.position)])
    return path


class TestRecordedSession:
    def test_results_are_the_live_ones_bit_for_bit(self, live, replay) -> None:
        path, documents = live
        status, document = replay(path)
        assert status == 0
        assert document["recorded"] is True
        assert document["differs"] == []
        assert len(documents) == 2
        assert [{k: v for k, v in c.items() if k != "stamp"} for c in document["candidates"]] == (
            json.loads(json.dumps(documents))
        )
        assert [c["cycle_id"] for c in document["candidates"]] == ["one", "two"]
        (accepted,) = document["accepted"]
        assert accepted == accepted | {
            "revision": 1, "candidate": 0, "by": "cell", "reason": "better"
        }  # fmt: skip
        assert document["final_model"]["revision"] == 1
        names = [entry["command"] for entry in document["commands"]]
        assert names == ["capture_reference", "identify", "accept", "identify"]
        assert document["ignored"] == {}

    def test_people_are_told_that_it_is_equal(self, live) -> None:
        done = robocal("replay", live[0])
        assert done.returncode == 0
        assert "Every recorded result comes out equal, bit for bit" in done.stdout
        assert "ACCEPT" in done.stdout
        assert done.stderr == ""

    def test_other_robot_is_refused(self, live, replay) -> None:
        status, document = replay(live[0], "--robot", "ur10")
        assert status == 2
        assert document["error"]["code"] == "WRONG_ROBOT"
        assert "UR10" in document["error"]["message"]
        status, document = replay(live[0], "--robot", ROBOT)
        assert (status, document["differs"]) == (0, [])

    def test_kept_history(self, live, folder: Path, replay) -> None:
        state = folder / "kept"
        replay(live[0], "--state", state)
        listed = robocal_json("history.list.json", "history", "list", "--state", state)
        states = {entry["kind"]: entry["state"] for entry in listed["calibrations"][::-1][:2]}
        assert states == {"reference": "in_force", "thermal": "in_force"}
        times = [
            entry[name] for entry in listed["calibrations"] for name in ("stamp_ns", "created_ns")
        ]
        assert min(times) > START_NS  # data time, not today's
        _, again = replay(live[0], "--state", state)
        assert again["differs"]
        assert any("went on from there" in words for words in again["warnings"])

    def test_windows_instead_of_the_recorded_commands(self, live, replay) -> None:
        second = BETWEEN_S
        status, document = replay(live[0], "--cold", "0:9", "--warm", f"{second - 1}:{second + 9}")
        assert status == 0
        assert document["recorded"] is False
        assert len(document["candidates"]) == 1
        assert document["accepted"] == []


class TestWithoutEvents:
    def test_the_options_are_told(self, plain: Path, replay) -> None:
        status, document = replay(plain, "--robot", ROBOT)
        assert status == 2
        for option in ("--cold", "--warm", "--auto"):
            assert option in document["error"]["message"]

    def test_the_robot_must_be_named(self, plain: Path, replay) -> None:
        status, document = replay(plain, "--auto")
        assert status == 2
        assert "--robot" in document["error"]["message"]

    def test_auto_finds_the_cycles(self, plain: Path, replay) -> None:
        status, document = replay(plain, "--robot", ROBOT, "--auto")
        assert status == 0
        names = [(entry["command"], entry["samples"]) for entry in document["commands"]]
        assert names[:3] == [("capture_reference", 8), ("identify", 8), ("identify", 8)]
        assert document["gaps"]["count"] >= 3
        assert document["gaps"]["longest_s"] == pytest.approx(BETWEEN_S - POSES + 0.1, abs=0.01)
        assert document["topics"] == {"joint_states": JOINTS, "measured_point": POINT}

    def test_windows_give_the_same_as_auto(self, plain: Path, replay) -> None:
        second, third = BETWEEN_S, 2 * BETWEEN_S
        windows = ["--cold", "0:9"]
        for start in (second, third):
            windows += ["--warm", f"{start}:{start + 9}"]
        _, told = replay(plain, "--robot", ROBOT, *windows)
        _, found = replay(plain, "--robot", ROBOT, "--auto")
        assert [identified(c) for c in told["candidates"]] == [
            identified(c) for c in found["candidates"][:2]
        ]

    def test_drift_comes_back_in_mm(self, plain: Path, replay) -> None:
        """20 K grew the links by about half a millimetre; the candidate leaves little of it."""
        _, document = replay(plain, "--robot", ROBOT, "--auto")
        first = document["candidates"][0]
        assert first["verdict"]["code"] == "ACCEPT"
        assert first["nominal"]["held_out"]["rms_mm"] > 0.4
        assert first["calibrated"]["held_out"]["rms_mm"] < 0.2


class TestTopics:
    def test_other_names(self, folder: Path, visits, replay) -> None:
        path = plain_bag(
            folder / "names.mcap", visits, joint_states="/arm/state", measured_point="/ball"
        )
        status, document = replay(path, "--robot", ROBOT, "--auto")
        assert status == 2
        assert "/arm/state" in document["error"]["message"]
        topics = ("--topic", "joint_states:=/arm/state", "--topic", "measured_point:=/ball")
        status, document = replay(path, "--robot", ROBOT, "--auto", *topics)
        assert status == 0
        assert document["candidates"]

    @pytest.mark.parametrize(
        ("topic", "words"),
        [
            ("joint_states:=/none", "no topic /none"),
            ("joints:=/joint_states", "the inputs are joint_states"),
            ("joint_states", "not of the form INPUT:=TOPIC"),
            (":=/x", "not of the form INPUT:=TOPIC"),
        ],
    )
    def test_wrong_names(self, plain: Path, replay, topic: str, words: str) -> None:
        status, document = replay(plain, "--robot", ROBOT, "--auto", "--topic", topic)
        assert status == 2
        assert words in document["error"]["message"]

    def test_uncorrected_joint_states_are_no_input(self, folder: Path, visits, replay) -> None:
        path = folder / "corrected.mcap"
        with BagWriter(path) as bag:
            for sample in (sample for part in visits for sample in part):
                write_samples(bag, [sample])
                if isinstance(sample, JointSample):
                    spoiled = JointSample(sample.stamp_ns + 1, sample.names, sample.position + 1e-3)
                    write_samples(
                        bag, [spoiled], joint_states="/joint_correction_node/joint_states"
                    )
        _, document = replay(path, "--robot", ROBOT, "--auto")
        assert document["topics"]["joint_states"] == JOINTS
        assert document["candidates"][0]["verdict"]["accept"]

    def test_no_measurements(self, folder: Path, visits, replay) -> None:
        path = plain_bag(
            folder / "joints.mcap", [[s for s in visits[0] if isinstance(s, JointSample)]]
        )
        status, document = replay(path, "--robot", ROBOT, "--auto")
        assert status == 2
        assert "no measurement at standstill" in document["error"]["message"]
        status, document = replay(path, "--robot", ROBOT, "--warm", "0:9")
        assert status == 3
        assert document["error"]["code"] == "TOO_FEW_SAMPLES"
        assert document["candidates"] == []
        for name in ("measured_point", "measured_pose", "profile", "target_pose"):
            assert any(name in words for words in document["warnings"])

    def test_other_joint_names(self, plain: Path, replay) -> None:
        status, document = replay(plain, "--robot", "ur10", "--auto")
        assert status == 2
        assert "shoulder_pan_joint" in document["error"]["message"]


class TestDamage:
    def test_a_recording_that_broke_off(self, folder: Path, visits, replay) -> None:
        """Everything up to the break is used, and the user is told."""
        path = long_bag(folder / "broken.mcap", visits[:3], 20_000)
        _, whole = replay(path, "--robot", ROBOT, "--auto")
        content = path.read_bytes()
        path.write_bytes(content[: int(0.7 * len(content))])
        status, document = replay(path, "--robot", ROBOT, "--auto")
        assert status == 0
        assert document["candidates"] == whole["candidates"]
        assert whole["warnings"] == []
        assert any(str(path) in words for words in document["warnings"])

    @pytest.mark.parametrize("where", [0, 40])
    def test_a_stamp_an_hour_ahead_changes_nothing(self, folder, visits, replay, where) -> None:
        path = folder / f"hour_{where}.mcap"
        samples = [sample for part in visits[:3] for sample in part]
        ahead = [
            dataclasses.replace(sample, stamp_ns=sample.stamp_ns + 3600 * NS)
            for sample in (samples[where], samples[6])  # joints and a point
        ]
        with BagWriter(path) as bag:
            write_samples(bag, samples[:where])
            for sample in ahead:
                topic, content = message(sample)
                bag.write(topic, TYPES[topic], content, samples[where].stamp_ns)
            write_samples(bag, samples[where:])
        plain = plain_bag(folder / f"right_{where}.mcap", visits[:3])
        windows = ("--robot", ROBOT, "--cold", "0:12", "--warm", f"{BETWEEN_S}:{BETWEEN_S + 12}")
        _, right = replay(plain, *windows)
        status, document = replay(path, *windows)
        assert status == 0
        assert document["start_ns"] == right["start_ns"] == START_NS
        assert document["candidates"] == right["candidates"]
        assert right["ignored"] == {}
        assert document["ignored"] == {JOINTS: 1, POINT: 1}
        _, found = replay(path, "--robot", ROBOT, "--auto")
        _, also = replay(plain, "--robot", ROBOT, "--auto")
        assert found["candidates"] == also["candidates"]

    def test_a_damaged_chunk_is_a_gap(self, folder, visits, replay) -> None:
        """It lies where the robot only stands: every figure is that of the whole bag."""
        path = long_bag(folder / "damaged.mcap", visits[:3], 20_000)
        _, whole = replay(path, "--robot", ROBOT, "--auto")
        content = bytearray(path.read_bytes())
        content[int(0.7 * len(content))] ^= 0x10
        path.write_bytes(content)
        status, document = replay(path, "--robot", ROBOT, "--auto")
        assert status == 0
        assert document["candidates"] == whole["candidates"]
        assert whole["gaps"]["damaged"] == []
        (gap,) = document["gaps"]["damaged"]
        end_ns = visits[2][-1].stamp_ns
        assert end_ns < gap["from_ns"] < gap["to_ns"] < end_ns + 200 * NS
        assert document["gaps"]["count"] == whole["gaps"]["count"] + 1
        assert document["gaps"]["longest_s"] > (gap["to_ns"] - gap["from_ns"]) * 1e-9
        (words,) = document["warnings"]
        assert f"{path}: a damaged chunk is left out" in words

    def test_decisions_of_a_maintenance(self, folder: Path, visits, replay) -> None:
        path = folder / "maintained.mcap"
        arguments = json.dumps({"version": 1, "arguments": {"cycle_id": "c1"}, "marks": {}})
        stamp_ns = visits[0][-1].stamp_ns
        event = {"stamp": ros_time(stamp_ns), "command": "run_maintenance", "outcome": "{}"}
        with BagWriter(path) as bag:
            write_samples(bag, visits[0])
            bag.write(EVENTS, TYPES[EVENTS], event | {"arguments": arguments}, stamp_ns)
        status, document = replay(path, "--robot", ROBOT)
        assert status == 2
        assert "robocal validate" in document["error"]["message"]

    def test_a_cold_window_without_measurements(self, plain: Path, replay) -> None:
        """No drift without its reference: the warm window must not pass for a calibration."""
        status, document = replay(
            plain,
            "--robot",
            ROBOT,
            "--cold",
            "1000:1001",
            "--warm",
            f"{BETWEEN_S}:{BETWEEN_S + 10}",
        )
        assert status == 3
        assert document["error"]["code"] == "TOO_FEW_SAMPLES"
        assert document["verdict"]["accept"] is False

    def test_a_cold_window_that_misses_the_robot(self, folder: Path, visits, replay) -> None:
        """The data cannot answer, whichever code says so; the usage is right."""
        rng = np.random.default_rng(5)
        scattered = [
            s
            if isinstance(s, JointSample)
            else dataclasses.replace(s, position_m=s.position_m + rng.normal(0.0, 0.015, 3))
            for s in visits[0]
        ]
        path = plain_bag(folder / "scattered.mcap", [scattered, visits[1]])
        windows = ["--cold", "0:10", "--warm", f"{BETWEEN_S}:{BETWEEN_S + 10}"]
        status, document = replay(path, "--robot", ROBOT, *windows)
        assert document["error"]["code"] == "RESIDUAL_TOO_LARGE"
        assert status == 3


class TestUsage:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (("--auto", "--warm", "0:1"), "leave out --cold and --warm"),
            (("--cold", "0:1"), "--cold alone identifies nothing"),
            (("--warm", "5:1"), "no window T0:T1"),
            (("--warm", "1"), "no window T0:T1"),
            (("--warm", "nan:1"), "no window T0:T1"),
        ],
    )
    def test_options_without_sense(self, plain: Path, replay, options, words: str) -> None:
        status, document = replay(plain, "--robot", ROBOT, *options)
        assert status == 2
        assert words in document["error"]["message"]


@pytest.mark.long
def test_memory_does_not_grow_with_the_recording(folder: Path, visits) -> None:
    """Twenty times the joint readings: the same memory to a few megabytes."""

    def peak_mb(path: Path) -> float:
        script = (
            "import resource, sys; from robocal_ros.cli.main import main; "
            "status = main(sys.argv[1:]); "
            "print(status, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)"
        )
        done = subprocess.run(
            [sys.executable, "-c", script, "replay", str(path), "--robot", ROBOT, "--auto"],
            capture_output=True, text=True, env=environment(), check=True, timeout=HANGS_S,
        )  # fmt: skip
        status, kilobytes = done.stderr.split()[-2:]
        assert status == "0"
        return int(kilobytes) / 1024

    short = peak_mb(long_bag(folder / "short.mcap", visits[:3], 1_000))
    long = peak_mb(long_bag(folder / "long.mcap", visits[:3], 20_000))
    assert long < short + 20.0
