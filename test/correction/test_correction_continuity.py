"""Whatever happens in whatever order, no joint is commanded a jump."""

from collections.abc import Callable

import numpy as np
from correction_robot import (
    DT,
    HOME,
    NAMES,
    NOMINAL,
    NOT_STRAIGHT,
    RATE,
    ROUNDING,
    Robot,
    bent_tool,
    drifted,
    offer,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.inputs import OfferedTool, TrajectoryCommand

EVENTS = st.lists(
    st.tuples(
        st.sampled_from(
            ["on", "off", "model", "nominal", "tool", "taught tool", "stop", "nothing"]
        ),
        st.integers(0, 5),
        st.integers(1, 60),
    ),
    min_size=1,
    max_size=12,
)


def happen(
    robot: Robot, what: str, seed: int, revision: int, change_tool: Callable[[OfferedTool], None]
) -> None:
    session = robot.session
    if what in ("on", "off"):
        session.enable(what == "on")
    elif what == "model":
        session.offer_model(offer(drifted(0.4 * seed, seed), revision))
    elif what == "nominal":
        session.offer_model(offer(NOMINAL, revision))
    elif what == "tool":
        change_tool(bent_tool(1e-3 * seed, 0.3 * seed))
    elif what == "taught tool":
        change_tool(bent_tool(0.0, 0.0))
    elif what == "stop":
        empty = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
        assert session.trajectory(empty, robot.now) is empty


def blend_since(robot: Robot, sent_s: float) -> float:
    """Largest step of a blend between two targets: a pause counts for no more than is stated."""
    return RATE * min(robot.now - sent_s, CorrectionConfig().longest_step_s)


@settings(max_examples=25, deadline=None)
@given(EVENTS)
def test_no_sequence_of_events_makes_a_stream_jump(events: list[tuple[str, int, int]]) -> None:
    """At a standing target every step is a blend's; readings give the taught joints throughout."""
    robot = Robot(thermal=CorrectionConfig().tool)
    last = robot.stream()
    for revision, (what, seed, count) in enumerate(events, start=1):
        sent_s = robot.now
        happen(robot, what, seed, revision, robot.change_tool)
        for _ in range(count):
            q = robot.stream()
            assert np.all(np.isfinite(q))
            assert np.abs(q - last).max() <= blend_since(robot, sent_s) + ROUNDING
            sent_s = robot.now
            assert np.allclose(robot.read(q).position, HOME, rtol=0.0, atol=1e-11)
            last = q


@settings(max_examples=25, deadline=None)
@given(EVENTS, st.floats(0.05, 2.0))
def test_a_moving_stream_steps_no_more_than_its_motion_and_the_blend(
    events: list[tuple[str, int, int]], speed: float
) -> None:
    robot = Robot(thermal=CorrectionConfig().tool)
    t, shift = 0.0, robot.stream() - HOME
    for revision, (what, seed, count) in enumerate(events, start=1):
        sent_s = robot.now
        happen(robot, what, seed, revision, robot.change_tool)
        for i in range(count):
            t += DT * (i > 0)  # after a pause it goes on where it was
            q = HOME + 0.3 * np.sin(speed * t)
            now = robot.stream(q) - q
            # By the motion, a correction of some mrad changes by some mrad per rad moved.
            by_motion = 0.3 * speed * DT * 0.15
            assert np.abs(now - shift).max() <= blend_since(robot, sent_s) + by_motion
            shift, sent_s = now, robot.now


@settings(max_examples=25, deadline=None)
@given(EVENTS, st.integers(2, 30), st.floats(0.2, 4.0))
def test_trajectories_start_where_the_last_command_was_and_never_jump(
    events: list[tuple[str, int, int]], m: int, duration: float
) -> None:
    """A resting trajectory: whatever is sent when, the shift along time is continuous."""
    robot = Robot(thermal=CorrectionConfig().tool)
    times = np.linspace(0.0, duration, m)
    points = np.tile(HOME, (m, 1))
    last = np.zeros(6)
    robot.read(HOME)
    for revision, (what, seed, count) in enumerate(events, start=1):
        happen(robot, what, seed, revision, robot.session.offer_tool)
        command = TrajectoryCommand(NAMES, points, times, np.zeros((m, 6)), np.zeros((m, 6)))
        out = robot.session.trajectory(command, robot.now)
        assert np.array_equal(out.time_from_start_s, times)
        assert np.abs(out.position[0] - HOME - last).max() <= NOT_STRAIGHT
        steps = np.abs(np.diff(out.position, axis=0)).max(axis=1)
        assert np.all(steps <= RATE * np.diff(times) + ROUNDING)
        assert out.velocity is not None
        assert np.all(out.velocity[[0, -1]] == 0.0)
        assert np.abs(out.velocity).max() <= RATE + 1e-9
        # the next one comes somewhere under way; between points the shift is not quite straight
        robot.now += duration * count / 60.0
        here = np.array(
            [np.interp(duration * count / 60.0, times, column) for column in out.position.T]
        )
        assert np.allclose(robot.read(here).position, HOME, rtol=0.0, atol=NOT_STRAIGHT)
        last = here - HOME
