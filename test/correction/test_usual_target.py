# SPDX-License-Identifier: Apache-2.0
"""The usual target of a stream goes out before it is noted: nothing else comes of it by that."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from correction_robot import DT, HOME, NAMES, Robot, bent_tool, drifted, offer, swing
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.correction import limiter
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.streams import StreamPhase, TargetStream

PERIODS = [1.0, 1.0, 1.0, 1.1, 0.9, 0.4, 2.1, 6.0, 30.0, 300.0]
EVENTS = [*4 * ["target"], "jump", "part", "late", "nan", "marked", "model", "tool", "enable"]
EVENTS += ["disable", "path", "rejected", "stop", "hold", "tail", "acknowledge", "fast"]
EVENTS += ["no place", "early"]
# An even stream of so many targets, and after so many periods something else.
PARTS = st.lists(
    st.tuples(st.integers(0, 30), st.sampled_from(PERIODS), st.sampled_from(EVENTS)), max_size=12
)


class Twin:
    """Two equal robots; all targets of the second one are put out the long way."""

    def __init__(self) -> None:
        wide = CorrectionConfig().tool
        self.robots = Robot(thermal=wide), Robot(thermal=wide)
        self.robots[1].session.stream.follow = _takes_none  # type: ignore[method-assign]

    def does(self, act: Callable[[Robot], object], after_s: float = 0.0) -> None:
        """The same of both comes to the same, to the last bit."""
        usual, long_way = (_came(robot, act, after_s) for robot in self.robots)
        assert usual == long_way

    def is_one(self) -> None:
        """What both tell of themselves is the same."""
        with np.printoptions(floatmode="unique"):
            usual, long_way = (
                [repr(robot.session.status(robot.now)), repr(robot.session.offset(robot.now))]
                for robot in self.robots
            )
        assert usual == long_way


def _takes_none(command: JointCommand, now_s: float) -> None:
    return None


def _came(robot: Robot, act: Callable[[Robot], object], after_s: float) -> tuple[object, ...]:
    robot.now += after_s
    robot.read(robot.at)
    try:
        with np.printoptions(floatmode="unique"):
            told = repr(act(robot))
    except RefusedError as refusal:
        told = str(refusal)
    robot.session.release(Reason.LEASED)
    session, stream = robot.session, robot.session.stream
    memory = session.output.limiter.memory[: limiter.VELOCITY]
    noted = stream.has_tail, repr(stream.period_s), repr(session._stamps)
    return told, memory.tobytes(), *noted


def _sends(robot: Robot, target: JointCommand) -> object:
    out = robot.session.target(target, robot.now)
    robot.go(out)
    return out


def _is_rejected(robot: Robot, path: TrajectoryCommand) -> object:
    out = robot.session.trajectory(path, robot.now, may_be_rejected=True)
    sent = robot.session.output.path
    assert sent is not None
    robot.session.reject(sent)
    return out


def _act(event: str, q: np.ndarray, speed: np.ndarray, rates: bool) -> Callable[[Robot], object]:
    """What happens to a robot that is on its way at ``q``."""
    model, tool = offer(drifted(1.5)), bent_tool()
    path = replace(swing(), position=q + swing().position - swing().position[0])
    acts: dict[str, Callable[[Robot], object]] = {
        "model": lambda robot: robot.session.offer_model(model),
        "tool": lambda robot: robot.session.offer_tool(tool),
        "enable": lambda robot: robot.session.enable(True),
        "disable": lambda robot: robot.session.enable(False),
        "path": lambda robot: robot.session.trajectory(path, robot.now),
        "rejected": lambda robot: _is_rejected(robot, path),
        "stop": lambda robot: robot.session.stop(robot.now, 0.1),
        "hold": lambda robot: robot.session.hold(Reason.LEASED, "a lease", robot.now),
        "tail": lambda robot: robot.session.stream.tail(robot.now),
        "acknowledge": lambda robot: robot.session.acknowledge(robot.now),
    }
    target = JointCommand(NAMES, q, speed if rates else None)
    if event in ("nan", "fast"):
        target = replace(target, velocity=np.full(6, np.nan if event == "nan" else 100.0))
    elif event == "part":
        target = JointCommand(NAMES[:3], q[:3])
    elif event == "marked":
        target = replace(target, mark="base_link")
    elif event == "no place":
        target = replace(target, position=np.full(6, np.nan))
    late_s = {"late": 0.5, "early": -0.5}.get(event, 0.0)

    def send(robot: Robot) -> object:
        stamp_ns = round((robot.now - late_s) * 1e9) if rates else 0
        return _sends(robot, replace(target, stamp_ns=stamp_ns))

    return acts.get(event, send)


@settings(max_examples=60)
@given(PARTS, st.booleans(), st.integers(0, 2**16))
def test_a_usual_target_comes_to_what_the_long_way_comes_to(
    parts: list[tuple[int, float, str]], rates: bool, seed: int
) -> None:
    rng, twin = np.random.default_rng(seed), Twin()
    q, speed = HOME.copy(), np.zeros(6)
    for event in ("model", "enable"):
        twin.does(_act(event, q, speed, rates))
    for count, periods, what in parts:
        steps = [(rng.uniform(0.7, 1.3), "target") for _ in range(count)]
        for share, event in [*steps, (periods, what)]:
            speed = 0.9 * speed + rng.normal(0.0, 0.05, 6)
            q = q + speed * min(share * DT, 0.1)
            if event == "jump":
                q = q + rng.normal(0.0, 0.05, 6)
            twin.does(_act(event, q, speed, rates), share * DT)
        twin.is_one()
        if twin.robots[0].session.stream.phase is not StreamPhase.RUNNING:  # it begins anew
            for _ in range(30):
                twin.does(_act("tail", q, speed, rates), 0.02)
            twin.does(_act("acknowledge", q, speed, rates))
            q, speed = twin.robots[0].at.copy(), np.zeros(6)


def test_of_an_even_stream_all_targets_but_the_first_two_are_usual(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    follow, followed = TargetStream.follow, []

    def counts(stream: TargetStream, command: JointCommand, now_s: float) -> JointCommand | None:
        out = follow(stream, command, now_s)
        followed.append(out is not None)
        return out

    monkeypatch.setattr(TargetStream, "follow", counts)
    robot = Robot()
    robot.session.offer_model(offer(drifted(1.0)))
    robot.session.enable(True)
    for k in range(500):
        robot.stream(HOME + 1e-4 * k, velocity=np.full(6, 1e-4 / DT))
    assert followed[2:] == 498 * [True]
