"""Settled streams take a shorter way: bit for bit what the session does, whatever comes between."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from correction_robot import HOME, NAMES, NOMINAL, bent_tool, drifted, offer
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robocal_ros.correction import plain
from robocal_ros.correction.bounds import CorrectionConfig, Policy
from robocal_ros.correction.incoming import MOST_STAMPS
from robocal_ros.correction.inputs import TrajectoryCommand
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.staged import load_kernels
from robocal_ros.correction.wire import JointWire

DT = 0.002
OTHERS = (*NAMES[:3], "gripper", *NAMES[:2:-1])  # the arm's joints in another order, and one more
STOP = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))


def serialized(
    names: Sequence[str], fields: Sequence[Any], stamp_ns: int = 0, mark: str = "", pad: int = 0
) -> bytes:
    """A sensor_msgs/JointState as OMG CDR; ``pad`` fills what no reader looks at."""
    out = bytearray(struct.pack("<iI", *divmod(stamp_ns, 10**9)))

    def align(size: int) -> None:
        out.extend([pad] * (-len(out) % size))

    def number(value: int) -> None:
        align(4)
        out.extend(struct.pack("<I", value))

    def text(value: str) -> None:
        data = value.encode() + b"\0"
        number(len(data))
        out.extend(data)

    text(mark)
    number(len(names))
    for name in names:
        text(name)
    for field in fields:
        number(len(field))
        if len(field):
            align(8)
            out.extend(struct.pack(f"<{len(field)}d", *field))
    return b"\0\1\0\0" + bytes(out)


class Desk:
    """A session with serialized messages, as a node has it; with the shorter way or without."""

    def __init__(self, config: CorrectionConfig, *, short: bool) -> None:
        self.session = CorrectionSession(NOMINAL, NOMINAL, "s1", config)
        self.wires = JointWire(), JointWire()
        self.targets = self.session.plain_targets(self.wires[0]) if short else None
        self.readings = self.session.plain_readings(self.wires[1]) if short else None
        self.plain = {"target": 0, "reading": 0}

    def target(self, data: bytes, now_s: float) -> bytes | str:
        if self.targets is not None and (out := self.targets.take(data, now_s)) is not None:
            self.plain["target"] += 1
            return out
        command = self.wires[0].read(data)
        if command is None:
            return "irregular"
        try:
            done = self.session.target(command, now_s)
        except RefusedError as error:
            return str(error)
        return data if done is command else self.wires[0].written(data, done)

    def reading(self, data: bytes, now_s: float, now_ns: int) -> bytes | str:
        taken = self.readings
        if taken is not None and (out := taken.take(data, now_s, now_ns)) is not None:
            self.plain["reading"] += 1
            return out
        state = self.wires[1].read(data)
        if state is None:
            return "irregular"
        age = (now_ns - state.stamp_ns) * 1e-9 if state.stamp_ns else 0.0
        try:
            done = self.session.reading(state, now_s, age)
        except RefusedError as error:
            return str(error)
        return self.wires[1].written(data, done)


def positions(data: bytes, names: Sequence[str]) -> np.ndarray:
    command = JointWire().read(data)
    assert command is not None
    return command.position[[command.names.index(name) for name in names]]


class Both:
    """The same messages through two desks, which must not differ in anything."""

    def __init__(self, **config: Any) -> None:
        made = CorrectionConfig(**config)
        self.short, self.long = Desk(made, short=True), Desk(made, short=False)
        self.now, self.stamp = 100.0, 5_000_000_000_000_000_000 // 3
        self.q, self.at = HOME.copy(), HOME.copy()  # taught, and where the robot is
        self.sent: bytes | str = ""
        self.revision = 0

    def do(self, act: Any) -> Any:
        answers = []
        for desk in (self.short, self.long):
            try:
                answers.append(act(desk))
            except RefusedError as error:
                answers.append(str(error))
        assert answers[0] == answers[1]
        self.same()
        return answers[0]

    def same(self) -> None:
        a, b = self.short.session, self.long.session
        assert a.status() == b.status()
        one, other = a.offset(self.now), b.offset(self.now)
        assert one.offset.tobytes() == other.offset.tobytes()
        assert (one.revision, one.s) == (other.revision, other.s)
        assert a._block.tobytes() == b._block.tobytes()
        assert a._starts.under_way(self.now) == b._starts.under_way(self.now)
        known = [{key: int(v[0]) for key, v in s._guard._stamps.items() if v[0]} for s in (a, b)]
        assert known[0] == known[1]

    def target(self, data: bytes) -> bytes | str:
        answer = self.do(lambda desk: desk.target(data, self.now))
        if isinstance(answer, bytes):
            self.sent = answer
        return answer

    def read(self, names: Sequence[str] = NAMES, rates: bool = False, **fields: Any) -> bytes | str:
        values = dict(zip(NAMES, self.at, strict=True)) | {"gripper": 0.7}
        row = [values[name] for name in names]
        speeds = [0.1 * x for x in row] if rates else []
        data = serialized(names, [row, speeds, []], fields.pop("stamp_ns", self.stamp), **fields)
        now_ns = self.stamp + 1_500_000
        return self.do(lambda desk: desk.reading(data, self.now, now_ns))

    def stream(self, count: int, way: Any = 0.0, rates: bool = False, dt: float = DT) -> None:
        """Targets on a way (rad/s), and readings of a robot that follows them."""
        for _ in range(count):
            self.now += dt
            self.stamp += round(dt * 1e9)
            self.read(rates=rates)
            self.q = self.q + np.asarray(way) * dt
            speed = np.broadcast_to(way, 6) if rates else []
            answer = self.target(serialized(NAMES, [self.q, speed, []], self.stamp))
            if isinstance(answer, bytes):
                self.at = positions(answer, NAMES)

    def settle(self) -> None:
        for _ in range(5000):
            self.stream(1)
            if self.short.session.status().settled:
                return
        pytest.fail("the blend does not end")

    def model(self, size: float, seed: int = 0) -> None:
        self.revision += 1
        made = offer(drifted(size, seed), self.revision)
        self.do(lambda desk: desk.session.offer_model(made))

    def tool(self, shift_m: float) -> None:
        made = bent_tool(shift_m)
        self.do(lambda desk: desk.session.offer_tool(made))

    def enable(self, on: bool) -> None:
        self.do(lambda desk: desk.session.enable(on))


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("tool", [False, True])
@pytest.mark.parametrize("policy", Policy)
def test_all_of_a_settled_stream_goes_the_shorter_way(
    policy: Policy, tool: bool, rates: bool
) -> None:
    both = Both(policy=policy, velocity_limits=np.full(6, 2.0))
    both.model(3.0)
    if tool:
        both.tool(1e-3)
    both.enable(True)
    both.settle()
    both.stream(3, rates=rates)
    before = dict(both.short.plain)
    both.stream(100, way=0.2, rates=rates)
    for kind, count in before.items():
        assert both.short.plain[kind] - count == 100
    assert np.abs(both.at - both.q).max() > 1e-5


@pytest.mark.parametrize("pad", [0, 85])
def test_a_stream_without_correction_goes_the_shorter_way(pad: int) -> None:
    both = Both()
    both.stream(5)
    before = both.short.plain["target"]
    both.now += DT
    data = serialized(NAMES, [both.q, [], []], mark="", pad=pad)
    assert both.target(data) == data
    # the padding between names counts, as it does for a layout; that before numbers does not
    assert both.short.plain["target"] - before == (pad == 0)


def test_other_joints_and_another_order() -> None:
    both = Both()
    both.model(3.0)
    both.enable(True)
    both.settle()
    for _ in range(5):
        both.now += DT
        answer = both.read(OTHERS, rates=True)
        assert isinstance(answer, bytes)
        assert positions(answer, ["gripper"])[0] == 0.7
        assert np.allclose(positions(answer, NAMES), both.q, rtol=0.0, atol=1e-12)
        both.read(("gripper",))  # of another publisher: it takes the place of no layout
    assert both.short.plain["reading"] >= 4


def test_with_a_free_axis_positions_alone_go_the_shorter_way() -> None:
    """Rates are found by differences there."""
    both = Both(free_axis=True)
    both.model(3.0)
    both.enable(True)
    both.settle()
    before = both.short.plain["target"]
    both.stream(20, way=0.2)
    assert both.short.plain["target"] - before == 20
    both.stream(20, way=0.2, rates=True)
    assert both.short.plain["target"] - before == 20


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("echo", Reason.OWN_OUTPUT),
        ("gap", Reason.START_MISMATCH),
        ("stamp", Reason.TIME_BACKWARDS),
        ("clock", Reason.TIME_BACKWARDS),
        ("degrees", Reason.DEGREES),
        ("limit", Reason.JOINT_LIMIT),
        ("speed", Reason.VELOCITY_LIMIT),
    ],
)
def test_what_is_not_plain_is_refused_as_ever(what: str, reason: Reason) -> None:
    both = Both(velocity_limits=np.full(6, 2.0) if what == "speed" else None)
    both.model(3.0)
    both.enable(True)
    both.settle()
    before = both.short.plain["target"]
    both.stream(5)
    assert both.short.plain["target"] - before == 5
    both.now += DT
    q, stamp = HOME.copy(), both.stamp
    if what == "echo":
        q = both.at
    elif what == "gap":
        both.now += 0.3
        both.read()
        q += 0.1
    elif what == "stamp":
        stamp -= 1_000_000
    elif what == "clock":
        both.now -= 1.0
    else:
        q[1] += {"degrees": 30.0, "limit": NOMINAL.upper[1] + 1e-6 - q[1], "speed": 0.1}[what]
    assert isinstance(both.target(serialized(NAMES, [q, [], []], stamp)), str)
    assert both.short.session.status().refused == {reason: 1}


def test_one_kernel_is_compiled_for_all_of_it() -> None:
    """A second one would be compiled in the middle of a stream."""
    load_kernels(NOMINAL)
    both = Both()
    both.stream(5)
    both.stream(5, rates=True)
    assert len(plain.pass_plainly.signatures) == 1


class Hostile(Both):
    """What may come, beside settled streams."""

    def drive(self, kind: str, rng: np.random.Generator, count: int) -> None:
        getattr(self, f"on_{kind}")(rng, count)

    def on_stream(self, rng: np.random.Generator, count: int) -> None:
        way = rng.uniform(-1.0, 1.0, 6) * rng.choice([0.0, 0.1, 2.5])
        rates, dt = bool(rng.random() < 0.5), float(rng.choice([0.0, 0.001, 0.002, 0.02]))
        self.stream(count, way, rates, dt * rng.uniform(0.7, 1.3))

    def on_settle(self, rng: np.random.Generator, count: int) -> None:
        """What waits comes in, if the robot may go on at all."""
        for _ in range(150):
            self.stream(1, dt=0.02)
        self.stream(count, rates=bool(rng.random() < 0.5))

    def on_model(self, rng: np.random.Generator, count: int) -> None:
        self.model(float(rng.choice([0.0, 1.0, 3.0, 9.0])), count)

    def on_tool(self, rng: np.random.Generator, count: int) -> None:
        self.tool(float(rng.choice([0.0, 1e-3, 5e-3])))

    def on_enable(self, rng: np.random.Generator, count: int) -> None:
        self.enable(bool(rng.random() < 0.7))

    def on_rest(self, rng: np.random.Generator, count: int) -> None:
        for _ in range(12):
            self.now += 0.05
            self.stamp += 50_000_000
            self.read()
        self.do(lambda desk: desk.session.look(self.now, 0))

    def on_gap(self, rng: np.random.Generator, count: int) -> None:
        self.now += float(rng.choice([0.05, 0.099, 0.101, 0.3, 2.0, 50.0]))

    def on_jump(self, rng: np.random.Generator, count: int) -> None:
        self.q = self.q + rng.uniform(-1.0, 1.0, 6) * float(rng.choice([1e-4, 1e-2, 1.0]))

    def on_trajectory(self, rng: np.random.Generator, count: int) -> None:
        times = np.linspace(0.0, float(rng.choice([0.05, 1.0])), 5)
        path = TrajectoryCommand(NAMES, self.q + 0.01 * np.linspace(0.0, 1.0, 5)[:, None], times)
        start = float(rng.choice([0.0, 0.1, -0.1]))

        def act(desk: Desk) -> bytes:
            return desk.session.trajectory(path, self.now, start).position.tobytes()

        self.do(act)
        for _ in range(count):
            self.now += float(rng.choice([0.0005, 0.05]))
            self.read()

    def on_stop(self, rng: np.random.Generator, count: int) -> None:
        self.do(lambda desk: desk.session.trajectory(STOP, self.now - rng.choice([0.0, 200.0])))

    def on_echo(self, rng: np.random.Generator, count: int) -> None:
        """What went out comes back, as it was, rounded or reversed, marked or not."""
        if not isinstance(self.sent, bytes):
            return
        command = JointWire().read(self.sent)
        assert command is not None
        names, back = command.names, command.position  # of a part of the joints, it may be
        ways = [back, back.astype(np.float32)]
        echoes = [serialized(names, [way, [], []], self.stamp) for way in ways]
        echoes.append(serialized(names[::-1], [back[::-1], [], []], self.stamp))
        for echo in (*echoes, self.sent):
            self.now += DT
            self.target(echo)
            self.stream(2)

    def on_wrong(self, rng: np.random.Generator, count: int) -> None:
        """A message that is odd in one way."""
        self.now += DT * float(rng.choice([0.0, 1.0]))
        q = self.q.copy()
        fields: list[Any] = [q, [0.1] * 6 if rng.random() < 0.5 else [], []]
        names, stamp, mark, pad = NAMES, self.stamp, "", 0
        what = count % 12
        if what < 3:
            q[count % 6] = [np.nan, np.inf, 30.0][what]
        elif what < 5:
            fields[2] = [[np.nan] * 6, [1.0] * 3][what - 3]
        elif what == 5:
            names, fields = NAMES[:4], [q[:4], [], []]
        elif what == 6:
            names = NAMES[::-1]
        elif what < 9:
            stamp -= [1_000_000, 3_000_000_000][what - 7]
        elif what == 9:
            stamp = 0
        else:
            mark, pad = [("corrected", 0), ("world", 7)][what - 10]
        data = serialized(names, fields, stamp, mark, pad)
        now = self.now - float(rng.choice([0.0, 0.0, 1.0]))
        self.target(data)
        self.do(lambda desk: desk.target(data, now))
        self.do(lambda desk: desk.reading(data, now, stamp))

    def on_other_readings(self, rng: np.random.Generator, count: int) -> None:
        for names in (OTHERS, ("gripper",), NAMES[:3], NAMES):
            self.now += DT
            self.read(names, rates=bool(rng.random() < 0.5), stamp_ns=int(rng.choice([0, 1])))


KINDS = [name.removeprefix("on_") for name in dir(Hostile) if name.startswith("on_")]
EVENTS = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(1, 30)),
    min_size=1,
    max_size=14,
)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(Policy), st.booleans(), st.booleans(), EVENTS)
@example(Policy.REFUSE, True, True, [("wrong", 1, 29), ("echo", 0, 1)])  # four joints come back
def test_whatever_comes_both_ways_do_the_same(
    policy: Policy, limited: bool, begun: bool, events: list[tuple[str, int, int]]
) -> None:
    limits = np.full(6, 1.0) if limited else None
    both = Hostile(policy=policy, velocity_limits=limits)
    if begun:
        both.model(3.0)
        both.enable(True)
        both.on_settle(np.random.default_rng(0), 3)
    for kind, seed, count in events:
        both.drive(kind, np.random.default_rng(seed), count)
        both.on_stream(np.random.default_rng(seed + 1), 3)


def old(both: Both, names: Sequence[str], q: np.ndarray) -> bytes:
    """A target 10 ms older than the last one."""
    both.now += DT
    return serialized(tuple(names), [q, [], []], both.stamp - 10_000_000)


def running() -> Both:
    """A corrected stream that has settled."""
    both = Both()
    both.model(3.0)
    both.enable(True)
    both.settle()
    both.stream(5)
    return both


def test_many_drivers_do_not_wear_out_the_order_of_targets() -> None:
    both = running()
    for i in range(200):
        both.now += 1e-5
        other = serialized((f"x{i}",), [np.array([0.1]), [], []], both.stamp)
        both.do(lambda desk, data=other: desk.reading(data, both.now, both.stamp))
    answer = both.target(old(both, NAMES, both.q))
    assert "time goes backwards" in str(answer)
    stamps = both.short.session._guard._stamps
    assert len(stamps) <= MOST_STAMPS + 2  # one more for each kind: what is shared


def test_an_old_target_is_refused_in_any_order_of_its_joints() -> None:
    both = running()
    answer = both.target(old(both, NAMES[::-1], both.q[::-1]))
    assert "time goes backwards" in str(answer)


def test_unstamped_readings_leave_nothing_behind() -> None:
    both = running()
    for i in range(3 * MOST_STAMPS):
        both.now += 1e-5
        data = serialized((*NAMES, f"x{i}"), [np.append(both.q, 0.1), [], []], 0)
        both.do(lambda desk, data=data: desk.reading(data, both.now, both.stamp))
    assert len(both.short.session._guard._stamps) <= MOST_STAMPS + 2
