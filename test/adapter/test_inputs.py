# SPDX-License-Identifier: Apache-2.0
"""Edges in levels as drivers tell them, and scans as profiles, against what was true."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from robocal_ros.adapter.inputs import (
    GPIO,
    NS,
    UR_IO,
    BeamLevel,
    InputTiming,
    changes_in,
    gpio_levels,
    level_of,
    scan_profile,
    source_fault,
    ur_levels,
)
from robocal_ros.ground.errors import InputError

# ur_msgs 2.x; control_msgs of Jazzy, and as gpio_controllers used it before 2025.
UR = {
    "ur_msgs/msg/Digital": "uint8 pin\nbool state",
    "ur_msgs/msg/Analog": "uint8 pin\nuint8 domain\nfloat32 state",
    "ur_msgs/msg/IOStates": "Digital[] digital_in_states\nDigital[] digital_out_states\n"
    "Digital[] flag_states\nAnalog[] analog_in_states\nAnalog[] analog_out_states",
}
VALUES = "string[] interface_names\nfloat64[] values"
CONTROL = {
    "control_msgs/msg/InterfaceValue": VALUES,
    "control_msgs/msg/DynamicInterfaceGroupValues": "std_msgs/Header header\n"
    "string[] interface_groups\nInterfaceValue[] interface_values",
    "control_msgs/msg/DynamicJointState": "std_msgs/Header header\nstring[] joint_names\n"
    "InterfaceValue[] interface_values",
}


@pytest.fixture(scope="module")
def types() -> Any:
    """Messages of these definitions, through their serialized form."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in (UR | CONTROL).items():
        store.register(get_types_from_msg(text, name))

    def sent(kind: str, **fields: Any) -> Any:
        made = store.types[kind](**fields)
        return store.deserialize_cdr(store.serialize_cdr(made, kind), kind)

    return SimpleNamespace(sent=sent, of=store.types)


def test_inputs_of_a_universal_robot_are_told_by_pin(types: Any) -> None:
    """18 of them: 8 standard, 8 configurable, 2 of the tool."""
    digital = types.of["ur_msgs/msg/Digital"]
    high = {1, 9, 17}
    pins = [digital(pin=pin, state=pin in high) for pin in range(18)]
    others = {name: [] for name in ("flag_states", "analog_in_states", "analog_out_states")}
    outputs = [digital(pin=pin, state=pin not in high) for pin in range(18)]
    message = types.sent(
        "ur_msgs/msg/IOStates", digital_in_states=pins, digital_out_states=outputs, **others
    )
    levels = ur_levels(message)
    assert [level_of(levels, str(pin)) for pin in range(18)] == [pin in high for pin in range(18)]
    with pytest.raises(InputError, match="no input '18'; it has 0, 1, "):
        level_of(levels, "18")


@pytest.mark.parametrize(
    ("kind", "names"),
    [("DynamicInterfaceGroupValues", "interface_groups"), ("DynamicJointState", "joint_names")],
)
def test_gpio_interfaces_are_told_by_group_and_name(types: Any, kind: str, names: str) -> None:
    value = types.of["control_msgs/msg/InterfaceValue"]
    values = [
        value(interface_names=["beam_x", "beam_y"], values=np.array([1.0, 0.0])),
        value(interface_names=["beam_x", "spare"], values=np.array([0.0, np.nan])),
    ]
    stamp = types.of["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types.of["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    message = types.sent(
        f"control_msgs/msg/{kind}",
        header=header, interface_values=values, **{names: ["north", "south"]},
    )  # fmt: skip
    assert gpio_levels(message) == {
        "north/beam_x": True, "north/beam_y": False, "south/beam_x": False,
    }  # fmt: skip
    with pytest.raises(InputError, match="no input 'south/spare'"):  # NaN: no value yet
        level_of(gpio_levels(message), "south/spare")


@pytest.mark.parametrize(
    ("groups", "values", "words"),
    [
        (["north", "south"], [1.0, 0.0], "2 groups, but 1 of"),
        (["north"], [1.0], "2 names of north, but 1 of"),
        (["north"], [1.0, 0.0, 1.0], "2 names of north, but 3 of"),
    ],
)
def test_gpio_arrays_of_unequal_lengths_are_their_publishers_fault(
    types: Any, groups: list[str], values: list[float], words: str
) -> None:
    value = types.of["control_msgs/msg/InterfaceValue"]
    told = [value(interface_names=["beam_x", "beam_y"], values=np.array(values))]
    stamp = types.of["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    message = types.sent(
        "control_msgs/msg/DynamicInterfaceGroupValues",
        header=types.of["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
        interface_groups=groups, interface_values=told,
    )  # fmt: skip
    with pytest.raises(InputError, match=f"{words} their values: its publisher is at fault"):
        gpio_levels(message)


@given(
    st.floats(0.0, 0.2), st.integers(1_000, 10**9), st.booleans(),
    st.integers(0, 2**60), st.floats(1e-6, 0.1),
)  # fmt: skip
def test_an_edge_that_is_told_at_a_change_is_its_latency_earlier(
    latency_s: float, after_ns: int, blocked: bool, begin_ns: int, jitter_s: float
) -> None:
    level = BeamLevel(InputTiming(latency_s, jitter_s))
    assert level.hear(not blocked, begin_ns) is None  # what it was before is not known
    change = level.hear(blocked, begin_ns + after_ns)
    assert change is not None
    assert (change.blocked, change.sigma_s) == (blocked, jitter_s)
    assert change.stamp_ns == begin_ns + after_ns - round(latency_s * NS)
    assert level.hear(blocked, begin_ns + after_ns + 1) is None


def test_edges_of_an_input_that_is_read_every_period_are_known_by_their_sigma() -> None:
    """5000 edges at random; each message in ten is lost. The normalised error has variance one."""
    rng, period_s, latency_s, jitter_s = np.random.default_rng(1), 0.002, 0.005, 0.0002
    count = 5000
    edges_s = np.cumsum(rng.uniform(0.02, 0.05, count))
    ticks_s = np.arange(0.0, edges_s[-1] + 0.02, period_s)
    ticks_s = ticks_s[rng.random(len(ticks_s)) > 0.1]
    late_s = latency_s + jitter_s * rng.standard_normal(len(ticks_s))
    level = BeamLevel(InputTiming(latency_s, jitter_s, period_s))
    passed = np.searchsorted(edges_s, ticks_s)
    found = [
        change
        for edges, told_s in zip(passed.tolist(), (ticks_s + late_s).tolist(), strict=True)
        if (change := level.hear(edges % 2 == 1, round((1.0 + told_s) * NS))) is not None
    ]
    assert len(found) == count
    stamps = np.array([change.stamp_ns for change in found]) / NS - 1.0
    sigma_s = np.array([change.sigma_s for change in found])
    error = (stamps - edges_s) / sigma_s
    # Of 5000: the mean to 1 / sqrt(n), of a uniform error the square to sqrt(0.8 / n), a Gaussian's
    # to sqrt(2 / n); four of them.
    assert abs(error.mean()) < 4.0 / np.sqrt(count)
    assert abs(np.mean(error**2) - 1.0) < 4.0 * np.sqrt(2.0 / count)
    # The period of most, which two jitters make longer or shorter by 14 %.
    usual_s = np.hypot(jitter_s, period_s / np.sqrt(12.0))
    assert np.median(sigma_s) == pytest.approx(usual_s, rel=0.14)


@pytest.mark.parametrize("silent", ["x", "y"])
def test_a_beam_that_cannot_be_heard_leaves_the_other_to_be_heard(silent: str) -> None:
    beams = {name: (BeamLevel(InputTiming(0.0, 1e-3)), name) for name in "xy"}
    assert changes_in({"x": False, "y": False}, beams, True, NS) == ({}, None)
    levels = {"x": True, "y": True}
    del levels[silent]
    changes, wrong = changes_in(levels, beams, True, 2 * NS)
    assert list(changes) == list(levels)
    assert f"no input '{silent}'" in str(wrong)


def test_messages_out_of_order_are_told_and_the_level_counts_from_there() -> None:
    level = BeamLevel(InputTiming(0.0, 1e-3))
    level.hear(False, 5 * NS)
    with pytest.raises(InputError, match="a clock set back"):
        level.hear(True, 4 * NS)
    assert level.hear(True, 4 * NS + 1) is None
    change = level.hear(False, 4 * NS + 2)
    assert change is not None
    assert not change.blocked


@pytest.mark.parametrize(
    ("kind", "sources", "words"),
    [
        (UR_IO, ["0"], "2 beams (x, y) and 1 sources"),
        (UR_IO, ["3", "3"], "share an input"),
        (UR_IO, ["0", "beam_y"], "'beam_y' is no number"),
        (GPIO, ["io/x", "y"], "'y' is no group/interface"),
        (UR_IO, ["0", "17"], ""),
        (GPIO, ["io/x", "io/y"], ""),
    ],
)
def test_inputs_that_do_not_fit_the_beams_are_named(
    kind: str, sources: list[str], words: str
) -> None:
    fault = source_fault(kind, ["x", "y"], sources)
    assert words in fault
    assert bool(fault) is bool(words)


def scan(**fields: Any) -> Any:
    given = {"angle_min": -0.4, "angle_increment": 0.01, "time_increment": 1e-4}
    given |= {"range_min": 0.05, "range_max": 2.0}
    return SimpleNamespace(**(given | fields))


@given(st.floats(0.1, 1.0), st.floats(-0.5, 0.5))
def test_a_scan_of_a_straight_edge_is_a_straight_profile(distance_m: float, slope: float) -> None:
    """z = distance + slope x, seen from the scanner: x to its left, z ahead of it."""
    angle = -0.4 + 0.01 * np.arange(81)
    ranges = distance_m / (np.cos(angle) - slope * np.sin(angle))
    points, middle_s = scan_profile(scan(ranges=ranges.astype(np.float32)))
    assert middle_s == pytest.approx(40 * 1e-4)
    seen = points[np.isfinite(points[:, 0])]
    # float32 of the message: 6e-8 of up to 2 m
    assert seen[:, 1] == pytest.approx(distance_m + slope * seen[:, 0], abs=1e-6)
    assert seen[-1, 0] > 0.0 > seen[0, 0]  # angles grow to the left


@pytest.mark.parametrize("increment_s", [np.nan, np.inf, 1e30, -1e30])
def test_a_scan_whose_rays_have_no_time_is_refused(increment_s: float) -> None:
    """Its profile would have no stamp."""
    with pytest.raises(InputError, match="from its stamp"):
        scan_profile(scan(ranges=np.ones(81), time_increment=increment_s))


def test_rays_without_a_return_are_no_points() -> None:
    ranges = np.full(81, 0.5)
    ranges[[3, 4, 5, 6]] = np.inf, np.nan, 0.01, 2.5
    points, _ = scan_profile(scan(ranges=ranges))
    assert np.flatnonzero(np.isnan(points[:, 0])).tolist() == [3, 4, 5, 6]
    with pytest.raises(InputError, match="a scan of 0 rays"):
        scan_profile(scan(ranges=np.empty(0)))
