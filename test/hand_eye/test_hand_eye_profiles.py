# SPDX-License-Identifier: Apache-2.0
"""Profiles as makers' sensors tell them: read as a description says, or refused in its words."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hand_eye_driver import FRAME, namespace, profile, sphere_set
from hand_eye_laser import begun
from hypothesis import given
from hypothesis import strategies as st

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.data import shot_of
from robocal_ros.hand_eye.files import read_profile
from robocal_ros.hand_eye.profiles import (
    DEFAULT,
    PRESETS,
    SensorDescription,
    cloud_profile,
    sensor_of,
)
from robocal_ros.hand_eye.session import HandEyeConfig
from robocal_ros.session import events

PITCH_MM = 0.05
X_MM = PITCH_MM * (np.arange(301) - 150.0)
Z_MM = np.round(4.0 - 0.002 * X_MM**2 + 0.3 * np.sin(X_MM), 4)
TRUTH = 1e-3 * np.column_stack([X_MM, Z_MM])
HEAD = """ply
format {form} 1.0
comment a sensor
element vertex {n}
property {t} x
property {t} y
property {t} z
property uchar intensity
element face 0
property list uchar int i
end_header
"""


def rows(*columns: np.ndarray, mark: str = ",", form: str = "{:.6f}") -> str:
    return "\n".join(mark.join(form.format(v) for v in row) for row in zip(*columns, strict=True))


def semicolons(path: Path) -> SensorDescription:
    """German: in µm, with a preamble, a line without a return and one of a word."""
    lines = rows(1e3 * X_MM, 1e3 * Z_MM, X_MM * 0.0 + 80.0, mark=";").replace(".", ",")
    path.write_text(
        f"Sensor;0815\n\nX;Z;I\n{lines}\n7,5;;80\n7,6;---;80\n7,7;100,0;3\n", encoding="utf-8-sig"
    )
    return SensorDescription(x="X", z="Z", unit="um", intensity="I", least_intensity=10.0)


def numbered(path: Path) -> SensorDescription:
    path.write_text("a profile of 301 points\n" + rows(X_MM, 0.0 * X_MM, Z_MM, mark=" "))
    return SensorDescription(x="1", z="3")


def counted(path: Path) -> SensorDescription:
    """Counts of 0.1 um about 32768, where 0 is no return: the first column here."""
    counts = np.concatenate([[0.0], np.round(1e4 * Z_MM) + 32768.0])
    path.write_text("height\n" + rows(counts, form="{:.0f}"))
    return SensorDescription(
        z="height", x_pitch_mm=PITCH_MM, x_start_mm=X_MM[0] - PITCH_MM,
        z_step_mm=1e-4, z_zero=32768.0, no_return=(0.0,),
    )  # fmt: skip


def lines(path: Path) -> SensorDescription:
    """Three profiles, the middle one whole."""
    half = [str(z) for z in Z_MM]
    half[200:] = ["" for _ in half[200:]]
    whole = ",".join(map(str, Z_MM))
    path.write_text("\n".join(["made by a sensor", ",".join(half), whole, ",".join(half)]))
    return SensorDescription(z="height", lines=True, x_pitch_mm=PITCH_MM)


def several(path: Path) -> SensorDescription:
    short = slice(0, 200)
    x, z = np.concatenate([X_MM[short], X_MM]), np.concatenate([Z_MM[short], Z_MM])
    number = np.repeat([4.0, 5.0], [200, 301])
    path.write_text("no,x,z\n" + rows(number, x, z))
    return SensorDescription(x="x", z="z", row="no")


def ply(order: str):
    def write(path: Path) -> SensorDescription:
        weak = np.append(np.full(len(X_MM), 90), 2)
        points = np.vstack([np.insert(TRUTH * 1e3, 1, 0.0, axis=1), [0.0, 0.0, 99.0]])
        form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
        head = HEAD.format(form=form, n=len(points), t="double")
        if not order:
            body = rows(*points.T, weak, mark=" ").encode()
        else:
            kind = [(name, f"{order}f8") for name in "xyz"] + [("i", "u1")]
            table = np.empty(len(points), dtype=kind)
            table["x"], table["y"], table["z"] = points.T
            table["i"] = weak
            body = table.tobytes()
        path.write_bytes(head.encode() + body)
        return SensorDescription(intensity="intensity", least_intensity=10.0)

    return write


def pcd(form: str):
    def write(path: Path) -> SensorDescription:
        """Organised, in m: a profile with gaps, and the whole one."""
        gaps = TRUTH.copy()
        gaps[50:90] = np.nan
        points = np.vstack([np.insert(p, 1, y, axis=1) for y, p in enumerate([gaps, TRUTH])])
        head = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z normal\nSIZE 8 8 8 4\nTYPE F F F F\n"
            f"COUNT 1 1 1 3\nWIDTH {len(TRUTH)}\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\n"
            f"POINTS {len(points)}\nDATA {form}\n"
        )
        if form == "ascii":
            body = rows(*points.T, *np.zeros((3, len(points))), mark=" ", form="{:.9f}").encode()
        else:
            table = np.zeros(
                len(points), dtype=[*((n, "<f8") for n in "xyz"), ("normal", "<f4", (3,))]
            )
            table["x"], table["y"], table["z"] = points.T
            body = table.tobytes()
        path.write_bytes(head.encode() + body)
        return SensorDescription(unit="m")

    return write


FILES = {
    "semicolons and decimal commas": (semicolons, ".csv"),
    "columns by number": (numbered, ".txt"),
    "counts at a pitch": (counted, ".csv"),
    "a profile in each line": (lines, ".csv"),
    "a column that numbers profiles": (several, ".csv"),
    "PLY, text": (ply(""), ".ply"),
    "PLY, little endian": (ply("<"), ".ply"),
    "PLY, big endian": (ply(">"), ".PLY"),
    "PCD, text": (pcd("ascii"), ".pcd"),
    "PCD, binary": (pcd("binary"), ".pcd"),
}


def preamble(path):
    path.write_text("Scan of 3 May, line 2; by hand\nX,Z\n" + rows(X_MM, Z_MM))
    return SensorDescription(x="X", z="Z")


def blanks(path):
    text = rows(X_MM, Z_MM).replace(",", " ").replace(".", ",")
    path.write_text("Scan of 3 May, line 2\n" + text)
    return SensorDescription(x="1", z="2")


FILES |= {
    "a preamble with other marks": (preamble, ".csv"),
    "blanks and decimal commas": (blanks, ".txt"),
}


@pytest.mark.parametrize("what", FILES)
def test_what_is_written_is_read(tmp_path, what):
    write, suffix = FILES[what]
    path = tmp_path / f"p{suffix}"
    found = read_profile(path, "p", write(path))
    assert found.points == pytest.approx(TRUTH, abs=2e-9)  # a unit of the last written digit


def cloud(points, height=1, **fields):
    """A message of points (n, 3) in 64 bits and further fields."""
    names = ["x", "y", "z", *fields]
    data = np.column_stack([points, *fields.values()]).astype("<f8")
    template = profile(1, np.zeros((1, 2))).fields | {
        "height": height,
        "width": len(data) // height,
        "fields": [
            {"name": n, "offset": 8 * i, "datatype": 8, "count": 1} for i, n in enumerate(names)
        ],
        "point_step": 8 * len(names),
        "row_step": 8 * len(names) * (len(data) // height),
        "data": data.tobytes(),
    }
    return namespace(template)


THREE = np.vstack([np.insert(TRUTH, 1, 0.0, axis=1)] * 3)
WHOLE = slice(301, 602)  # the middle one of three; the others have gaps
THREE[10:60, 2] = THREE[700:760, 2] = np.nan
BY_Y = THREE + np.outer(np.repeat([0.01, 0.02, 0.03], 301), [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("message", "sensor"),
    [
        (cloud(THREE, height=3), DEFAULT),
        (cloud(BY_Y), DEFAULT),
        (cloud(THREE), DEFAULT),
        (cloud(THREE[::-1]), DEFAULT),
        (cloud(THREE, ring=np.repeat([9.0, 7.0, 8.0], 301)), SensorDescription(row="ring")),
        (cloud(THREE * 1e3), SensorDescription(cloud_unit="mm")),
    ],
    ids=["organised", "by y", "x begins anew", "backwards", "by a field", "in mm"],
)
def test_of_several_profiles_in_a_cloud_the_fullest_is_read(message, sensor):
    found = cloud_profile(message, sensor).points
    found = found if found[0, 0] < found[-1, 0] else found[::-1]
    assert found == pytest.approx(TRUTH, abs=1e-15)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_the_order_of_an_unorganised_cloud_does_not_matter(seed, by_y):
    order = np.random.default_rng(seed).permutation(len(THREE))
    points = BY_Y[order] if by_y else np.insert(TRUTH, 1, 0.0, axis=1)[order[order < 301]]
    found = cloud_profile(cloud(points), SensorDescription(ordered=False)).points
    assert found == pytest.approx(TRUTH, abs=1e-15)


def test_a_column_of_points_is_one_profile():
    message = cloud(np.insert(TRUTH, 1, 0.0, axis=1), height=len(TRUTH))
    assert cloud_profile(message).points == pytest.approx(TRUTH, abs=1e-15)


def test_what_stands_for_no_return_is_known_in_32_bits():
    """-99.9999 in a cloud of 32 bits is another number than in a description."""
    points = np.insert(TRUTH, 1, 0.0, axis=1)
    points[::5, 2] = float(np.float32(TRUTH[0, 1] + 1e-4))
    sensor = SensorDescription(no_return=(TRUTH[0, 1] + 1e-4,))
    assert len(cloud_profile(cloud(points), sensor).points) == np.sum(
        np.arange(len(points)) % 5 > 0
    )


def test_padding_in_a_pcd_is_passed_over(tmp_path):
    """As PCL writes its types with normals and intensity."""
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("a", "u1", (4,)), ("i", "<f4"),
            ("b", "u1", (12,))]  # fmt: skip
    table = np.zeros(len(TRUTH), np.dtype(kind))
    table["x"], table["z"] = TRUTH.T
    head = (
        f"FIELDS x y z _ intensity _\nSIZE 4 4 4 1 4 1\nTYPE F F F U F U\nCOUNT 1 1 1 4 1 12\n"
        f"WIDTH {len(TRUTH)}\nHEIGHT 1\nDATA binary\n"
    )
    path = tmp_path / "p.pcd"
    path.write_bytes(head.encode() + table.tobytes())
    found = read_profile(path, "p", SensorDescription(unit="m"))
    assert found.points == pytest.approx(TRUTH, abs=1e-7)


PLY_HEAD = "ply\nformat {}\nelement vertex 0\nproperty float x\nproperty float z\nend_header\n"
PCD_HEAD = "FIELDS x z\nSIZE 4 4\nTYPE F F\nCOUNT {}\nWIDTH 0\nHEIGHT 1\nDATA {}\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.ply", PLY_HEAD.format("ascii 1.0")),
        ("b.ply", PLY_HEAD.format("binary_little_endian 1.0")),
        ("a.pcd", PCD_HEAD.format("1 1", "ascii")),
        ("b.pcd", PCD_HEAD.format("1 1", "binary")),
    ],
)
def test_a_cloud_without_points_is_a_shot_that_saw_nothing(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(TooFewSamplesError, match="has 0 points"):
        read_profile(tmp_path / name, "p")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.ply", PLY_HEAD.format("binary_little_endian 1.0").replace(" z", " x")),
        ("a.pcd", PCD_HEAD.format("1 0", "binary")),
    ],
)
def test_fields_that_cannot_be_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="cannot be read"):
        read_profile(tmp_path / name, "p")


XZ = SensorDescription(x="X", z="Z")
REFUSED = {
    "no such column": ("a,b\n1,2", XZ, "no line names the columns X, Z"),
    "nothing seen": ("X,Z\n" + "1,\n" * 20, XZ, "has 0 points"),
    "no numbers": ("X,Z\nx,z\n", XZ, "holds numbers"),
    "another unit": ("X,Z\n" + rows(X_MM, Z_MM), replace(XZ, unit="um"), "too small"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_table_that_is_not_as_described_is_refused(tmp_path, what):
    text, sensor, words = REFUSED[what]
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises((InputError, TooFewSamplesError), match=words):
        read_profile(tmp_path / "p.csv", "p", sensor)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@given(st.data())
def test_a_damaged_cloud_is_refused(tmp_path_factory, suffix, data):
    path = tmp_path_factory.mktemp("damaged") / f"p{suffix}"
    sensor = (ply("<") if suffix == ".ply" else pcd("binary"))(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(InputError, match=r"p\.p"):
        read_profile(path, "p", sensor)


def test_a_description_is_read_and_kept_by_a_recording(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text(
        "preset: lmi-gocator\nx: 1\nz: 2\nunit: um\nnear_mm: 12\nfar_mm: -12.5\nordered: false\n"
    )
    found = sensor_of(str(path))
    assert found == replace(
        PRESETS["lmi-gocator"], x="1", z="2", unit="um", near_mm=12.0, far_mm=-12.5, ordered=False
    )
    with pytest.raises(InputError, match=r"far_mm -12\.5, but z grows away from the sensor"):
        sensor_of(str(path), "away")  # as is said beside it, for the file and its range too
    path.write_text("z_grows: away\nnear_mm: 12\nfar_mm: -12.5\n")
    assert sensor_of(str(path), "towards").towards
    path.write_text("no_return: -5\n")
    assert sensor_of(str(path)).no_return == (-5.0,)
    config = HandEyeConfig(sensor=found)
    assert HandEyeConfig.of_document(json.loads(json.dumps(asdict(config)))) == config
    before = json.loads(json.dumps(asdict(HandEyeConfig())))  # of a version without descriptions
    del before["sensor"]
    told = HandEyeConfig.of_document(before | {"z_grows": "towards"})
    assert told == HandEyeConfig(sensor=SensorDescription(z_grows="towards"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("preset: lmi", "preset is 'lmi'; it must be"),
        ("z_grow: away", "'z_grow' is not a known key .did you mean 'z_grows'"),
        ("x: X", "z must be given with the other one|x must be given with the other one"),
        ("x: X\nz: Z\nx_pitch_mm: 0.1", "x_pitch_mm is given beside x"),
        ("z: Z\nlines: true", "must be given with the other one|lines needs x_pitch_mm"),
        ("least_intensity: 4", "least_intensity needs intensity"),
        ("near_mm: 3", "both near_mm and far_mm"),
        ("near_mm: 12\nfar_mm: -12", "near_mm is 12, far_mm -12, but z grows away from .*z_grows"),
        ("near_mm: 2\nfar_mm: 2", "the field has no depth"),
        ("unit: cm", "unit is 'cm'"),
        ("x_pitch_mm: 0", "must be above 0"),
        ("ordered: 1", "ordered must be true or false"),
        ("x: 0\nz: 1", "columns count from 1"),
        ("no_return: none", "no_return is 'none', not a number"),
    ],
)
def test_half_a_description_is_refused(tmp_path, text, words):
    path = tmp_path / "sensor.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        sensor_of(str(path))
    assert caught.value.file == str(path)
    with pytest.raises(InputError, match="no file, and none of keyence"):
        sensor_of("nobody")


def test_a_field_in_heights_is_no_field_of_a_sensor_that_tells_distances():
    """A plan would be judged by the one, and the profiles be read by the other."""
    field = (10.0, -10.0, 60.0, 0.037)
    assert SensorDescription(z_grows="towards").seen_range(*field).sense == -1.0
    with pytest.raises(InputError, match=r"from 10 to -10 mm, but its z grows away .*z_grows"):
        SensorDescription(z_grows="away").seen_range(*field)


def test_a_session_reads_what_its_sensor_tells(history):
    """Heights in mm, two profiles in a cloud: the samples are those of plain messages."""
    points = sphere_set()[1].profiles[0]
    whole = np.insert(1e3 * points, 1, 0.0, axis=1)
    gaps = whole.copy()
    gaps[:30, 2] = np.nan
    sensor = SensorDescription(z_grows="towards", cloud_unit="mm", row="line")
    driver = begun(history, sensor=sensor)
    assert driver.ask(events.CAPTURE).done
    message = cloud(np.vstack([gaps, whole]), line=np.repeat([0.0, 1.0], len(points)))
    shot = profile(1, points)

    def shown(stamp_ns):
        header = profile(stamp_ns, points).fields["header"] | {"frame_id": FRAME}
        return shot._replace(stamp_ns=stamp_ns, fields=vars(message) | {"header": header})

    driver.robot.rest(0.8, shown)
    (sample,) = driver.session.data.samples.values()
    seen = points[np.all(np.isfinite(points), axis=1)]
    assert sample.values == pytest.approx(seen, abs=1e-12)
    assert shot_of("profile", message, sensor).read() == pytest.approx(seen, abs=1e-12)
