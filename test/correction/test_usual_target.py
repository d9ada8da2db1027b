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
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError
from robocal_ros.correction.streams import TargetStream

PERIODS = [1.0, 1.0, 1.0, 1.1, 0.9, 0.4, 2.1, 6.0, 30.0, 300.0]
EVENTS = [*12 * ["target"], "jump", "part", "late", "nan", "marked", "model", "tool", "enable"]
EVENTS += ["disable", "path", "stop", "hold", "tail", "acknowledge"]
STEPS = st.lists(st.tuples(st.sampled_from(PERIODS), st.sampled_from(EVENTS)), max_size=80)


class Twin:
    """Two equal robots; all targets of the second one are put out the long way."""

    def __init__(self) -> None:
        wide = CorrectionConfig().tool
        self.robots = Robot(thermal=wide), Robot(thermal=wide)
        self.robots[1].session.stream.follow = _takes_none  # type: ignore[method-assign]

    def does(self, act: Callable[[Robot], object]) -> None:
        """The same of both comes to the same, to the last bit, and leaves them the same."""
        usual, long_way = (_came(robot, act) for robot in self.robots)
        assert usual == long_way


def _takes_none(command: JointCommand, now_s: float) -> None:
    return None


def _came(robot: Robot, act: Callable[[Robot], object]) -> tuple[str, ...]:
    with np.printoptions(floatmode="unique"):
        try:
            told = repr(act(robot))
        except RefusedError as refusal:
            told = str(refusal)
        session, now = robot.session, robot.now
        memory = session.output.limiter.memory[: limiter.VELOCITY]
        left = session.status(now), session.offset(now), memory, session.stream.has_tail
        return told, *map(repr, left)


def _passes(robot: Robot, seconds: float) -> None:
    robot.now += seconds
    robot.read(robot.at)


def _sends(robot: Robot, target: JointCommand) -> object:
    out = robot.session.target(target, robot.now)
    robot.go(out)
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
        "stop": lambda robot: robot.session.stop(robot.now, 0.1),
        "hold": lambda robot: robot.session.hold(Reason.LEASED, "a lease", robot.now),
        "tail": lambda robot: robot.session.stream.tail(robot.now),
        "acknowledge": lambda robot: robot.session.acknowledge(robot.now),
    }
    target = JointCommand(NAMES, q, speed if rates else None)
    if event == "nan":
        target = replace(target, velocity=np.full(6, np.nan))
    elif event == "part":
        target = JointCommand(NAMES[:3], q[:3])
    elif event == "marked":
        target = replace(target, mark="base_link")
    late_s = 0.5 if event == "late" else 0.0

    def send(robot: Robot) -> object:
        stamp_ns = round((robot.now - late_s) * 1e9) if rates else 0
        return _sends(robot, replace(target, stamp_ns=stamp_ns))

    return acts.get(event, send)


@settings(max_examples=60)
@given(STEPS, st.booleans(), st.integers(0, 2**16))
def test_a_usual_target_comes_to_what_the_long_way_comes_to(
    steps: list[tuple[float, str]], rates: bool, seed: int
) -> None:
    rng, twin = np.random.default_rng(seed), Twin()
    q, speed = HOME.copy(), np.zeros(6)
    for event in ("model", "enable"):
        twin.does(_act(event, q, speed, rates))
    for periods, event in steps:
        speed = 0.8 * speed + rng.normal(0.0, 0.1, 6)
        q = q + speed * min(periods * DT, 0.1)
        if event == "jump":
            q = q + rng.normal(0.0, 0.05, 6)
        twin.does(lambda robot, seconds=periods * DT: _passes(robot, seconds))
        twin.does(_act(event, q, speed, rates))
        twin.does(lambda robot: robot.session.release(Reason.LEASED))


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
