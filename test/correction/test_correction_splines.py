"""What a controller makes of corrected points keeps the limits of the offset between them too."""

import numpy as np
import pytest
from correction_robot import (
    DT,
    FASTEST,
    HOME,
    LARGEST_A,
    LIMITS,
    NAMES,
    REST,
    REST_A,
    Robot,
    bent_tool,
    drifted,
    large,
    offer,
    swing,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from robocal_ros.correction.interface import Reason, RefusedError, TrajectoryCommand

TOLERANCE = 1e-6  # relative; of the seventeen places of each piece that are looked at
Motion = tuple[np.ndarray, np.ndarray]


class Driven:
    """Cubics through positions and velocities, quintics where there are accelerations.

    It comes in by a cubic from where and as fast as the controller is.
    """

    def __init__(self, command: TrajectoryCommand, begin: Motion) -> None:
        t, fields = command.time_from_start_s, [command.position, command.velocity]
        if command.acceleration is not None:
            fields.append(command.acceleration)
        rows = np.stack(fields, axis=1)
        self.end_s, self.last = t[-1], command.position[-1]
        self.pieces = []
        if t[0] > 0.0:
            ends = [np.array(begin), rows[0, :2]]
            self.pieces.append(BPoly.from_derivatives([0.0, t[0]], ends))
        if len(t) > 1:
            self.pieces.append(BPoly.from_derivatives(t, rows))

    def at(self, t: float) -> Motion:
        for piece in self.pieces:
            if t <= piece.x[-1]:
                return piece(t), piece(t, nu=1)
        return self.last, np.zeros(6)

    def peaks(self, taught: "Driven") -> tuple[float, float]:
        """Fastest rate and acceleration of the offset from the taught motion."""
        rate = bend = 0.0
        for mine, own in zip(self.pieces, taught.pieces, strict=True):
            h = np.diff(mine.x)
            t = (mine.x[:-1, None] + h[:, None] * np.linspace(1e-7, 1 - 1e-7, 17)).ravel()
            rate = max(rate, np.abs(mine(t, nu=1) - own(t, nu=1)).max())
            bend = max(bend, np.abs(mine(t, nu=2) - own(t, nu=2)).max())
        return rate, bend


def quintic(begin: Motion, end: np.ndarray, lasts: float, m: int, *, bends: bool) -> np.ndarray:
    """From where and as fast as it is to rest: times, positions, velocities, accelerations."""
    zero = np.zeros(6)
    curve = BPoly.from_derivatives([0.0, lasts], [[*begin, zero], [end, zero, zero]])
    t = np.linspace(0.0, lasts, m)
    return TrajectoryCommand(NAMES, curve(t), t, curve(t, nu=1), curve(t, nu=2) if bends else None)


def shifted(command: TrajectoryCommand, first_s: float) -> TrajectoryCommand:
    times = command.time_from_start_s + first_s
    fields = command.position, times, command.velocity, command.acceleration
    return TrajectoryCommand(NAMES, *fields)


def check(robot: Robot, command: TrajectoryCommand, begins: tuple[Motion, Motion], rest: bool):
    out = robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    own, mine = (Driven(c, b) for c, b in zip((command, out), begins, strict=True))
    rate, bend = mine.peaks(own)
    assert rate <= (REST if rest else FASTEST) * (1.0 + TOLERANCE)
    assert bend <= (REST_A if rest else LARGEST_A) * (1.0 + TOLERANCE)
    return own, mine


LEG = st.tuples(
    st.sampled_from(["on", "off", "model", "tool", "nothing"]),
    st.integers(0, 50),
    st.sampled_from([0.004, 0.01, 0.02, 0.05, 0.2, 1.0]),  # s between points
    st.sampled_from([0.0, 0.05, 0.3]),  # s to the first
    st.booleans(),  # accelerations
    st.booleans(),  # stands
    st.floats(0.1, 1.4),  # so much of it is driven until the next
)


COARSE = [("tool", 50, 1.0, 0.3, True, False, 0.6), ("on", 20, 1.0, 0.3, True, False, 0.35)]


@settings(max_examples=25, deadline=None)
@example([*COARSE, ("off", 30, 0.2, 0.05, True, False, 0.5)])
@example([*COARSE[::-1], ("model", 30, 0.01, 0.05, False, False, 0.5)])
@given(st.lists(LEG, min_size=1, max_size=6))
def test_between_the_points_too(legs: list) -> None:
    """One after the other, from rest and in place of one that is under way."""
    robot = large()
    stood = quintic((HOME, 0.0 * HOME), HOME, 0.1, 2, bends=False)
    own = mine = Driven(stood, (HOME, 0.0 * HOME))
    began_s = robot.now - 1.0
    for revision, (what, seed, spacing, first_s, bends, stands, part) in enumerate(legs, start=10):
        if what in ("on", "off"):
            robot.session.enable(what == "on")
        elif what == "model":
            robot.session.offer_model(offer(drifted(0.04 * seed, seed), revision))
        elif what == "tool":
            robot.session.offer_tool(bent_tool(6e-5 * seed, 0.01 * seed))
        moving = robot.now - began_s < own.end_s
        first_s = max(first_s, 0.05) if moving else first_s
        begins = own.at(robot.now - began_s), mine.at(robot.now - began_s)
        begin = own.at(robot.now - began_s + first_s)
        rest = stands and not moving
        end = begin[0] if rest else HOME + np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
        way_s = np.max(np.abs(end - begin[0]) / LIMITS["velocity_limits"]) * 3.2
        lasts = 2.0 + way_s + 4.0 * np.max(np.abs(begin[1]) / LIMITS["acceleration_limits"])
        m = max(int(lasts / spacing), 1) + 1
        command = shifted(quintic(begin, end, lasts, m, bends=bends), first_s)
        try:
            own, mine = check(robot, command, begins, rest and first_s == 0.0)
            began_s = robot.now
        except RefusedError as error:
            fine = (Reason.VELOCITY_LIMIT, Reason.TCP_BOUND)
            if error.reason not in (fine if spacing < 0.05 else (*fine, Reason.TOO_SHORT)):
                raise
        drive_s = part * own.end_s + (0.5 if part > 1.0 else 0.0)
        for now in np.arange(robot.now, robot.now + drive_s, 0.01):
            robot.now = float(now)
            robot.at = mine.at(robot.now - began_s)[0]
            robot.read(robot.at)


@pytest.mark.parametrize("spacing", [0.01, 0.02, 0.05, 0.1, 0.25, 0.5])
def test_at_rest_between_the_points_too(spacing: float) -> None:
    for bends in (None, np.zeros((round(4.0 / spacing) + 1, 6))):
        robot, t = large(), np.linspace(0.0, 4.0, round(4.0 / spacing) + 1)
        rows = np.tile(HOME, (len(t), 1))
        command = TrajectoryCommand(NAMES, rows, t, np.zeros_like(rows), bends)
        check(robot, command, ((HOME, 0.0 * HOME),) * 2, rest=True)


@pytest.mark.parametrize("m", [11, 21, 51, 101, 201, 2001])
@pytest.mark.parametrize("bends", [False, True])
def test_a_tool_that_comes_in_on_a_swing(m: int, bends: bool) -> None:
    command = swing(m)
    if not bends:
        command = TrajectoryCommand(
            NAMES, command.position, command.time_from_start_s, command.velocity
        )
    check(large(), command, ((HOME, 0.0 * HOME),) * 2, rest=False)


@pytest.mark.parametrize("spacing", [0.004, 0.01, 0.05])
@pytest.mark.parametrize("streamed", [10, 30, 60])
def test_from_a_stream_that_moves(spacing: float, streamed: int) -> None:
    """Its offset still comes in: the trajectory goes on with its rate."""
    robot, speed, q = large(), np.radians(30.0) * np.array([1, -0.5, 0.5, -1, 1, 1]), HOME.copy()
    robot.stream(q)
    before = q, robot.at
    for i in range(streamed):
        before = q, robot.at
        q = q + speed * min((i + 1) / 50, 1.0) * DT
        robot.stream(q)
    v = (q - before[0]) / DT
    rate = (robot.at - before[1]) / DT - v
    command = quintic((q, v), q + 0.3 * speed, 2.0, round(2.0 / spacing) + 1, bends=False)
    own, mine = check(robot, command, ((q, v), (robot.at, v + rate)), rest=False)
    assert np.allclose(mine.at(0.0)[0], robot.at, rtol=0.0, atol=1e-9)
    step = mine.at(0.0)[1] - own.at(0.0)[1] - rate
    assert np.all(np.abs(step) <= LARGEST_A * DT + 1e-9)
