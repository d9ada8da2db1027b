# SPDX-License-Identifier: Apache-2.0
"""What may go wrong in the simulated cell: in its beams' input, on the way to its controller, in
its joint readings.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import COUNT_RAD, BeamStation, RoundTool, bent
from robocal_ros.cell_sim.robot import Draws, Stream
from robocal_ros.cell_sim.trajectory_controller import (
    GoalCode,
    GoalState,
    JointMotion,
    Trajectory,
    TrajectoryGoal,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.tool.edges import BeamEdge

Fault = Literal[
    "none",
    "collision",
    "wrong_tool",
    "sensor_knocked",
    "sphere_knocked",
    "beam_dirty",
    "beam_x_dead",
    "beam_y_dead",
    "beams_dead",
    "chatter",
    "lost_edge",
    "double_edge",
    "swapped_cables",
    "wrong_station",
    "input_latency",
    "lost_messages",
    "joints_silent",
    "frozen_clock",
    "clock_jump",
    "sensor_clock_jump",
    "frozen_encoder",
    "swapped_temperatures",
    "moved_by_hand",
    "station_knocked",
    "station_knocked_shift",
    "station_knocked_turn",
    "fixture_moved",
]
ControllerFault = Literal[
    "commands_lost",
    "commands_lossy",
    "commands_late",
    "commands_rejected",
    "protective_stop",
    "speed_scaling",
    "odd_lengths",
    "clock_reset",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)
CONTROLLER_FAULTS: tuple[ControllerFault, ...] = get_args(ControllerFault)
"""Of the way to the controller, of its speed and of what it reports; none of what is measured."""
AnyFault = Fault | ControllerFault

SIZES: Mapping[AnyFault, tuple[float, float, str]] = {
    "collision": (2.0, 1e-3, "mm"),
    "wrong_tool": (10.0, 1e-3, "mm"),
    "sensor_knocked": (1.0, 1e-3, "mm"),
    "sphere_knocked": (1.0, 1e-3, "mm"),
    "beam_dirty": (0.4, 1.0, ""),
    "input_latency": (20.0, 1e-3, "ms"),
    "lost_messages": (0.2, 1.0, ""),
    "clock_jump": (1.0, 1.0, "s"),
    "sensor_clock_jump": (1.0, 1.0, "s"),
    "frozen_encoder": (3.0, 1.0, ""),
    "moved_by_hand": (1.0, 1e-3, "mm"),
    "commands_lost": (1.0, 1.0, ""),
    "commands_lossy": (0.01, 1.0, ""),
    "commands_late": (200.0, 1e-3, "ms"),
    "protective_stop": (10.0, 1.0, "s"),
    "speed_scaling": (50.0, 1e-2, "%"),
    "odd_lengths": (1.0, 1.0, ""),
    "station_knocked": (2.0, 1e-3, "mm"),
    "station_knocked_shift": (2.0, 1e-3, "mm"),
    "station_knocked_turn": (0.5, float(np.radians(1.0)), "deg"),
    "fixture_moved": (0.5, 1e-3, "mm"),
}
"""Faults that have a size: the usual one, the factor of its unit, and this unit."""

NEXT_MOTION: frozenset[AnyFault] = frozenset(
    {
        "beam_x_dead",
        "beam_y_dead",
        "beams_dead",
        "chatter",
        "lost_edge",
        "double_edge",
        "wrong_station",
        "joints_silent",
        "frozen_clock",
        "moved_by_hand",
    }
)
"""Faults that begin with the robot's next motion; the others begin at once."""

LASTING: frozenset[AnyFault] = frozenset(
    {
        "collision",
        "wrong_tool",
        "sensor_knocked",
        "sphere_knocked",
        "station_knocked",
        "station_knocked_shift",
        "station_knocked_turn",
        "fixture_moved",
    }
)
"""What was moved or mounted stays so while other faults come and go."""

FAR = np.array([0.0, 0.0, -1e3])  # m
BENT = np.array([0.6, -0.7, 0.38])  # of a collision, flange axes; about unit length
LEVER_M = 0.15  # between the bend and the tip
THICKER = 0.1  # of a wrong tool: growth of its radius over that of its length
KNOCK = np.array([0.8, 0.3, -0.5])  # of the sensor, its own axes
TURN = np.array([0.6, -0.8, 0.0])
TURN_RAD_PER_M = 1.0
BALL_KNOCK = np.array([0.6, 0.0, -0.8])  # flange axes
HAND = np.array([0.7, -0.7, 0.0])  # base
STATION_TURN_RAD_PER_M = float(np.radians(500.0))  # of a knock that also turns: 0.5 deg for 1 mm
STATION_KNOCKED, FIXTURE_MOVED = 31, 37  # name the draw of a knock's directions
FIXTURE_TURN_RAD_PER_M = float(np.radians(100.0))  # a plate of 0.4 m that is loose at one end
CHATTER = 7  # edges that one edge becomes
CHATTER_S = 3e-4
AGAIN_S = 5e-3  # a double edge comes so much later


def size_of(fault: AnyFault, size: float = 0.0) -> float:
    """A fault's size in SI from one in its own unit; 0: the usual one."""
    usual, unit, _ = SIZES.get(fault, (0.0, 1.0, ""))
    return (size or usual) * unit


@dataclass
class Faults:
    """What is wrong now.

    ``sizes``: size, in SI, of each fault in force.
    ``seed``: of the cell; the directions in which its station is knocked follow from it.
    """

    sizes: dict[AnyFault, float] = field(default_factory=dict)
    seed: int = 0

    def __contains__(self, fault: AnyFault) -> bool:
        return fault in self.sizes

    def size(self, fault: AnyFault) -> float:
        """Size of a fault, 0 where it is not in force."""
        return self.sizes.get(fault, 0.0)

    def tool(self, mounted: RoundTool) -> RoundTool:
        """The tool as it is after a collision, or another one in its place."""
        if "wrong_tool" in self:
            longer = self.size("wrong_tool")
            T = mounted.T_flange_tool @ frames.transform(np.eye(3), [0.0, 0.0, longer])
            wider, height = THICKER * max(longer, 0.0), mounted.height + longer
            height[0] = mounted.height[0] + wider
            mounted = replace(
                mounted, T_flange_tool=T, height=height, radius=mounted.radius + wider
            )
        if "collision" in self:
            shift = self.size("collision") * BENT
            tilt = np.array([-shift[1], shift[0], 0.0]) / LEVER_M
            mounted = mounted.mounted(bent(mounted.T_flange_tool, shift, tilt))
        return mounted

    @property
    def T_sensor_knock(self) -> Array:
        """Takes points (4, 4) in the sensor's frame to where the knocked sensor sees them."""
        size = self.size("sensor_knocked")
        return frames.transform(frames.exp_rotation(size * TURN_RAD_PER_M * TURN), size * KNOCK)

    @property
    def hand(self) -> Array:
        """How far (3,) a hand moves the flange, base, m."""
        return self.size("moved_by_hand") * HAND

    def T_station_knock(self, crossing: Array) -> Array:
        """Takes points (4, 4) of the station, base, to where they are after a knock.

        The station turns about ``crossing`` (3,) and shifts. Both directions are drawn once for a
        cell, one evenly in space each.
        """
        both = self.size("station_knocked")
        shift_m = both + self.size("station_knocked_shift")
        turn_rad = both * STATION_TURN_RAD_PER_M + self.size("station_knocked_turn")
        return self._knock(STATION_KNOCKED, crossing, shift_m, turn_rad)

    def T_fixture_move(self, middle: Array) -> Array:
        """Takes points (4, 4) of the fixture, base, to where they are now.

        It turns about its ``middle`` (3,) and shifts, both ways as of `T_station_knock`.
        """
        size = self.size("fixture_moved")
        return self._knock(FIXTURE_MOVED, middle, size, size * FIXTURE_TURN_RAD_PER_M)

    def _knock(self, what: int, about: Array, shift_m: float, turn_rad: float) -> Array:
        ways = np.random.default_rng([self.seed, what]).standard_normal((2, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        R = frames.exp_rotation(turn_rad * ways[1])
        return frames.transform(R, about - R @ about + shift_m * ways[0])

    def station(self, clean: BeamStation) -> BeamStation:
        """The station where a knock has put it, with dirt before the x-beam's receiver.

        With dirt that beam goes dark earlier, or for good.
        """
        if any(name.startswith("station_knocked") for name in self.sizes):
            crossing = np.mean([[beam.start, beam.end] for beam in clean.beams], axis=(0, 1))
            T = self.T_station_knock(crossing)
            x, y = (
                replace(beam, start=(T @ [*beam.start, 1.0])[:3], end=(T @ [*beam.end, 1.0])[:3])
                for beam in clean.beams
            )
            clean = replace(clean, beams=(x, y))
        left = 1.0 - self.size("beam_dirty")
        if left == 1.0:
            return clean
        x, y = clean.beams
        if max(x.dark_at, x.light_at) >= left:  # dark for good: no tool ever meets it
            return replace(clean, beams=(replace(x, start=x.start + FAR, end=x.end + FAR), y))
        x = replace(x, dark_at=x.dark_at / left, light_at=x.light_at / left)
        return replace(clean, beams=(x, y))


class FaultyInput:
    """An input with a fault, step by step.

    ``lost_edge`` and ``double_edge`` befall the second edge of a step's y-beam.
    """

    def __init__(self, faults: Faults) -> None:
        self._faults, self._seen = faults, 0

    def begin(self) -> None:
        """A step begins."""
        self._seen = 0

    def passed(self, edges: Sequence[BeamEdge]) -> list[BeamEdge]:
        """What comes through of edges, in order of time."""
        faults, out = self._faults, []
        for given in edges:
            edge, is_y = given, given.beam == "y"
            if "beams_dead" in faults or f"beam_{edge.beam}_dead" in faults.sizes:
                continue
            self._seen += is_y
            second = is_y and self._seen == 2
            if second and "lost_edge" in faults:
                continue
            edge = replace(edge, time_s=edge.time_s + faults.size("input_latency"))
            if "swapped_cables" in faults:
                edge = replace(edge, beam="x" if is_y else "y")
            out.append(edge)
            if "chatter" in faults:  # a burst that does not settle within any debounce time
                times = edge.time_s + np.linspace(0.0, CHATTER_S, CHATTER)
                out[-1:] = [
                    replace(edge, blocked=edge.blocked ^ bool(i % 2), time_s=t)
                    for i, t in enumerate(times.tolist())
                ]
            elif second and "double_edge" in faults:
                out.append(replace(edge, time_s=edge.time_s + AGAIN_S))
        return out


class CommandGate:
    """Passes trajectories and goals on to a motion, as the faults let them.

    ``begun`` is called when one has been taken.

    ``scale``: speed scaling that was asked for; 1 without.
    """

    def __init__(
        self, motion: JointMotion, faults: Faults, draws: Draws, begun: Callable[[], None]
    ) -> None:
        self._motion, self._faults, self._draws, self._begun = motion, faults, draws, begun
        self.scale = 1.0
        self._late: list[tuple[float, Trajectory | TrajectoryGoal]] = []
        self._messages = 0
        self.fault_began(0.0)

    def fault_began(self, now_s: float) -> None:
        """Another fault is in force from now on, or none."""
        self._lost, self._since_s = 0, now_s

    def require_taken(self, trajectory: Trajectory, now_s: float) -> None:
        """Raise where a trajectory is rejected.

        Raises `InputError`, with the controller's reason, or with that of a fault.
        """
        if "commands_rejected" in self._faults:
            raise InputError("rejected: simulated fault commands_rejected")
        self._motion.controller.require_valid(trajectory, now_s)

    def take(self, given: Trajectory | TrajectoryGoal, now_s: float) -> None:
        """Pass one on, lose it, or let it wait.

        Raises `InputError` when it is rejected; what runs goes on.
        """
        goal = None if isinstance(given, Trajectory) else given
        self.require_taken(given if isinstance(given, Trajectory) else given.trajectory, now_s)
        if self._loses(goal is None, now_s):
            if goal is not None:
                self._motion.controller.accept(goal, now_s, lost=True)
        elif "commands_late" in self._faults:
            self._late.append((now_s + self._faults.size("commands_late"), given))
        else:
            self._motion.take(now_s, given)
            self._begun()

    def drop_late(self) -> None:
        """Drop what waits: a controller that is inactive takes nothing."""
        for _, given in self._late:
            _drop(given, "the controller is inactive")
        self._late.clear()

    def pass_time(self, now_s: float, to_s: float) -> float:
        """Pass on what has waited until now, set the speed; up to when nothing changes."""
        for due_s, given in [waiting for waiting in self._late if waiting[0] <= now_s]:
            self._late.remove((due_s, given))
            try:
                self._motion.take(now_s, given)
                self._begun()
            except InputError as error:  # ended in the past by now
                _drop(given, str(error))
        scale, stop_s = self.scale, self._faults.size("protective_stop")
        if "speed_scaling" in self._faults:
            scale *= self._faults.size("speed_scaling")
        if now_s < self._since_s + stop_s:
            scale, to_s = 0.0, min(to_s, self._since_s + stop_s)
        self._motion.controller.scale = scale
        return min([to_s, *(due_s for due_s, _ in self._late)])

    def _loses(self, of_topic: bool, now_s: float) -> bool:
        """Whether one is lost: on the topic by chance, else where it replaces a motion."""
        faults = self._faults
        if "commands_lossy" in faults and of_topic:
            self._messages += 1
            rng = self._draws.of(Stream.LOST_COMMANDS, self._messages)
            return bool(rng.random() < faults.size("commands_lossy"))
        if self._lost < faults.size("commands_lost") and now_s < self._motion.end_s:
            self._lost += 1
            return True
        return False


def _drop(given: Trajectory | TrajectoryGoal, why: str) -> None:
    """It never takes effect; who sent a goal is told so."""
    if isinstance(given, TrajectoryGoal):
        given.end(GoalState.ABORTED, GoalCode.INVALID_GOAL, why)


PAGE = 128  # readings whose random numbers belong together
KEPT_PAGES = 4


class JointReadings:
    """Reads encoders at ``k / rate_hz``; ``noise_rad``: of a reading, 0 makes it exact."""

    def __init__(
        self, rate_hz: float, noise_rad: float, faults: Faults, draws: Draws, n: int
    ) -> None:
        self._rate, self._noise, self._n = rate_hz, noise_rad, n
        self._faults, self._draws = faults, draws
        self._next, self._stamp_s = 0, 0.0
        self._stuck: tuple[int, float] | None = None  # an encoder, and what it shows
        self._page = lru_cache(KEPT_PAGES)(self._page_of)

    def due(self, now_s: float) -> NDArray[np.int64]:
        """Numbers of the readings since the last call."""
        first = self._next
        self._next = int(np.floor(now_s * self._rate * (1.0 + 1e-12))) + 1
        return np.arange(first, self._next)

    def read(self, number: NDArray[np.int64], motion: JointMotion) -> tuple[Array, Array, Array]:
        """Stamps (k,), joints and velocities (k, n) of what is told of these readings."""
        time, faults = number / self._rate, self._faults
        q, qd = motion.at(time)
        if self._noise > 0.0:
            noise = self._paged(Stream.READINGS, number, self._n)
            q = np.round((q + self._noise * noise) / COUNT_RAD) * COUNT_RAD
        joint = min(int(faults.size("frozen_encoder")), self._n) - 1
        if joint < 0:
            self._stuck = None
        elif len(q):  # one encoder shows what it showed when the fault began
            if self._stuck is None or self._stuck[0] != joint:
                self._stuck = joint, float(q[0, joint])
            q[:, joint], qd[:, joint] = self._stuck[1], 0.0
        if "lost_messages" in faults:
            chance = self._paged(Stream.LOST_READINGS, number, 1, uniform=True)[:, 0]
            kept = np.asarray(chance >= faults.size("lost_messages"))
        else:
            kept = np.full(len(number), "joints_silent" not in faults)
        if "frozen_clock" in faults:
            stamps = np.full(len(time), self._stamp_s)
        else:
            if len(time):
                self._stamp_s = float(time[-1])
            stamps = time + faults.size("clock_jump")
        return stamps[kept], q[kept], qd[kept]

    def _paged(
        self, stream: Stream, number: NDArray[np.int64], width: int, uniform: bool = False
    ) -> Array:
        """Random numbers (k, width) that belong to these readings."""
        pages = number // PAGE
        if len(pages) and pages[0] == pages[-1]:
            return self._page(stream, int(pages[0]), width, uniform)[number % PAGE]
        rows = np.empty((len(number), width))
        for page in np.unique(pages).tolist():
            drawn = self._page(stream, page, width, uniform)
            rows[pages == page] = drawn[number[pages == page] % PAGE]
        return rows

    def _page_of(self, stream: Stream, page: int, width: int, uniform: bool) -> Array:
        rng, shape = self._draws.of(stream, page), (PAGE, width)
        return rng.random(shape) if uniform else rng.standard_normal(shape)
