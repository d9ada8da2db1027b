"""Whatever comes, in whatever order: no NaN, no bound exceeded, no step, exact un-correction."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from correction_robot import (
    HOME,
    NAMES,
    NOMINAL,
    RATE,
    Robot,
    bent_tool,
    drifted,
    offer,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.refusals import RefusedError

TIGHT = ShiftBounds(0.3e-3, np.radians(0.1), np.radians(0.3))
FASTEST = 1.0  # rad/s, where there is a limit
AT_LIMIT = HOME.copy()
AT_LIMIT[1] = NOMINAL.upper[1] - 1e-3
NEAR = CorrectionConfig().start_rad
LONGEST_STEP_S = CorrectionConfig().longest_step_s
# Per rad of motion a correction of some mrad changes by some mrad; where it fades towards a limit
# by a third of a rad in that joint, and by as much in the others.
BY_MOTION = 0.5
EXACT = 1e-9
STOP = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))


@dataclass
class Cell:
    """A robot that goes where it is sent, and all that may happen to it."""

    policy: Policy
    limited: bool
    middle: np.ndarray
    robot: Robot = field(init=False)
    tool: bool = False
    goes_on: bool = False
    revision: int = 0

    def __post_init__(self) -> None:
        limits = np.full(6, FASTEST) if self.limited else None
        self.robot = Robot(
            policy=self.policy, thermal=TIGHT, velocity_limits=limits, model_age_s=60.0
        )
        self.session = self.robot.session
        self.robot.at = self.q = self.middle
        self.sent_s = self.robot.now

    # ---- what may happen ------------------------------------------------------------------------

    def stream(self, rng: np.random.Generator, count: int) -> None:
        robot = self.robot
        way = rng.uniform(-1.0, 1.0, 6) * rng.choice([0.0, 0.1, 1.1 * FASTEST])
        period = rng.choice([0.002, 0.01, 0.05])
        for _ in range(count):
            dt = period * rng.uniform(0.7, 1.3)
            if np.max(np.abs(self.q - self.middle)) > 0.2:
                way = 0.5 * (self.middle - self.q)
            robot.now += dt
            self.read()
            if not self.target(self.q + way * dt, way if rng.random() < 0.5 else None):
                return

    def target(self, q: np.ndarray, velocity: np.ndarray | None) -> bool:
        """One message; True when it went out."""
        robot, shift = self.robot, self.robot.at - self.q
        try:
            out = self.session.target(JointCommand(NAMES, q, velocity), robot.now)
        except RefusedError:
            return False
        elapsed = robot.now - self.sent_s
        motion = float(np.max(np.abs(q - self.q)))
        step = np.abs(out.position - q - shift).max()
        allowed = RATE * min(elapsed, LONGEST_STEP_S) + BY_MOTION * motion + EXACT
        # a stream that begins takes the correction that the robot is nearest to, within the start's
        # tolerance
        begins = not self.goes_on and np.abs(out.position - robot.at).max() <= NEAR
        assert step <= allowed or begins
        if self.limited and self.goes_on:
            moved = np.abs(out.position - robot.at).max()
            assert moved <= FASTEST * max(elapsed, LONGEST_STEP_S) + EXACT
        if self.limited and out.velocity is not None:
            assert np.abs(out.velocity).max() <= FASTEST + EXACT
        self.goes_on = True
        self.hold(q[None], out.position[None])
        robot.at, self.q, self.sent_s = out.position, q, robot.now
        self.same(self.read())
        offset = self.session.offset(robot.now).offset
        assert np.allclose(offset, robot.at - q, rtol=0.0, atol=EXACT)
        return True

    def trajectory(self, rng: np.random.Generator, count: int) -> None:
        robot, goal = self.robot, self.middle + rng.uniform(-0.1, 0.1, 6)
        seconds = float(rng.choice([0.5, 2.0, 8.0]))
        t = np.linspace(0.0, seconds, max(count, 3))
        w = np.pi / seconds
        s, ds = 0.5 * (1.0 - np.cos(w * t)), 0.5 * w * np.sin(w * t)
        way, shift = goal - self.q, robot.at - self.q
        path = TrajectoryCommand(NAMES, self.q + s[:, None] * way, t, ds[:, None] * way)
        self.read()
        try:
            out = self.session.trajectory(path, robot.now)
        except RefusedError:
            return
        assert np.array_equal(out.time_from_start_s, t)
        added = out.position - path.position
        # the robot may have stopped by itself: it begins with a correction within the tolerance
        assert np.abs(added[0] - shift).max() <= NEAR
        motion = np.abs(np.diff(path.position, axis=0)).max(axis=1)
        steps = np.abs(np.diff(added, axis=0)).max(axis=1)
        assert np.all(steps <= RATE * np.diff(t) + BY_MOTION * motion + EXACT)
        self.hold(path.position, out.position)
        assert out.velocity is not None
        assert np.all(np.isfinite(out.velocity))
        if self.limited:
            assert np.abs(out.velocity).max() <= FASTEST + EXACT
        self.goes_on = False
        last = int(rng.integers(1, len(t)))
        for i in range(last + 1):
            robot.now += t[i] - (t[i - 1] if i else 0.0)
            robot.at, self.q = out.position[i], path.position[i]
            self.same(self.read())
        self.sent_s = robot.now

    def pause(self, rng: np.random.Generator, count: int) -> None:
        """Nothing is commanded; for a while not even joint states come."""
        self.robot.now += float(rng.choice([0.0, 0.3, 50.0]))
        self.robot.rest(0.05 * count)
        self.goes_on = False

    def stop(self) -> None:
        """By a clock that went back."""
        assert self.session.trajectory(STOP, -1.0) is STOP
        self.goes_on = False

    def model(self, rng: np.random.Generator, count: int) -> None:
        self.revision += 1
        size = float(rng.choice([0.0, 1.0, 3.0, 6.0]))
        try:
            self.session.offer_model(offer(drifted(size, count), self.revision, stamp_ns=10**9))
        except RefusedError:
            return

    def change_tool(self, rng: np.random.Generator, count: int) -> None:
        self.tool = True
        self.session.offer_tool(bent_tool(1e-3 * rng.uniform(0.0, 5.0), rng.uniform(0.0, 1.0)))

    def switch(self, rng: np.random.Generator, count: int) -> None:
        self.session.enable(bool(rng.random() < 0.7))

    def clock(self, rng: np.random.Generator, count: int) -> None:
        """The clock that stamps the models jumps."""
        self.session.look(self.robot.now, int(rng.choice([0, 10**9, 10**12, -(10**15)])))

    def nonsense(self, rng: np.random.Generator, count: int) -> None:
        robot = self.robot
        bad = self.q.copy()
        bad[count % 6] = rng.choice([np.nan, np.inf, 30.0])
        late = JointCommand(NAMES, self.q)
        for command, now in ((JointCommand(NAMES, bad), robot.now), (late, robot.now - 100.0)):
            for act in (self.session.target, self.session.reading):
                with pytest.raises(RefusedError):
                    act(command, now)
        doubled = TrajectoryCommand((NAMES[0],) * 6, self.q[None], np.zeros(1))
        with pytest.raises(RefusedError):
            self.session.trajectory(doubled, robot.now)

    # ---- what holds -----------------------------------------------------------------------------

    def read(self) -> JointCommand:
        return self.robot.read(self.robot.at)

    def same(self, taught: JointCommand) -> None:
        """The robot is where it was sent, so it reads as it was taught."""
        assert np.allclose(taught.position, self.q, rtol=0.0, atol=EXACT)

    def hold(self, taught: np.ndarray, out: np.ndarray) -> None:
        """Limits and bounds of what goes out."""
        assert np.all(np.isfinite(out))
        assert np.all((out >= NOMINAL.lower - EXACT) & (out <= NOMINAL.upper + EXACT))
        config, status = CorrectionConfig(), self.session.status()
        largest = TIGHT.joint_rad + (config.tool.joint_rad if self.tool else 0.0)
        assert np.abs(out - taught).max() <= largest + EXACT
        # On its way out a correction that may not be clamped is not held up by its bounds.
        goes_out = self.policy is Policy.REFUSE and (not status.enabled or status.stale)
        if not (self.tool or goes_out):
            ends = (NOMINAL.fk(q) @ NOMINAL.T_flange_tool for q in (taught, out))
            there, here = (T[:, :3, 3] for T in ends)
            # The drift moves the tool as far as the correction does, up to their second order.
            assert np.linalg.norm(there - here, axis=1).max() <= TIGHT.tcp_m * 1.01


KINDS = ("stream", "trajectory", "pause", "model", "change_tool", "switch", "clock", "nonsense")
EVENTS = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(1, 40)),
    min_size=1,
    max_size=14,
)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(Policy), st.booleans(), st.sampled_from(["home", "limit"]), EVENTS)
def test_whatever_comes(
    policy: Policy, limited: bool, where: str, events: list[tuple[str, int, int]]
) -> None:
    cell = Cell(policy, limited, HOME if where == "home" else AT_LIMIT)
    session = cell.session
    for kind, seed, count in events:  # nothing goes out before the robot is known
        if kind in ("model", "change_tool", "switch"):
            getattr(cell, kind)(np.random.default_rng(seed), count)
        for send in (session.target, session.trajectory):
            still: Any = JointCommand(NAMES, cell.q)
            if send == session.trajectory:
                still = TrajectoryCommand(NAMES, cell.q[None], np.ones(1))
            with pytest.raises(RefusedError):
                send(still, cell.robot.now)
        assert session.trajectory(STOP, cell.robot.now) is STOP
    cell.read()
    for kind, seed, count in events:
        getattr(cell, kind)(np.random.default_rng(seed), count)
        if seed % 2:
            cell.stop()
