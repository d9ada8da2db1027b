# SPDX-License-Identifier: Apache-2.0
"""What a PLC writes, judged: each heartbeat is passed on once, each edge at its own time."""

from hypothesis import given
from hypothesis import strategies as st

from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.plc.cell import (
    CLOCK_NS,
    CONTEST_S,
    CONTESTED,
    GOOD,
    INVALID_TIME,
    BeamInput,
    Heartbeat,
    HeartbeatInput,
)

TIMES = st.one_of(st.none(), st.integers(0, 50))
WRITES = st.lists(
    st.tuples(st.sampled_from("ab"), st.integers(0, 2**32 - 1), TIMES, st.floats(0.0, 0.7)),
    max_size=40,
)


@given(WRITES)
def test_a_heartbeat_is_passed_on_at_most_once_and_only_of_one_writer(writes):
    """Whatever two sessions write: an open gap is passed on only of one that alone has written for
    `CONTEST_S`, and never with a time that is not later than all times before in its session.
    """
    heard, now_s = HeartbeatInput(), 0.0
    accepted_s: dict[str, float] = {}
    newest: dict[str, int] = {}
    for session, echo, source_ns, pause_s in writes:
        now_s += pause_s
        came = heard.write(session, echo, source_ns, now_s)
        known = newest.get(session)
        latched = known is not None and (source_ns is None or source_ns <= known)
        assert (came.status == INVALID_TIME) is latched
        if latched:
            assert came.passed == (None if echo else Heartbeat(0, now_s))
            assert came.words
            continue
        if source_ns is not None:
            newest[session] = source_ns
        other_s = accepted_s.get("b" if session == "a" else "a", -1e9)
        contested = now_s - other_s <= CONTEST_S
        accepted_s[session] = now_s
        assert came.passed is not None
        assert came.passed.at_s == now_s
        assert came.passed.echo == (0 if contested else echo)
        assert came.status == (CONTESTED if contested else GOOD)


def test_a_new_session_begins_anew_and_an_ended_one_contests_nothing():
    heard = HeartbeatInput()
    assert heard.write("first", 5, 1000, 0.0).status == GOOD
    heard.end("first")
    assert heard.write("second", 6, 10, 0.1).passed.echo == 6  # a PLC whose clock began again


def test_a_0_closes_the_gap_whatever_its_time():
    """Finding: of a PLC whose clock was set back, or that gave no time, the robot moved on."""
    heard = HeartbeatInput()
    assert heard.write("plc", 5, 1000, 0.0).passed == Heartbeat(5, 0.0)
    for source_ns in (None, 999, 1000):
        came = heard.write("plc", 0, source_ns, 0.1)
        assert (came.status, came.passed) == (INVALID_TIME, Heartbeat(0, 0.1))


STEP = 10_000_000


@given(st.lists(st.tuples(st.booleans(), st.integers(-2, 20)), max_size=30), st.floats(0.0, 0.5))
def test_edges_are_the_changes_of_levels_at_their_times(levels, latency_s):
    beam = BeamInput(InputTiming(latency_s, 2e-3))
    at_ns = wall_ns = 1_700_000_000_000_000_000
    before: bool | None = None
    for blocked, steps in levels:
        told_ns = at_ns + steps * STEP
        came = beam.write(blocked, told_ns, wall_ns)
        early = before is not None and told_ns < at_ns
        assert (came.status == INVALID_TIME) is early
        if not early and before is not None and blocked is not before:
            assert came.edge is not None
            assert came.edge.blocked is blocked
            assert came.edge.stamp_ns == told_ns - round(latency_s * 1e9)
            assert came.edge.sigma_s == 2e-3
        else:
            assert came.edge is None
        before, at_ns = blocked, told_ns
        wall_ns = max(wall_ns, told_ns)


def test_a_level_needs_a_time_near_this_machines():
    beam, wall_ns = BeamInput(InputTiming(0.0, 1e-3)), 10**18
    assert beam.write(True, None, wall_ns).status == INVALID_TIME
    for off_ns in (CLOCK_NS + 1, -CLOCK_NS - 1):
        refused = beam.write(True, wall_ns + off_ns, wall_ns)
        assert refused.status == INVALID_TIME
        assert "synchronise the PLC's clock" in refused.words
    assert beam.write(True, wall_ns - CLOCK_NS, wall_ns) == (GOOD, None, "")
    assert beam.write(False, wall_ns, wall_ns).edge is not None
    beam.restart()
    assert beam.write(True, wall_ns, wall_ns).edge is None  # what was before is not known
