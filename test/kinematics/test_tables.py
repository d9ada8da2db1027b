# SPDX-License-Identifier: Apache-2.0
"""Measurement tables: the contract of docs/files.md, and every way to break it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import (
    beyond_limits,
    read_joints,
    read_measurements,
    write_measurements,
)


def make_arm(prismatic: tuple[bool, ...]) -> SerialArm:
    n = len(prismatic)
    return SerialArm(
        name="test arm",
        joint_names=tuple(f"joint{i + 1}" for i in range(n)),
        mdh=np.zeros((n, 5)),
        sign=np.ones(n),
        prismatic=np.array(prismatic),
        lower=np.full(n, -2.0),
        upper=np.full(n, 2.0),
    )


TWO = make_arm((False, False))
MIXED = make_arm((True, False, True))

GOOD = "q1_deg,q2_deg,x_mm,y_mm,z_mm\n90,-45,1000,2,3\n0,1,4,5,6\n"


def read(tmp_path: Path, text: str | bytes, arm: SerialArm = TWO) -> Measurements:
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_measurements(path, arm)


def refusal(tmp_path: Path, text: str | bytes, arm: SerialArm = TWO) -> InputError:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, arm)
    assert caught.value.file == str(tmp_path / "table.csv")
    return caught.value


def test_degrees_and_millimetres(tmp_path: Path) -> None:
    data = read(tmp_path, GOOD)
    np.testing.assert_allclose(data.q, np.radians([[90, -45], [0, 1]]), rtol=1e-15)
    np.testing.assert_allclose(data.position, [[1.0, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]], rtol=1e-15)
    assert data.sample == ("2", "3")
    assert data.target == ("tool", "tool")
    assert data.rotation is None
    assert data.sigma is None
    assert data.stamp_ns is None


def test_si_units_in_any_order_with_every_option(tmp_path: Path) -> None:
    text = (
        "target,z_m,y_m,x_m,q3_m,q2_rad,q1_m,sample,stamp_s,sigma_mm\n"
        "ball A,3,2,1,0.5,0.25,0.125,first,1594744744.000000001,0.02\n"
    )
    data = read(tmp_path, text, MIXED)
    assert data.q.tolist() == [[0.125, 0.25, 0.5]]
    assert data.position.tolist() == [[1.0, 2.0, 3.0]]
    assert data.target == ("ball A",)
    assert data.sample == ("first",)
    assert data.stamp_ns is not None
    assert data.stamp_ns.tolist() == [1594744744000000001]
    assert data.sigma is not None
    assert data.sigma.tolist() == pytest.approx([2e-5], rel=1e-15)


def test_prismatic_joints_in_millimetres(tmp_path: Path) -> None:
    data = read(tmp_path, "q1_mm,q2_deg,q3_mm,x_m,y_m,z_m\n100,180,-50,0,0,0\n", MIXED)
    np.testing.assert_allclose(data.q, [[0.1, np.pi, -0.05]], rtol=1e-15)


def test_three_ways_to_give_the_same_orientation(tmp_path: Path) -> None:
    turn = Rotation.from_euler("x", 30, degrees=True) * Rotation.from_euler("y", 40, degrees=True)
    turn = turn * Rotation.from_euler("z", 50, degrees=True)
    ways = {
        "rx_deg,ry_deg,rz_deg": [30.0, 40.0, 50.0],
        "rvx_rad,rvy_rad,rvz_rad": turn.as_rotvec().tolist(),
        "qx,qy,qz,qw": (-turn.as_quat()).tolist(),
    }
    for columns, values in ways.items():
        cells = ",".join(map(repr, values))
        data = read(tmp_path, f"q1_deg,q2_deg,x_mm,y_mm,z_mm,{columns}\n0,0,0,0,0,{cells}\n")
        assert data.rotation is not None
        np.testing.assert_allclose(data.rotation[0], turn.as_matrix(), atol=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "q2_rad,q1_m,q3_m\n0.25,0.125,0.5\n",
        "q1_mm,q2_rad,q3_mm,x_m,y_m,z_m,rx_deg,ry_deg,rz_deg\n125,0.25,500,1,2,3,0,0,0\n",
        "sample,q1_mm,q2_rad,q3_mm,x_m,y_m,z_m,w_deg,p_deg,r_deg\na,125,0.25,500,,,,,,\n",
    ],
    ids=["joints alone", "a pose in metres", "a plan that waits for its poses"],
)
def test_joints_are_read_from_every_measurement_table(tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text)
    np.testing.assert_allclose(read_joints(path, MIXED), [[0.125, 0.25, 0.5]], rtol=1e-15)
    path.write_text(text.replace("q2_rad", "q2_mm"))
    with pytest.raises(InputError, match="its column is q2_deg or q2_rad"):
        read_joints(path, MIXED)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\n\n"),
        GOOD.replace("\n", "\n \t\n"),
        GOOD.replace(",", " , "),
        GOOD.removesuffix("\n"),
        GOOD.replace("90", '"90"'),
    ],
    ids=["BOM", "CRLF", "empty lines", "lines of blanks", "spaces", "no last newline", "quoted"],
)
def test_what_spreadsheets_write_is_read(tmp_path: Path, text: str) -> None:
    data = read(tmp_path, text)
    assert data.q[0].tolist() == np.radians([90, -45]).tolist()
    assert len(data) == 2


@pytest.mark.parametrize(
    ("text", "row", "column", "words"),
    [
        ("", None, None, "empty"),
        (" \n\n", None, None, "empty"),
        ("q1_deg,q2_deg,x_mm,y_mm,z_mm\n", None, None, "no measurements"),
        (GOOD.replace("q2_deg", "q2_dge"), 1, "q2_dge", "its column is q2_deg or q2_rad"),
        (GOOD.replace("y_mm", "ymm"), 1, "ymm", "'y_mm'"),
        (GOOD.replace("x_mm", "X_mm"), 1, "X_mm", "'x_mm'"),
        (GOOD.replace("x_mm", "temperature"), 1, "temperature", "unknown column"),
        (GOOD.replace("q2_deg", "q3_deg"), 1, "q3_deg", "has 2 joints"),
        (GOOD.replace("q2_deg", "q2_mm"), 1, "q2_mm", "q2_deg or q2_rad"),
        (GOOD.replace("q2_deg", "q2"), 1, "q2", "its column is q2_deg or q2_rad"),
        (GOOD.replace("q2_deg", "q2_rad"), 1, "q2_rad", "mixed units"),
        (GOOD.replace("y_mm", "y_m"), 1, "y_m", "mixed units"),
        (GOOD.replace("q2_deg", "q1_deg"), 1, "q1_deg", "twice"),
        (GOOD.replace("q2_deg", "q1_rad"), 1, "q1_deg", "q1_rad"),
        (GOOD.replace("q2_deg", ""), 1, None, "column 2 has no name"),
        ("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n", 1, None, "q2_deg or q2_rad is missing"),
        ("q1_deg,q2_deg,x_mm,z_mm\n1,2,3,4\n", 1, None, "y_mm is missing"),
        ("q1_deg,q2_deg\n1,2\n", 1, None, "x_mm, y_mm, z_mm is missing (or x_m"),
        ("q1_deg,q2_deg,x_m,y_m,z_m,qx,qy,qz\n1,2,3,4,5,0,0,0\n", 1, None, "qw is missing"),
        ("q1_deg,q2_deg,x_m,y_m,z_m,qx,rx_deg\n1,2,3,4,5,0,0\n", 1, None, "more than one way"),
        (GOOD.replace("-45", "none"), 2, "q2_deg", "'none' is not a number"),
        (GOOD.replace(",5,", ",,"), 3, "y_mm", "empty"),
        (GOOD.replace(",5,", ",nan,"), 3, "y_mm", "'nan' is not a finite number"),
        (GOOD.replace(",5,", ",-inf,"), 3, "y_mm", "not a finite number"),
        (GOOD.replace(",5,", ",1_000,"), 3, "y_mm", "'1_000' is not a number"),
        (GOOD.replace(",5,", ","), 3, None, "4 cells, but the header has 5"),
        (GOOD.replace(",5,", ",5,5,"), 3, None, "6 cells"),
        (GOOD.replace(",5,", ',"5,25",'), 3, "y_mm", "decimal mark must be a point"),
        (GOOD.replace(",", ";"), 1, None, "semicolons"),
        (GOOD.replace(",", "\t"), 1, None, "tabs"),
        (GOOD.replace("90", '"90'), 3, None, "not a CSV table"),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, text: str, row: int | None, column: str | None, words: str
) -> None:
    error = refusal(tmp_path, text)
    assert words in str(error)
    assert (error.row, error.column) == (row, column)


WITH_OPTIONS = (
    "q1_deg,q2_deg,x_mm,y_mm,z_mm,sample,target,sigma_mm,stamp_s,qx,qy,qz,qw\n"
    "1,2,3,4,5,a,tool,0.1,10,0,0,0,1\n"
    "1,2,3,4,5,b,tool,0.1,11,0,0,0,1\n"
)


@pytest.mark.parametrize(
    ("old", "new", "row", "column", "words"),
    [
        (",b,", ",a,", 3, "sample", "already in row 2"),
        (",b,", ",,", 3, "sample", "empty"),
        ("b,tool", "b, ", 3, "target", "empty"),
        ("0.1,11", "0,11", 3, "sigma_mm", "no standard deviation"),
        ("0.1,11", "-1,11", 3, "sigma_mm", "no standard deviation"),
        (",11,", ",noon,", 3, "stamp_s", "'noon' is not a number"),
        (",11,", ",NaN,", 3, "stamp_s", "not a finite number"),
        (",11,", ",1594744744000,", 3, "stamp_s", "unit is the second"),
        ("11,0,0,0,1", "11,0,0,0.1,1.1", 3, "qw", "length 1.10454, not 1"),
        ("11,0,0,0,1", "11,0,0,0,0", 3, "qw", "length 0, not 1"),
    ],
)
def test_options_are_checked(
    tmp_path: Path, old: str, new: str, row: int, column: str, words: str
) -> None:
    assert len(read(tmp_path, WITH_OPTIONS)) == 2
    assert WITH_OPTIONS.count(old) == 1
    error = refusal(tmp_path, WITH_OPTIONS.replace(old, new))
    assert words in str(error)
    assert (error.row, error.column) == (row, column)


HUGE = "9" * 10_000


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("b,tool,0.1", f"b,tool,{HUGE}"),
        ("b,tool,0.1", f"b,tool,{HUGE}x"),
        ("b,tool,0.1", f"b,tool,{'1_' * 5000}1"),
        ("b,tool,0.1", f"b,tool,1{'0' * 200}"),
        (",11,", f",{HUGE},"),
        (",11,", f",x{HUGE},"),
        (",a,", f",{HUGE},"),
        ("y_mm", HUGE),
        ("sigma_mm,stamp_s", f"{HUGE},{HUGE}"),
    ],
)
def test_a_huge_cell_is_cut_in_the_message(tmp_path: Path, old: str, new: str) -> None:
    text = WITH_OPTIONS.replace(old, new).replace(",b,", f",{HUGE},")
    error = refusal(tmp_path, text)
    assert "…" in str(error)
    assert len(str(error)) < 300 + len(str(tmp_path))
    assert error.row in (1, 3)


def test_rows_are_counted_as_an_editor_shows_them(tmp_path: Path) -> None:
    error = refusal(tmp_path, GOOD.replace("\n0,1", "\n\n\n0,one"))
    assert error.row == 5


@pytest.mark.parametrize("data", [GOOD.encode("utf-16"), b"q1_deg\xff\n1\n"])
def test_other_encodings_are_refused(tmp_path: Path, data: bytes) -> None:
    assert "UTF-8" in str(refusal(tmp_path, data))


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such table"):
        read_measurements(tmp_path / "none.csv", TWO)
    with pytest.raises(InputError, match="cannot be read"):
        read_measurements(tmp_path, TWO)


def test_readings_beyond_limits_are_told_and_kept(tmp_path: Path) -> None:
    # 90 and -45 read as radians: nothing is guessed, the limits tell
    data = read(tmp_path, GOOD.replace("_deg", "_rad"))
    assert data.q[0].tolist() == [90.0, -45.0]
    warnings = beyond_limits(data, TWO)
    assert len(warnings) == 2
    assert "joint 1 (joint1): 1 of 2 readings" in warnings[0]
    assert "farthest 5156.62 deg in sample 2" in warnings[0]
    assert beyond_limits(read(tmp_path, GOOD), TWO) == ()


def test_a_long_table_comes_back_whole(tmp_path: Path) -> None:
    rows, arm = 12_000, make_arm((False,) * 9)
    rng = np.random.default_rng(1)
    turns = Rotation.random(rows, rng).as_matrix()
    data = Measurements(
        q=rng.uniform(-2, 2, (rows, 9)),
        position=rng.normal(size=(rows, 3)),
        target=("tool",) * rows,
        sample=tuple(map(str, range(rows))),
        rotation=turns,
        sigma=np.full(rows, 1e-5),
        stamp_ns=np.arange(rows, dtype=np.int64) * 10**9,
    )
    path = tmp_path / "long.csv"
    write_measurements(path, data, arm)
    assert len(path.read_text().splitlines()[0].split(",")) == 20
    back = read_measurements(path, arm)
    np.testing.assert_allclose(back.q, data.q, rtol=1e-11)


numbers = st.floats(-1e4, 1e4, allow_subnormal=False)
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc", "Z")), min_size=1)


@st.composite
def measurements(draw: st.DrawFn) -> Measurements:
    rows = draw(st.integers(1, 8))
    some = st.booleans()
    turns = draw(arrays(np.float64, (rows, 3), elements=st.floats(-3, 3, allow_subnormal=False)))
    return Measurements(
        q=draw(arrays(np.float64, (rows, 3), elements=numbers)),
        position=draw(arrays(np.float64, (rows, 3), elements=numbers)),
        target=tuple(draw(st.lists(words, min_size=rows, max_size=rows))),
        sample=tuple(draw(st.lists(words, min_size=rows, max_size=rows, unique=True))),
        rotation=Rotation.from_rotvec(turns).as_matrix() if draw(some) else None,
        sigma=draw(arrays(np.float64, rows, elements=st.floats(1e-9, 1))) if draw(some) else None,
        stamp_ns=draw(arrays(np.int64, rows, elements=st.integers(-(10**18), 8 * 10**18)))
        if draw(some)
        else None,
    )


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=measurements())
def test_what_is_written_reads_back(tmp_path: Path, data: Measurements) -> None:
    path = tmp_path / "round.csv"
    write_measurements(path, data, MIXED)
    back = read_measurements(path, MIXED)
    np.testing.assert_allclose(back.q, data.q, rtol=1e-11)
    np.testing.assert_allclose(back.position, data.position, rtol=1e-11)
    assert (back.target, back.sample) == (data.target, data.sample)
    for name in ("rotation", "sigma", "stamp_ns"):
        before, after = getattr(data, name), getattr(back, name)
        assert (before is None) == (after is None)
        if before is not None and name == "stamp_ns":
            assert after.tolist() == before.tolist()
        elif before is not None:
            np.testing.assert_allclose(after, before, rtol=1e-11, atol=1e-11 * (name == "rotation"))


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    data = read(tmp_path, GOOD)
    with pytest.raises(InputError, match="cannot be written"):
        write_measurements(tmp_path / "absent" / "out.csv", data, TWO)
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]
