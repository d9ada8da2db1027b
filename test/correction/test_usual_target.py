# SPDX-License-Identifier: Apache-2.0
"""The usual target of a stream goes from bytes to bytes: nothing else comes of it by that."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from correction_robot import DT, HOME, NAMES, Robot, bent_tool, drifted, offer, swing
from hypothesis import given, settings
from hypothesis import strategies as st
from long_form import amount
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from robocal_ros.correction import limiter
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.messages import JointMessage, JointWire, doubles
from robocal_ros.correction.streams import StreamPhase
from robocal_ros.ros.conversions import header

PERIODS = [1.0, 1.0, 1.0, 1.1, 0.9, 0.4, 2.1, 6.0, 30.0, 300.0]
EVENTS = [*4 * ["target"], "jump", "part", "late", "nan", "marked", "model", "tool", "enable"]
EVENTS += ["disable", "path", "rejected", "stop", "hold", "tail", "acknowledge", "fast"]
EVENTS += ["no place", "early", "efforts"]
MARKS = ["", "cell", "base_link", "the_planner"]  # numbers are aligned after each otherwise
# An even stream of so many targets, and after so many periods something else.
PARTS = st.lists(
    st.tuples(st.integers(0, 30), st.sampled_from(PERIODS), st.sampled_from(EVENTS)), max_size=12
)


class Line:
    """A robot whose targets come and go serialized, as they do through the node."""

    def __init__(self, *, usual: bool, **config: Any) -> None:
        self.robot = Robot(**config)
        self.session, self.wire, self.usual = self.robot.session, JointWire(), usual
        self.followed: list[bool] = []

    def sends(self, came: bytes) -> JointState:
        """What goes out for a target."""
        session, now = self.session, self.robot.now
        out = session.serialized_target(came, now) if self.usual else None
        session.settle()
        self.followed.append(out is not None)
        if out is None:
            message = JointMessage(self.wire, came)
            try:
                command = message.command()
            except RefusedError as error:
                session.stream.end(error, now)
                raise
            corrected = session.target(command, now)
            same = corrected is command
            out = bytes(message.unchanged() if same else message.changed(corrected))
            if session.stream.is_usual:
                session.stream.like = message.target() or session.stream.like
        went = deserialize_message(out, JointState)
        self.robot.go(JointCommand(tuple(went.name), np.array(went.position)))
        return went


class Twin:
    """Two equal lines; all targets of the second one are put out the long way."""

    def __init__(self) -> None:
        wide = CorrectionConfig().tool
        self.lines = Line(usual=True, thermal=wide), Line(usual=False, thermal=wide)

    def does(self, act: Callable[[Line], object], after_s: float = 0.0) -> None:
        """The same of both comes to the same, to the last bit."""
        usual, long_way = (_came(line, act, after_s) for line in self.lines)
        assert usual == long_way

    def is_one(self) -> None:
        """What both tell of themselves is the same."""
        with np.printoptions(floatmode="unique"):
            usual, long_way = (
                [
                    repr(line.session.status(line.robot.now)),
                    repr(line.session.offset(line.robot.now)),
                ]
                for line in self.lines
            )
        assert usual == long_way


def _came(line: Line, act: Callable[[Line], object], after_s: float) -> tuple[object, ...]:
    robot, session = line.robot, line.session
    robot.now += after_s
    robot.read(robot.at)
    try:
        with np.printoptions(floatmode="unique"):
            told = repr(act(line))
    except RefusedError as refusal:
        told = str(refusal)
    session.release(Reason.LEASED)
    stream, memory = session.stream, session.output.limiter.memory[: limiter.VELOCITY]
    noted = stream.has_tail, repr(stream.period_s), repr(session._stamps)
    return told, memory.tobytes(), *noted


def _is_rejected(robot: Robot, path: TrajectoryCommand) -> object:
    out = robot.session.trajectory(path, robot.now, may_be_rejected=True)
    sent = robot.session.output.path
    assert sent is not None
    robot.session.reject(sent)
    return out


def _message(target: JointCommand, stamp_ns: int = 0, *, efforts: bool = False) -> bytes:
    message = JointState(header=header(stamp_ns, target.mark), name=list(target.names))
    message.effort = doubles(target.position) if efforts else message.effort
    message.position = doubles(target.position)
    if target.velocity is not None:
        message.velocity = doubles(target.velocity)
    return bytes(serialize_message(message))


def _act(
    event: str, q: np.ndarray, speed: np.ndarray, rates: bool, mark: str
) -> Callable[[Line], object]:
    """What happens to a robot that is on its way at ``q``."""
    model, tool = offer(drifted(1.5)), bent_tool()
    path = replace(swing(), position=q + swing().position - swing().position[0])
    acts: dict[str, Callable[[Line], object]] = {
        "model": lambda line: line.session.offer_model(model),
        "tool": lambda line: line.session.offer_tool(tool),
        "enable": lambda line: line.session.enable(True),
        "disable": lambda line: line.session.enable(False),
        "path": lambda line: line.session.trajectory(path, line.robot.now),
        "rejected": lambda line: _is_rejected(line.robot, path),
        "stop": lambda line: line.session.stop(line.robot.now, 0.1),
        "hold": lambda line: line.session.hold(Reason.LEASED, "a lease", line.robot.now),
        "tail": lambda line: line.session.stream.tail(line.robot.now),
        "acknowledge": lambda line: line.session.acknowledge(line.robot.now),
    }
    target = JointCommand(NAMES, q, speed if rates else None, mark=mark)
    if event in ("nan", "fast"):
        target = replace(target, velocity=np.full(6, np.nan if event == "nan" else 100.0))
    elif event == "part":
        target = JointCommand(NAMES[:3], q[:3])
    elif event == "marked":
        target = replace(target, mark="another")
    elif event == "no place":
        target = replace(target, position=np.full(6, np.nan))
    late_s = {"late": 0.5, "early": -0.5}.get(event, 0.0)

    def send(line: Line) -> object:
        stamp_ns = round((line.robot.now - late_s) * 1e9) if rates else 0
        return line.sends(_message(target, stamp_ns, efforts=event == "efforts"))

    return acts.get(event, send)


@settings(max_examples=amount(20, 60))
@given(PARTS, st.booleans(), st.sampled_from(MARKS), st.integers(0, 2**16))
def test_a_usual_target_comes_to_what_the_long_way_comes_to(
    parts: list[tuple[int, float, str]], rates: bool, mark: str, seed: int
) -> None:
    rng, twin = np.random.default_rng(seed), Twin()
    q, speed = HOME.copy(), np.zeros(6)
    for event in ("model", "enable"):
        twin.does(_act(event, q, speed, rates, mark))
    for count, periods, what in parts:
        steps = [(rng.uniform(0.7, 1.3), "target") for _ in range(count)]
        for share, event in [*steps, (periods, what)]:
            speed = 0.9 * speed + rng.normal(0.0, 0.05, 6)
            q = q + speed * min(share * DT, 0.1)
            if event == "jump":
                q = q + rng.normal(0.0, 0.05, 6)
            twin.does(_act(event, q, speed, rates, mark), share * DT)
        twin.is_one()
        if twin.lines[0].session.stream.phase is not StreamPhase.RUNNING:  # it begins anew
            for _ in range(30):
                twin.does(_act("tail", q, speed, rates, mark), 0.02)
            twin.does(_act("acknowledge", q, speed, rates, mark))
            q, speed = twin.lines[0].robot.at.copy(), np.zeros(6)


def _corrected() -> Line:
    line = Line(usual=True)
    line.session.offer_model(offer(drifted(1.0)))
    line.session.enable(True)
    return line


def _follows(fill: Callable[[bytes, int], bytes]) -> list[bool]:
    """Which of an even stream's targets are usual, each filled up by its number."""
    line = _corrected()
    for k in range(200):
        line.robot.now += DT
        line.robot.read(line.robot.at)
        came = _message(JointCommand(NAMES, HOME + 1e-4 * k, np.full(6, 1e-4 / DT)))
        line.sends(fill(came, k))
    return line.followed


def test_two_targets_after_its_source_s_clock_was_set_ahead_they_are_usual_again() -> None:
    line = _corrected()
    for k in range(200):
        line.robot.now += DT
        line.robot.read(line.robot.at)
        stamp_ns = round((1.0 + k * DT + 0.05 * (k >= 100)) * 1e9)
        line.sends(_message(JointCommand(NAMES, HOME + 1e-4 * k), stamp_ns))
    assert line.followed[2:] == [*98 * [True], False, False, *98 * [True]]


def _filled(came: bytes, number: int) -> bytes:
    fill = 3 * bytes([number])
    filled, count = re.subn(
        rb"(joint_a\d\0)...", lambda name: name[1] + fill, came, flags=re.DOTALL
    )
    assert count == len(NAMES)
    return filled


def test_of_an_even_stream_all_targets_but_the_first_two_are_usual() -> None:
    assert _follows(lambda came, number: came)[2:] == 198 * [True]


def test_what_fills_up_after_a_name_may_be_anything() -> None:
    assert _follows(_filled)[2:] == 198 * [True]
