# SPDX-License-Identifier: Apache-2.0
"""Programs corrected for a robot that errs: where it stands when the controller runs them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench import robot_programs
from bench.robot_programs import (
    FRAME_TURN,
    NOMINAL,
    T_BASE_FRAME,
    T_FLANGE_TOOL,
    TOOL_TURN,
    drifted,
    krl,
    poses_in,
    postures,
    programs,
    rapid,
    side_view,
)
from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics.arm import inverse
from robocal_ros.programs.correcting import ProgramCorrection, dialect_of, report
from robocal_ros.programs.points import Posture
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.programs.postures import postures as every_posture

ACTUAL = drifted(NOMINAL, 1)
POINTS, JOINTS = postures(12, 3), postures(3, 4)
WRITTEN = programs(POINTS, JOINTS)
MODELS = CorrectionModels(NOMINAL, ACTUAL, NOMINAL)
REACH_M = 3.6  # of the tool from axis 1, at most


def corrected(maker, models=MODELS, **options):
    program = WRITTEN[maker]
    correction = ProgramCorrection(dialect_of(program.suffix), models, program.frames, **options)
    return correction.correct(program.text)


def missed(T: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    T, wanted = T @ T_FLANGE_TOOL, wanted @ T_FLANGE_TOOL
    turn = Rotation.from_matrix(T[:3, :3] @ wanted[:3, :3].T).magnitude()
    return float(np.linalg.norm(T[:3, 3] - wanted[:3, 3])), float(turn)


@pytest.mark.parametrize("maker", WRITTEN)
def test_the_robot_stands_right_to_half_the_last_digit(maker):
    done = corrected(maker)
    assert [one.reason for one in done.points] == [""] * len(done.points)
    length, turn, joint = WRITTEN[maker].decimals
    unit = 1.0 if maker == "ur" else 1e-3
    angle = 1.0 if maker in ("ur", "abb") else np.pi / 180.0
    # the taught numbers are rounded too: what is meant is what they say
    taught, taught_joints = poses_in(maker, WRITTEN[maker].text)
    told, told_joints = poses_in(maker, done.text)
    assert (len(told), len(told_joints)) == (len(POINTS), len(WRITTEN[maker].joints))
    before, poses = [], [one for one in done.points if not one.point.joints]
    for one, q, meant, T in zip(poses, POINTS, taught, told, strict=True):
        now = inverse(NOMINAL, T[None], q)[0]
        away = missed(ACTUAL.fk(now), meant)
        # half a digit of each of three numbers; of a quaternion's four, twice as much turn
        assert away[1] <= angle * 0.5 * 10.0**-turn * (4.0 if maker == "abb" else 3.0) + 1e-8
        assert away[0] <= unit * np.sqrt(3.0) * 0.5 * 10.0**-length + 1e-8
        assert one.left_m == pytest.approx(away[0], abs=1e-8)  # as the report says
        before.append(missed(ACTUAL.fk(inverse(NOMINAL, meant[None], q)[0]), meant)[0])
    assert np.median(before) > 2e-4  # there was something to correct
    step = (1.0 if maker == "ur" else np.pi / 180.0) * 0.5 * 10.0**-joint
    for meant, now in zip(taught_joints, told_joints, strict=True):
        away = missed(ACTUAL.fk(now), NOMINAL.fk(meant))
        assert away[0] <= 7.0 * step * REACH_M + 1e-8  # six joints; FANUC's third is a sum
        assert away[1] <= 7.0 * step + 1e-8


@pytest.mark.parametrize("maker", WRITTEN)
def test_before_it_is_written_a_point_is_right_to_a_micrometre(maker):
    done = corrected(maker)
    for one in done.points:
        away = missed(ACTUAL.fk(one.q_corrected), NOMINAL.fk(one.q))
        assert away[0] < 1e-6
        assert away[1] < 1e-6
    first = next(i for i, one in enumerate(done.points) if not one.point.joints)
    one = done.points[first]
    shift_m = missed(NOMINAL.fk(one.q_corrected), NOMINAL.fk(one.q))[0]
    assert report(done)["points"][first]["shift_mm"] == pytest.approx(1e3 * shift_m, abs=1e-9)


@pytest.mark.parametrize("maker", WRITTEN)
def test_all_else_is_as_it_was(maker):
    done, text = corrected(maker), WRITTEN[maker].text
    parts = [part for one in done.points for part in (*one.point.fields, *one.point.marks.values())]
    inside = np.zeros(len(text), dtype=bool)
    for part in parts:
        inside[part.start : part.end] = True
    kept = "".join(sign for sign, hidden in zip(text, inside, strict=True) if not hidden)
    again = dialect_of(WRITTEN[maker].suffix).read(done.text)
    inside = np.zeros(len(done.text), dtype=bool)
    for point in again.points:
        for part in (*point.fields, *point.marks.values()):
            inside[part.start : part.end] = True
    assert kept == "".join(
        sign for sign, hidden in zip(done.text, inside, strict=True) if not hidden
    )
    assert done.text.count("\r\n") == text.count("\r\n")
    if maker == "fanuc":  # columns stay columns
        assert [len(line) for line in text.split("\n")] == [len(x) for x in done.text.split("\n")]


@pytest.mark.parametrize("maker", WRITTEN)
def test_where_nothing_is_to_be_corrected_not_a_byte_changes(maker):
    done = corrected(maker, CorrectionModels(NOMINAL, NOMINAL, NOMINAL))
    assert done.text == WRITTEN[maker].text
    count = len(POINTS) + len(WRITTEN[maker].joints)
    assert report(done)["count"] == {
        "corrected": 0, "unchanged": count, "not_corrected": 0, "of_another_group": 0,
    }  # fmt: skip


@pytest.mark.parametrize("maker", WRITTEN)
def test_a_taught_program_is_corrected_for_what_changed_since(maker):
    """Taught on the cold robot: only its drift since then moves the points."""
    warm = drifted(ACTUAL, 9, 4e-5, 1e-5)
    done = corrected(maker, CorrectionModels(NOMINAL, warm, ACTUAL))
    taught = poses_in(maker, WRITTEN[maker].text)[0]
    limit = np.sqrt(3.0) * 0.5 * 10.0 ** -WRITTEN[maker].decimals[0]
    for q, meant, T in zip(POINTS, taught, poses_in(maker, done.text)[0], strict=True):
        was = ACTUAL.fk(inverse(NOMINAL, meant[None], q)[0])
        away = missed(warm.fk(inverse(NOMINAL, T[None], q)[0]), was)
        assert away[0] <= (1.0 if maker == "ur" else 1e-3) * limit + 1e-8


TRACK_MM, ALONG = 812.5, np.array([0.6, -0.8, 0.0])


def at_track(maker: str, text: str) -> str:
    """The same text with the first external axis of its poses at `TRACK_MM`."""
    if maker == "kuka":
        return re.sub(r"(,T \d+,E1) 0\.0", rf"\g<1> {TRACK_MM}", text)
    if maker == "abb":
        return re.sub(r"(robtarget.*)\[9E9,", rf"\g<1>[{TRACK_MM},", text)
    return re.sub(r"(\tR = [^\r\n]*deg)", rf"\g<1>,\r\n\tE1=   {TRACK_MM}  mm", text)


@pytest.mark.parametrize("maker", ["kuka", "abb", "fanuc"])
def test_a_track_that_carries_the_robot(maker, monkeypatch):
    """The robot in the same postures, further along: its poses are in a frame that stands."""
    carried, fixed = np.eye(4), robot_programs.relative
    carried[:3, 3] = 1e-3 * TRACK_MM * ALONG
    moved = np.linalg.inv(T_BASE_FRAME) @ carried @ T_BASE_FRAME
    monkeypatch.setattr(robot_programs, "relative", lambda q: moved @ fixed(q))
    written = programs(POINTS, JOINTS)[maker]
    text = at_track(maker, written.text)
    assert text.count(f"{TRACK_MM}") == len(POINTS)

    def by(external):
        options = {"given": written.frames, "external": external}
        return ProgramCorrection(dialect_of(written.suffix), MODELS, **options).correct(text)

    done = by({1: ALONG})
    assert [one.reason for one in done.points] == [""] * len(done.points)
    assert done.text.count(f"{TRACK_MM}") == len(POINTS)  # the axis stays
    # half the last digit of six numbers of what is taught, and of what is written
    left_m = 1e-3 * 2.0 * np.sqrt(3.0) * 0.5 * 10.0 ** -written.decimals[0] + 1e-6
    poses = [one for one in done.points if not one.point.joints]
    for q, T, one in zip(POINTS, poses_in(maker, done.text)[0], poses, strict=True):
        reached = inverse(NOMINAL, (np.linalg.inv(carried) @ T)[None], q)[0]
        assert missed(ACTUAL.fk(reached), NOMINAL.fk(one.q))[0] < left_m
        assert missed(NOMINAL.fk(one.q), NOMINAL.fk(q))[0] < left_m  # the posture that was meant
    for one in by({}).points:
        assert one.point.joints or "external axis 1 is at 812.5" in one.reason


@pytest.mark.parametrize("maker", ["kuka", "abb", "fanuc"])
def test_an_axis_that_carries_nothing_changes_nothing(maker):
    program = WRITTEN[maker]
    text, still = at_track(maker, program.text), {1: np.zeros(3)}
    dialect = dialect_of(program.suffix)
    done = ProgramCorrection(dialect, MODELS, program.frames, external=still).correct(text)
    assert done.text == at_track(maker, corrected(maker).text)


@pytest.mark.parametrize("maker", ["kuka", "abb", "fanuc"])
def test_status_and_turns_follow_the_joints(maker):
    """Joints a hair from a change of sign, quadrant or turn: what is told is where they go."""
    rng = np.random.default_rng(8)
    edge = {0: 0.0, 3: 0.0, 5: 0.0}
    if maker == "fanuc":
        edge = {3: np.pi, 5: -np.pi}
    points = postures(24, 6)
    joint = rng.choice(list(edge), len(points))
    for q, at in zip(points, joint, strict=True):
        q[at] = edge[at] + 1e-5 * rng.standard_normal()
    program = programs(points, JOINTS)[maker]
    done = ProgramCorrection(dialect_of(program.suffix), MODELS, program.frames).correct(
        program.text
    )
    poses = [one for one in done.points if not one.point.joints]
    crossed = 0
    assert not [one.reason for one in poses if one.reason]
    # The same program, written for the joints that the robot goes to.
    aim = programs(np.array([one.q_corrected for one in poses]), JOINTS)[maker]
    marks = {
        "kuka": r"S \d+,T \d+",
        "abb": r"\[(-?\d+,-?\d+,-?\d+,\d)\],\[9E9,",
        "fanuc": r"CONFIG : '.*'",
    }[maker]
    told, expected = re.findall(marks, done.text), re.findall(marks, aim.text)
    before = re.findall(marks, program.text)
    for q, old, one, new in zip(points, before, told, expected, strict=True):
        assert one == new, (q, old)
        crossed += old != one
    assert crossed > 4


def test_each_posture_of_one_pose_is_found_by_its_configuration():
    """Eight ways to one pose, each corrected as its own: what KUKA's S and T are for."""
    q = np.radians([20.0, -70.0, 80.0, 35.0, 50.0, -60.0])
    wide = replace(NOMINAL, lower=np.full(6, -np.pi), upper=np.full(6, np.pi))
    ways = every_posture(wide, NOMINAL.fk(q), Posture())
    assert len(ways) == 8
    sides = {(*side_view(way), bool(way[4] < 0.0)) for way in ways}
    assert len(sides) == 8
    models = CorrectionModels(wide, replace(ACTUAL, lower=wide.lower, upper=wide.upper), wide)
    frames = {"TOOL_DATA[3]": T_FLANGE_TOOL, "BASE_DATA[5]": T_BASE_FRAME}
    for way in ways:
        done = ProgramCorrection(dialect_of(".dat"), models, frames).correct(krl(way[None], []))
        np.testing.assert_allclose(done.points[0].q, way, atol=1e-6)
        assert done.points[0].reason == ""


# ---- what cannot be corrected, and why -----------------------------------------------------------


def reasons(text, suffix=".dat", models=MODELS, frames=None, **options):
    known = {"TOOL_DATA[3]": T_FLANGE_TOOL, "BASE_DATA[5]": T_BASE_FRAME}
    given = known if frames is None else frames
    done = ProgramCorrection(dialect_of(suffix), models, given, **options).correct(text)
    for one in done.points:
        assert bool(one.reason) != bool(one.changes)
    return [one.reason for one in done.points], done


def test_a_frame_that_nobody_knows():
    text = krl(POINTS[:1], JOINTS[:1])
    found, _ = reasons(text, frames={"TOOL_DATA[3]": T_FLANGE_TOOL})
    assert found == [
        "unknown frame BASE_DATA[5]: give --frames FILE or --frame 'BASE_DATA[5]=…'",
        "",
    ]
    bare = text.replace("DECL FDAT FP1", "DECL FDAT FX9")
    found, _ = reasons(bare)
    assert found[0] == "the program does not say its frame: give --base NAME"
    found, _ = reasons(bare, frame="base_data[5]")
    assert found[0] == "the program does not say its tool: give --tool NAME"
    found, _ = reasons(bare, tool="tool_data[3]", frame="base_data[5]")
    assert found == ["", ""]
    # what no file says by a name
    reckoned = "$TOOL=TOOL_DATA[3]\n$BASE=near(1)\nLIN {X 1,Y 2,Z 3,A 0,B 0,C 0}\n"
    found, _ = reasons(reckoned, ".src")
    assert found == ["unknown frame $BASE of line 2: give --frame '$BASE of line 2=…'"]
    found, _ = reasons(WRITTEN["fanuc"].text, ".ls")
    assert found[0] == "unknown frame UF2: give --frame 'UF2=…'"


def test_a_singular_posture_is_left_as_it_is():
    q = np.radians([10.0, -80.0, 95.0, 40.0, 0.02, -20.0])
    found, done = reasons(krl(q[None], [q]))
    assert [reason[:8] for reason in found] == ["singular"] * 2
    assert done.text == krl(q[None], [q])
    assert done.points[1].left_m == pytest.approx(missed_flange(q), rel=1e-6)


def missed_flange(q):
    return float(np.linalg.norm(ACTUAL.fk(q)[:3, 3] - NOMINAL.fk(q)[:3, 3]))


def test_limits_are_those_of_the_robot():
    q = POINTS[0]
    tight = replace(NOMINAL, upper=np.maximum(NOMINAL.upper, q))
    away = ProgramCorrection(dialect_of(".dat"), MODELS, WRITTEN["kuka"].frames)
    moved = away.correct(krl(q[None], [])).points[0].q_corrected - q
    joint = int(np.argmax(np.abs(moved)))
    lower, upper = NOMINAL.lower.copy(), NOMINAL.upper.copy()
    if moved[joint] > 0.0:
        upper[joint] = q[joint] + 0.5 * moved[joint]
    else:
        lower[joint] = q[joint] + 0.5 * moved[joint]
    tight = replace(NOMINAL, lower=lower, upper=upper)
    found, _ = reasons(krl(q[None], []), models=replace(MODELS, nominal=tight))
    assert found == [f"{NOMINAL.joint_names[joint]} would be beyond its limits"]


def test_a_correction_that_is_too_large_is_none():
    strange = drifted(NOMINAL, 2, 2e-2, 2e-2)  # of another robot
    found, done = reasons(krl(POINTS, JOINTS), models=replace(MODELS, actual=strange))
    assert all(found)
    assert any("at most 1 are allowed" in reason for reason in found)
    assert done.text == krl(POINTS, JOINTS)
    small = replace(MODELS, largest_m=1e-5)
    found, _ = reasons(krl(POINTS[:1], []), models=small)
    assert "at most 0.01" in found[0]


def test_a_pose_out_of_reach_and_one_in_another_posture():
    text = krl(POINTS[:2], [])
    far = re.sub(r"XP1=\{X [^,]*", "XP1={X 9000.0", text)
    found, _ = reasons(far)
    assert found == ["the pose is out of reach", ""]
    status = re.search(r"XP1=.*S (\d),", text)
    other = text.replace(status[0], status[0][:-2] + f"{int(status[1]) ^ 1},")
    found, _ = reasons(other)
    assert found == ["no joints reach it in the configuration that it says", ""]


def test_axes_of_another_machine_are_left():
    axes = "   GP1:\n\tUF : 2, UT : 4,\n\tJ1= 1.000 deg, J2= 2.000 deg\n"
    text = f"/PROG A\n/POS\nP[1]{{\n{axes}}};\n/END\n"
    done = ProgramCorrection(dialect_of(".ls"), MODELS).correct(text)
    assert [one.reason for one in done.points] == [f"2 joints, {NOMINAL.name} has 6"]
    assert done.text == text


def test_without_a_configuration_the_posture_is_that_of_the_point_before():
    program = WRITTEN["ur"]
    bare = re.sub(r"get_inverse_kin\((\w+), qnear=\w+\)", r"\1", program.text)
    near = ProgramCorrection(dialect_of(".script"), MODELS, program.frames).correct(bare)
    assert near.points[0].reason == "nothing says in which posture: give --posture-deg"
    # along a path each point is near the one before
    q = POINTS[0] + np.linspace(0.0, 0.3, 5)[:, None] * [1.0, 0.3, -0.5, 0.4, 0.2, 1.0]
    path = re.sub(r"get_inverse_kin\((\w+), qnear=\w+\)", r"\1", programs(q, JOINTS)["ur"].text)
    done = ProgramCorrection(dialect_of(".script"), MODELS, posture=q[0] + 0.05).correct(path)
    for one, joints in zip(done.points, q, strict=False):
        np.testing.assert_allclose(one.q, joints, atol=1e-7)


def test_a_configuration_that_the_controller_does_not_follow_says_no_posture():
    """Programs made off line leave it at zeros, with ConfL off: the arm stays as it came."""
    q = POINTS[0] + np.linspace(0.05, 0.3, 5)[:, None] * [1.0, 0.3, -0.5, 0.4, 0.2, 1.0]
    zeros = re.sub(r"\[-?\d,-?\d,-?\d,\d\](?=,\[9E9)", "[0,0,0,0]", rapid(q, POINTS[:1]))
    none = "[0,0,0,0],[9E9,9E9"
    assert zeros.count(none) == len(q)
    found, _ = reasons(zeros, ".mod")
    assert found[:-1] == ["no joints reach it in the configuration that it says"] * len(q)
    free = zeros.replace("PROC main()\n", "PROC main()\n    ConfL \\Off;\n")
    found, done = reasons(free, ".mod")
    assert found == [""] * (len(q) + 1)
    assert done.text.count(none) == len(q)  # it says as little as before
    assert "nearest to the point before" in done.program.notes[0]
    taught, told = poses_in("abb", zeros)[0], poses_in("abb", done.text)[0]
    for one, joints, meant, T in zip(done.points, q, taught, told, strict=False):
        np.testing.assert_allclose(one.q, joints, atol=2e-5)  # three decimals of a mm
        away = missed(ACTUAL.fk(inverse(NOMINAL, T[None], joints)[0]), meant)
        assert away[0] < 1e-6


def test_an_ending_that_is_no_program():
    with pytest.raises(InputError, match=r"known are \.src"):
        dialect_of(".urp")
    assert FRAME_TURN.magnitude() > 0.1  # the frames here do turn
    assert TOOL_TURN.magnitude() > 0.1
