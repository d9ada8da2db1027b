# SPDX-License-Identifier: Apache-2.0
"""The golden hand-eye bags: what they hold, that their script makes them again, their truth."""

import json
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robocal_ros.bags.bags import BagMessage, bag_info, read_bag
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import cloud_points
from robocal_ros.hand_eye.files import read_pose_table, read_profiles
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, StepTarget, read_target
from robocal_ros.kinematics.robots import load_robot

EVENTS = "/hand_eye_node/session_events"
BAGS = Path(__file__).parents[2] / "bags"
KINDS = ("sphere", "step", "line")
UR10 = load_robot("ur10")
FLANGE_M = 2e-3  # an arm whose lengths err by 0.1 mm and angles by 0.1 mrad, at a metre
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")
SPIKES = 0.02  # more of the points than are speckled (0.3 %), ragged or at ends


@pytest.fixture(scope="module")
def script():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BAGS))
        import make_hand_eye

        yield make_hand_eye
        for name in ("make_hand_eye", "hand_eye_program", "hand_eye_recorder", "session_events"):
            sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def recordings(script) -> dict[str, Any]:
    return {kind: script.build(kind) for kind in KINDS}


@cache
def read(path: Path) -> list[BagMessage]:
    """What a bag of the repository holds."""
    return list(read_bag(path))


def messages(path: Path, topic: str) -> list[BagMessage]:
    return [m for m in read(path) if m.topic == topic]


def stamp_s(message: Any) -> float:
    return message.header.stamp.sec - 1_790_000_000 + message.header.stamp.nanosec * 1e-9


def truth_of(path: Path) -> dict[str, Any]:
    (told,) = messages(path, "/truth/hand_eye")
    return json.loads(told.message.data)


def bag(kind: str) -> Path:
    return BAGS / f"hand_eye_{kind}.mcap"


def commands(path: Path) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Name, arguments and outcome of each event."""
    found = [m.message for m in messages(path, EVENTS)]
    return [(e.command, json.loads(e.arguments)["arguments"], json.loads(e.outcome)) for e in found]


def sampled(kind: str) -> list[tuple[Any, str]]:
    """The profiles that became samples, each with the mark that its capture names."""
    marks = {a["handle"]: a["mark"] for name, a, _ in commands(bag(kind)) if name == "capture"}
    taken = {
        a["shot_ns"]: marks[a["handle"]] for name, a, _ in commands(bag(kind)) if name == "sample"
    }
    shots = [m.message for m in messages(bag(kind), "/profile")]
    stamps = [s.header.stamp.sec * 10**9 + s.header.stamp.nanosec for s in shots]
    return [(s, taken[at]) for s, at in zip(shots, stamps, strict=True) if at in taken]


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_small_and_says_what_it_is(kind):
    info = bag_info(bag(kind))
    assert bag(kind).stat().st_size < 1_500_000
    assert not info.notes
    assert set(info.topics) == {"/joint_states", "/profile", "/truth/hand_eye", EVENTS}
    assert info.topics["/profile"].messages == 17
    assert truth_of(bag(kind))["simulated"] is True
    frames_seen = [m.message.header.frame_id for m in messages(bag(kind), "/profile")]
    assert set(frames_seen) == {"laser"}
    assert {mark for _, mark in sampled(kind)} == ({"near", "far"} if kind == "step" else {""})


@pytest.mark.parametrize("kind", KINDS)
def test_its_session_meets_what_a_cell_meets(kind):
    """One capture fails in motion, one for a blind sensor, one sample is removed; the rest is
    accepted, with the sensor in force beside what was there before."""
    told = commands(bag(kind))
    codes = [end["status"] for name, _, end in told if name == "break_off"]
    assert codes == [Code.BAD_INPUT, Code.TOO_FEW_SAMPLES]
    moved, empty = [end["message"] for name, _, end in told if name == "break_off"]
    assert "moved by" in moved
    assert "has 0 points" in empty
    assert [name for name, *_ in told].count("sample") == 15
    assert [name for name, *_ in told].count("remove") == 1
    assert [name for name, *_ in told[-3:]] == ["calibrate", "accept", "configure"]
    assert [end["status"] for *_, end in told[-3:-1]] == [Code.ACCEPT, Code.ACCEPT]
    assert told[-3][2]["samples"] == 14
    assert told[0][1]["sensor"] is None
    assert told[-1][1]["sensor"]["child"] == "laser"


@pytest.mark.parametrize("kind", KINDS)
def test_the_session_finds_the_sensor(kind):
    """As far as the robot knows where its flange is."""
    model = commands(bag(kind))[-1][1]["sensor"]
    found, true = np.array(model["T_parent_sensor"]), truth_of(bag(kind))["T_flange_sensor"]
    assert np.linalg.norm((found - true)[:3, 3]) < FLANGE_M  # in the middle of the field


def target_file(path: Path) -> tuple[str, list[float]]:
    """Words and numbers of the target beside a bag: processors round these differently."""
    text = path.with_suffix(".yaml").read_text()
    return NUMBER.sub("#", text), [float(number) for number in NUMBER.findall(text)]


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_its_script_makes_it_again(script, recordings, tmp_path, kind):
    again = tmp_path / "again.mcap"
    script.write_bag(recordings[kind], again)
    (words, numbers), (kept_words, kept_numbers) = map(target_file, (again, bag(kind)))
    assert words == kept_words
    assert numbers == pytest.approx(kept_numbers, rel=1e-14, abs=1e-12)
    made, kept = list(read_bag(again)), read(bag(kind))
    assert [m[:3] for m in made] == [m[:3] for m in kept]
    for one, two in zip(kept, made, strict=True):
        if one.topic == "/profile":
            apart = cloud_points(one.message) - cloud_points(two.message)
            seen = np.abs(apart[np.isfinite(apart)])
            assert np.max(seen, initial=0.0) <= 1.1e-6
            assert np.isnan(apart).all() == np.isnan(cloud_points(one.message)).all()
        elif one.topic == "/joint_states":
            assert np.abs(one.message.position - two.message.position).max() <= 1.1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_the_robot_stands_still_at_each_shot(kind):
    joints = messages(bag(kind), "/joint_states")
    at = np.array([stamp_s(m.message) for m in joints])
    q = np.array([m.message.position for m in joints])
    shots = [stamp_s(shot) for shot, _ in sampled(kind)]
    assert len(shots) == 15
    assert joints[0].message.name == list(UR10.joint_names)
    arrived = 0
    for shot in shots:
        rest = (at > shot - 0.5) & (at < shot + 0.3)
        assert rest.sum() == pytest.approx(0.8 * 125, abs=2)
        assert np.ptp(q[rest], axis=0).max() < 2e-5  # servo hum of 1e-6 rad
        before = (at > shot - 0.9) & (at < shot - 0.62)
        arrived += np.ptp(q[before], axis=0).max() > 1e-4
    assert arrived == 13  # all but those that a failed capture went before


def base_points(kind: str) -> list[np.ndarray]:
    """Points (n, 3) of each profile, base, by the nominal robot and the true sensor pose."""
    joints = messages(bag(kind), "/joint_states")
    at = np.array([stamp_s(m.message) for m in joints])
    X = np.array(truth_of(bag(kind))["T_flange_sensor"])
    found = []
    for shot, _ in sampled(kind):
        q = joints[int(np.argmin(np.abs(at - stamp_s(shot))))].message.position
        p = cloud_points(shot)
        assert np.all(p[:, 1] == 0.0)
        p = p[np.isfinite(p).all(axis=1)]
        found.append((UR10.fk(q) @ X @ np.insert(p, 3, 1.0, axis=1).T)[:3].T)
    return found


def test_the_profiles_show_the_sphere():
    centre = np.array(truth_of(bag("sphere"))["center_base"])
    for points in base_points("sphere"):
        off = np.abs(np.linalg.norm(points - centre, axis=1) - 0.02)
        assert np.mean(off > FLANGE_M) < SPIKES


def in_user(kind: str, points: np.ndarray) -> np.ndarray:
    T = np.array(truth_of(bag(kind))["T_base_user"])
    return (points - T[:3, 3]) @ T[:3, :3]


def test_the_profiles_show_the_stairs():
    """Near a tread or a riser, near the mark."""
    for points, (_, mark) in zip(base_points("step"), sampled("step"), strict=True):
        x, y, z = in_user("step", points).T
        assert np.median(x) == pytest.approx(0.03 if mark == "near" else 0.06, abs=5e-3)
        step = np.clip(np.floor(y / 0.01), 0, 4)
        to_tread = np.abs(z - 0.01 * (step + 1))
        to_riser = np.abs(y - 0.01 * np.round(y / 0.01))
        assert np.mean(np.minimum(to_tread, to_riser) > FLANGE_M) < SPIKES


def test_the_profiles_show_the_edge():
    for points in base_points("line"):
        _, y, z = in_user("line", points).T
        on_top, in_front = np.abs(z) < FLANGE_M, np.abs(y) < FLANGE_M
        assert np.mean(on_top | in_front) > 1.0 - SPIKES
        assert np.hypot(y, z).min() < FLANGE_M


@pytest.mark.parametrize("kind", KINDS)
def test_the_tables_hold_the_same_shots(script, recordings, tmp_path, kind):
    script.write_csv(recordings[kind], tmp_path)
    table = read_pose_table(tmp_path / "poses.csv", UR10)
    # joints are written to 12 digits, 5e-10 degrees at most; six of them turn the flange
    assert table.T_base_flange == pytest.approx(UR10.fk(table.joints.q), abs=1e-10)
    if kind == "step":
        assert list(table.mark) == [mark for _, mark in sampled(kind)]
    else:
        assert table.mark is None
    profiles = read_profiles(tmp_path / "profiles", table)
    for profile, (shot, _) in zip(profiles, sampled(kind), strict=True):
        assert isinstance(profile, Profile)
        seen = cloud_points(shot)
        seen = seen[np.isfinite(seen).all(axis=1)][:, ::2]
        assert profile.points == pytest.approx(seen, abs=1e-6)
    check = read_pose_table(tmp_path / "check.csv")
    assert len(check) == 5
    assert not set(check.files) & set(table.files)
    assert all(isinstance(p, Profile) for p in read_profiles(tmp_path / "profiles", check))
    target = read_target(tmp_path / "target.yaml")
    kinds = {"sphere": SphereTarget, "step": StepTarget, "line": LineTarget}
    assert isinstance(target, kinds[kind])


def test_the_targets_are_where_the_robot_takes_them_to_be():
    """Known to the teaching error and the robot's own."""
    T = np.array(truth_of(bag("step"))["T_base_user"])
    step, line = (read_target(bag(kind).with_suffix(".yaml")) for kind in ("step", "line"))
    assert np.linalg.norm(step.T_base_user[:3, 3] - T[:3, 3]) < FLANGE_M
    assert np.abs(step.T_base_user[:3, :3] - T[:3, :3]).max() < 5e-3
    assert np.linalg.norm(line.point_base - T[:3, 3]) < FLANGE_M
    assert line.direction_base @ T[:3, 0] > np.cos(5e-3)
    assert step.corners["near"][2].tolist() == pytest.approx([0.03, 0.02, 0.03])
