# SPDX-License-Identifier: Apache-2.0
"""Pairing of measurements and joints: by stamps alone."""

import math
from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POINT,
    MEASURED_POSE,
    REFERENCE_SPHERE,
    JointSample,
    JointStream,
    PointSample,
    Reading,
    StandstillRule,
)
from robocal_ros.session.inputs import MOST_REASONS
from robocal_ros.thermal.observations import MOST_WAITING, ObservationDesk, as_measurements

MS = 1_000_000
NAMES = ("a", "b")
ALL = {JOINTS: 2**62, MEASURED_POINT: 2**62, MEASURED_POSE: 2**62}
RULE = StandstillRule(before_s=0.3, after_s=0.1, tolerance_rad=1e-3, gap_s=0.25)


def joints(ms: int, *q: float, names: tuple[str, ...] = NAMES) -> JointSample:
    return JointSample(ms * MS, names, np.array(q or (0.1, 0.2)))


def point(ms: int, x: float = 1.0, frame: str = "sensor", target: str = "ball") -> PointSample:
    return PointSample(ms * MS, frame, target, np.array([x, 2.0, 3.0]))


def pose(ms: int, frame: str = "sensor", target: str = "ball") -> PointSample:
    return PointSample(ms * MS, frame, target, np.zeros(3), MEASURED_POSE, rotation=np.eye(3))


def desk(frame: str | None = None) -> ObservationDesk:
    return ObservationDesk(NAMES, RULE, frame)


def stand(desk: ObservationDesk, start_ms: int, end_ms: int, step_ms: int = 100) -> None:
    for ms in range(start_ms, end_ms + 1, step_ms):
        desk.add_joints(joints(ms))


def everything(desk: ObservationDesk):
    return desk.window(-1, 2**62, ALL)


def test_a_measurement_gets_the_joints_of_its_stamp():
    d = desk()
    for ms in range(1000, 2001, 100):
        d.add_joints(joints(ms, 0.1 + 1e-7 * ms, 0.2))
    d.add_measurement(point(1650))
    (found,) = everything(d)
    assert found.q == pytest.approx([0.1 + 1e-7 * 1650, 0.2], abs=1e-12)
    assert found.ready_ns == 1800 * MS  # the reading that ends the standstill window
    assert (found.sample.topic, found.sample.frame, found.sample.target) == (
        MEASURED_POINT,
        "sensor",
        "ball",
    )


@pytest.mark.parametrize("first", ["joints", "measurement"])
def test_early_and_late_arrival_are_the_same(first):
    d = desk()
    if first == "measurement":
        d.add_measurement(point(1500))
        assert everything(d) == []
    stand(d, 1000, 2000)
    if first == "joints":
        d.add_measurement(point(1500))
    (found,) = everything(d)
    assert found.ready_ns == 1600 * MS


def test_a_measurement_waits_for_the_end_of_its_standstill():
    d = desk()
    stand(d, 1000, 1500)
    d.add_measurement(point(1450))
    assert everything(d) == []
    d.add_joints(joints(1600))
    assert len(everything(d)) == 1


def test_a_robot_that_moves_after_the_measurement_spoils_it():
    d = desk()
    stand(d, 1000, 1500)
    d.add_joints(joints(1600, 0.15, 0.2))
    d.add_measurement(point(1500))
    assert everything(d) == []
    assert d.ignored[MEASURED_POINT] == {"a moved by # deg (allowed # deg)": 1}


def test_a_pause_of_the_joints_spoils_a_measurement_and_is_counted():
    d = desk()
    stand(d, 1000, 1300)
    stand(d, 1700, 2000)
    d.add_measurement(point(1600))
    assert everything(d) == []
    assert d.stream.gap_count == 1
    assert d.stream.longest_gap_ns == 400 * MS
    assert d.ignored[MEASURED_POINT] == {"joint readings pause for # s (allowed # s)": 1}


def test_a_measurement_before_the_first_joints_is_named():
    d = desk()
    d.add_measurement(point(1100))
    stand(d, 1000, 1500)
    assert d.ignored[MEASURED_POINT] == {"no joint readings from before the measurement": 1}
    assert d.from_ns == 1300 * MS  # from here on windows are complete


@pytest.mark.parametrize("other", [9.0, math.nan])
def test_joints_by_name_in_any_order_beside_others(other):
    d = desk()
    for ms in range(1000, 2001, 100):
        d.add_joints(joints(ms, other, 0.2, 0.1, names=("gripper", "b", "a")))
    d.add_measurement(point(1500))
    assert everything(d)[0].q == pytest.approx([0.1, 0.2])


def test_unusable_joints_are_counted_by_reason():
    d = desk()
    stand(d, 1000, 2000)
    d.add_joints(joints(2100, 0.1, names=("a",)))
    d.add_joints(joints(2000))
    d.add_joints(joints(1950))
    d.add_joints(joints(0))
    assert sum(d.ignored[JOINTS].values()) == 4
    assert d.ignored[JOINTS]["joint state at # ns is not after # ns"] == 2
    assert d.ignored[JOINTS]["no time stamp"] == 1
    assert d.ignored[JOINTS]["joint state has no position of b; it has a"] == 1
    assert d.newest_ns[JOINTS] == 2000 * MS


def test_a_clock_that_jumps_back_begins_anew():
    d = desk()
    stand(d, 10_000, 11_000)
    d.add_measurement(point(10_500))
    d.add_measurement(point(12_000))  # waits for joints that never come
    d.use(10_200 * MS)
    stand(d, 1000, 2000)
    assert d.ignored[MEASURED_POINT] == {"the clock jumped back": 2}
    assert d.newest_ns == {JOINTS: 2000 * MS}
    d.add_measurement(point(1500))
    assert [o.sample.stamp_ns for o in everything(d)] == [1500 * MS]
    assert d.from_ns == 1300 * MS


def test_another_frame_is_refused_where_the_frame_is_set():
    d = desk("sensor")
    stand(d, 1000, 2000)
    d.add_measurement(point(1500, frame="camera"))
    assert everything(d) == []
    assert d.ignored[MEASURED_POINT] == {"frame 'camera' is not the measuring frame 'sensor'": 1}


@pytest.mark.parametrize("order", [(1500, 1600), (1600, 1500)])
def test_the_earliest_observation_gives_the_frame(order):
    """Not the first that arrived: that would depend on the network."""
    d = desk()
    stand(d, 1000, 2000)
    frames = {1500: "sensor", 1600: "camera"}
    for ms in order:
        d.add_measurement(point(ms, frame=frames[ms]))
    assert [o.sample.frame for o in everything(d)] == ["sensor"]
    assert d.frame == "sensor"
    assert sum(d.ignored[MEASURED_POINT].values()) == 1
    d.add_measurement(point(1700, frame="camera"))
    assert len(everything(d)) == 1


def test_a_target_counts_once_at_a_stamp_and_the_pose_before_the_point():
    d = desk()
    stand(d, 1000, 2000)
    d.add_measurement(point(1500, 1.0))
    d.add_measurement(point(1500, 9.0))
    d.add_measurement(point(1600))
    d.add_measurement(pose(1600))
    d.add_measurement(point(1500, 5.0, target="cube"))
    found = everything(d)
    assert [(o.sample.stamp_ns // MS, o.sample.target, o.sample.topic) for o in found] == [
        (1500, "ball", MEASURED_POINT),
        (1500, "cube", MEASURED_POINT),
        (1600, "ball", MEASURED_POSE),
    ]
    assert found[0].sample.position_m[0] == 1.0
    samples = as_measurements(found).sample
    assert len(set(samples)) == 3


@pytest.mark.parametrize("first", [0, 1])
def test_a_sphere_in_the_cell_may_have_the_stamp_and_the_name_of_the_target(first):
    """A scanner that sees both at once gives them one header."""
    d = desk()
    stand(d, 1000, 2000)
    both = [point(1500), replace(point(1500, 9.0), topic=REFERENCE_SPHERE)]
    for sample in (both[first], both[1 - first]):
        d.add_measurement(sample)
    found = d.window(-1, 2**62, ALL | {REFERENCE_SPHERE: 2**62})
    assert {o.sample.topic: o.sample.position_m[0] for o in found} == {
        MEASURED_POINT: 1.0,
        REFERENCE_SPHERE: 9.0,
    }


def test_orientations_only_where_all_have_one():
    d = desk()
    stand(d, 1000, 2000)
    d.add_measurement(pose(1500))
    assert as_measurements(everything(d)).rotation is not None
    d.add_measurement(point(1600))
    assert as_measurements(everything(d)).rotation is None


def test_a_window_holds_what_lies_between_its_bounds_and_before_its_marks():
    d = desk()
    stand(d, 1000, 3000)
    for ms in (1500, 2000, 2500):
        d.add_measurement(point(ms))
    stamps = lambda *w: [o.sample.stamp_ns // MS for o in d.window(*w)]  # noqa: E731
    assert stamps(1500 * MS, 2500 * MS, ALL) == [2000, 2500]
    assert stamps(-1, 2499 * MS, ALL) == [1500, 2000]
    assert stamps(-1, 2500 * MS, ALL | {JOINTS: 2100 * MS}) == [1500, 2000]
    assert stamps(-1, 2500 * MS, ALL | {MEASURED_POINT: 1500 * MS}) == [1500]
    assert stamps(-1, 2500 * MS, {}) == []


def test_nothing_grows_without_bound():
    d = desk()
    for ms in range(1000, 1000 + MOST_WAITING + 10):
        d.add_measurement(point(ms))
    assert d.ignored[MEASURED_POINT] == {"no joint readings came": 10}
    for number in range(3 * MOST_REASONS):
        d.ignored.add(MEASURED_POSE, f"frame 'f{number}' is unknown")
    assert len(d.ignored[MEASURED_POSE]) == MOST_REASONS + 1
    assert sum(d.ignored[MEASURED_POSE].values()) == 3 * MOST_REASONS


class CountedStream(JointStream):
    """A joint stream that counts the questions asked of it."""

    asked = 0

    def standstill(self, stamp_ns: int, rule: StandstillRule) -> Reading | None:
        self.asked += 1
        return super().standstill(stamp_ns, rule)


def test_measurements_whose_joints_are_far_off_cost_nothing_and_displace_none():
    """A joint reading asks for one waiting measurement beyond those that it completes."""
    d = desk()
    d.stream = stream = CountedStream(NAMES)
    for ms in range(MOST_WAITING):
        d.add_measurement(point(10**9 + ms))
    d.add_measurement(point(1500))  # the last to come, the first to be complete
    stream.asked = 0
    stand(d, 1000, 2000)
    assert [o.sample.stamp_ns for o in everything(d)] == [1500 * MS]
    assert stream.asked == 10 + 1  # the first reading alone begins nothing


HOUR_MS = 3_600_000


@pytest.mark.parametrize("off_ms", [HOUR_MS, -1900])
def test_one_wrong_joint_stamp_costs_that_reading_only(off_ms):
    d = desk()
    stand(d, 2000, 3000)
    d.add_measurement(point(2500))
    d.use(2300 * MS)
    d.add_joints(joints(3050 + off_ms))
    stand(d, 3100, 4000)
    d.add_measurement(point(3500))
    assert [o.sample.stamp_ns // MS for o in everything(d)] == [2500, 3500]
    assert d.marks == {JOINTS: 4000 * MS, MEASURED_POINT: 3500 * MS, JUMPS: 0}
    assert d.from_ns == 2300 * MS + 1
    assert d.ignored == {JOINTS: {"a stamp that no reading goes on from, # s off": 1}}


def test_a_wrong_first_joint_stamp_begins_nothing():
    d = desk()
    d.add_measurement(point(1500))
    d.add_joints(joints(1000 + HOUR_MS))
    stand(d, 1000, 2000)
    assert [o.sample.stamp_ns // MS for o in everything(d)] == [1500]
    assert d.jumps == 0


def test_one_measurement_from_the_future_moves_no_mark():
    d = desk()
    d.add_measurement(point(HOUR_MS))
    stand(d, 1000, 2000)
    d.add_measurement(point(1500))
    assert d.clock_ns == 2000 * MS
    assert d.marks == {JOINTS: 2000 * MS, MEASURED_POINT: 1500 * MS, JUMPS: 0}
    d.add_measurement(point(2300))  # a little ahead of its joints: it is of now
    assert d.clock_ns == 2300 * MS
    d.drop_far_ahead()
    assert d.ignored[MEASURED_POINT] == {"stamped # s after the newest joint reading": 1}
    stand(d, 2100, 3000)
    assert [o.sample.stamp_ns // MS for o in everything(d)] == [1500, 2300]


@pytest.mark.parametrize("jump_ms", [-60_000, -3_000, 5_000])
def test_where_the_clock_jumps_the_order_of_arrival_does_not_matter(jump_ms):
    """Points up to 0.8 s before or after their joints, the topics each in their own order."""
    before, after = range(100_000, 102_000, 100), range(102_000, 106_000, 100)
    arrivals = [(ms, joints(ms)) for ms in before]
    arrivals += [(ms, joints(ms + jump_ms)) for ms in after]
    measured = [(ms, point(ms)) for ms in (100_650, 101_650, 101_850)]
    measured += [(ms, point(ms + jump_ms)) for ms in (102_050, 102_350, 102_650, 103_650)]
    found = set()
    for lag_ms in range(-800, 801, 50):
        d = desk()
        late = [(ms + lag_ms, sample) for ms, sample in measured]
        for _, sample in sorted([*arrivals, *late], key=lambda item: item[0]):
            d.add_joints(sample) if isinstance(sample, JointSample) else d.add_measurement(sample)
        assert d.jumps == (jump_ms < 0)
        found.add((tuple(o.sample.stamp_ns // MS for o in everything(d)), *d.marks.values()))
    assert len(found) == 1
    stamps = found.pop()[0]
    on_new_clock = tuple(ms + jump_ms for ms in (102_350, 102_650, 103_650))
    assert stamps == (on_new_clock if jump_ms < 0 else (100_650, 101_650, *on_new_clock))


def test_a_stream_knows_which_way_each_joint_went_last():
    """Of a joint that came, of one that came back by less than its play may be, of one at rest."""
    stream = JointStream(("a", "b", "c"))
    way = [(0.0, 0.0, 0.5), (0.01, 0.01, 0.5), (0.02, 0.02, 0.5), (0.01, 0.0199, 0.5)]
    for i, q in enumerate([*way, way[-1]]):
        stream.add(JointSample((i + 1) * 100 * MS, ("a", "b", "c"), np.array(q)), 10**9)
    assert stream.side(500 * MS, 0.25).tolist() == [-1.0, 1.0, 0.0]
    assert stream.side(300 * MS, 0.25).tolist() == [1.0, 1.0, 0.0]
    assert stream.side(1 * MS, 0.25).tolist() == [0.0, 0.0, 0.0]


def test_what_happened_in_a_pause_of_the_readings_is_not_known():
    stream = JointStream(NAMES)
    for ms, q in ((100, (0.0, 0.0)), (200, (0.1, 0.1)), (900, (0.1, 0.2)), (1000, (0.1, 0.3))):
        stream.add(joints(ms, *q), 10**9)
    assert stream.side(1000 * MS, 0.25).tolist() == [0.0, 1.0]
