"""Which circles and plunges measure a tool: each follows from what is known by then."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.tool.crossed_model import BeamStep, StepKind
from robocal_ros.tool.crossed_run import FEWEST_EDGES
from robocal_ros.tool.edges import BEAMS, Beam, BeamEdge, debounced
from robocal_ros.tool.flange_path import upright_pose
from robocal_ros.tool.laser_frame import LaserFrame

Array = NDArray[np.float64]
Mode = Literal["full", "quick"]

STEPS: Mapping[Mode, tuple[str, ...]] = {
    "full": ("low", "high", "upright", "plunge_1", "plunge_2"),
    "quick": ("circle", "plunge"),
}
START_RAD = float(np.pi / 4.0)  # in mid-quadrant: no circle begins on a beam


@dataclass(frozen=True)
class MeasuringMotion:
    """Sizes and speeds of the steps, m and m/s.

    Attributes
    ----------
    radius_m, speed_m_s : of the circles.
    height_m : between the circles; the longer, the better the axis.
    above_tip_m : where the lower circles meet the tool.
    plunge_depth_m, plunge_speed_m_s : of the plunges, half of the depth below the beams.
    """

    radius_m: float = 0.012
    speed_m_s: float = 0.05
    height_m: float = 0.05
    above_tip_m: float = 5e-3
    plunge_depth_m: float = 7e-3
    plunge_speed_m_s: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} = {value}: must be positive")

    @property
    def period_s(self) -> float:
        """Of a turn."""
        return 2.0 * np.pi * self.radius_m / self.speed_m_s


@dataclass(frozen=True, eq=False)
class PlannedStep:
    """A circle or a plunge to be driven; the flange's orientation is held.

    Attributes
    ----------
    number, of : place in the run, from 1.
    T_base_flange : (4, 4) at the circle's centre, or where the plunge begins and ends.
    R_base_laser : (3, 3) the circle lies in its x-y plane; the plunge goes along -z and back.
    radius_m, speed_m_s : of a circle; ``direction`` +1 counter-clockwise about the laser's z.
    depth_m : of a plunge; its speed is ``speed_m_s``.
    """

    name: str
    kind: StepKind
    number: int
    of: int
    T_base_flange: Array
    R_base_laser: Array
    speed_m_s: float
    radius_m: float = 0.0
    direction: int = 1
    start_rad: float = START_RAD
    depth_m: float = 0.0


@dataclass(frozen=True, eq=False)
class MeasuringPlan:
    """The steps of a run.

    Attributes
    ----------
    T_flange_tool : (4, 4) the taught tool (full) or the stored one (quick).
    spin_rad : turn of the flange about the laser's z: with 0 its x lies along the laser's x.
    """

    mode: Mode
    laser: LaserFrame
    T_flange_tool: Array
    motion: MeasuringMotion = field(default_factory=MeasuringMotion)
    spin_rad: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps in turn."""
        return STEPS[self.mode]

    def step(self, number: int, seen: Array | None = None) -> PlannedStep:
        """Step ``number`` (from 1).

        ``seen`` (4, 4): the tool in the flange frame as the steps so far show it; needed by what
        `needs_tool` names.

        Raises
        ------
        InputError
            When it is missing.
        """
        name = self.names[number - 1]
        if self.needs_tool(number) and seen is None:
            raise InputError(f"step {name} follows from the steps before it: measure them first")
        tool = self.T_flange_tool if seen is None or not self.needs_tool(number) else seen
        plunge = name.startswith("plunge")
        T = self._pose(
            tool, -0.5 * self.motion.plunge_depth_m if plunge else self.motion.above_tip_m
        )
        if name == "high":
            # Straight below the first circle: the tool is not set upright yet.
            T[:3, 3] -= self.motion.height_m * self.laser.T_base_laser[:3, 2]
        return PlannedStep(
            name=name,
            kind="plunge" if plunge else "circle",
            number=number,
            of=len(self.names),
            T_base_flange=T,
            R_base_laser=self.laser.T_base_laser[:3, :3],
            speed_m_s=self.motion.plunge_speed_m_s if plunge else self.motion.speed_m_s,
            radius_m=0.0 if plunge else self.motion.radius_m,
            direction=1 if number % 2 else -1,
            depth_m=self.motion.plunge_depth_m if plunge else 0.0,
        )

    def needs_tool(self, number: int) -> bool:
        """Whether a step follows from what the ones before it show."""
        return self.mode == "full" and self.names[number - 1] not in ("low", "high")

    def _pose(self, T_flange_tool: Array, above_tip_m: float) -> Array:
        """Flange pose with the tool upright and a point of its axis on the crossing."""
        spin = frames.exp_rotation([0.0, 0.0, self.spin_rad])
        down = self.laser.T_base_laser[:3, :3] @ spin @ np.diag([1.0, -1.0, -1.0])
        point = T_flange_tool[:3, 3] - above_tip_m * T_flange_tool[:3, 2]
        near = frames.transform(down, np.zeros(3))
        return upright_pose(self.laser, near, T_flange_tool[:3, 2], point)


# ---- circles and plunges of a recorded run, told apart by the names of their edges' steps -------


CIRCLES = ("low", "high", "upright")  # as a measuring plan calls them
STEP_NAMES = f"circles are called {', '.join(CIRCLES)} or circle…, plunges plunge…"


def step_kind(name: str) -> StepKind | None:
    """What a step's name says it is; None where it says nothing."""
    if name in CIRCLES or name.startswith("circle"):
        return "circle"
    return "plunge" if name.startswith("plunge") else None


def named_steps(
    edges: Sequence[BeamEdge], names: Sequence[str], debounce_s: float
) -> list[BeamStep]:
    """Steps in order of time, their edges debounced; ``names`` says the step of each edge.

    Raises
    ------
    InputError
        When a name says neither circle nor plunge, or comes again after another step.
    BeamError
        When a beam chatters.
    """
    inside: dict[str, list[BeamEdge]] = {}
    before = None
    for edge, name in sorted(zip(edges, names, strict=True), key=lambda pair: pair[0].time_s):
        if name in inside and name != before:
            raise InputError(
                f"step '{name}' comes again at {edge.time_s:.4f} s, after step '{before}': give "
                "each motion a name of its own"
            )
        inside.setdefault(name, []).append(edge)
        before = name
    steps = []
    for name, own in inside.items():
        kind = step_kind(name)
        if kind is None:
            raise InputError(f"step '{name}' is neither: {STEP_NAMES}")
        steps.append(BeamStep(name, kind, debounced(own, debounce_s)))
    return steps


# ---- when a circle or a plunge is over, from the edges and from where the flange is -------------


REST_S = 0.1
REST_M = 2e-4  # the flange rests: it moved less in REST_S
GIVEN_UP_S = 1.0  # rest after which an incomplete step is over: a program may pause in a plunge
LEFT_M = 2e-3  # out of the circle's plane, or off the plunge's line
AFTER_EDGE_S = 1e-3  # a reading so late after the last edge brackets it, whatever its latency


@dataclass(eq=False)
class StepWatch:
    """Watches one step; times in s of any one origin, positions (3,) of the flange, base, m.

    A robot program says nothing: a step is over when its edges are complete and the flange rests
    or leaves, or when edges are missing and it has left or rested for long. The last step of a
    run is over with its last edge.

    Attributes
    ----------
    up : (3,) the laser's z, base.
    first_edge_s : time of the first edge; None before.
    """

    kind: StepKind
    last: bool
    up: Array
    first_edge_s: float | None = None
    _edges: Counter[Beam] = field(default_factory=Counter)
    _newest_edge_s: float = -np.inf
    _start: Array | None = None
    _recent: deque[tuple[float, Array]] = field(default_factory=deque)
    _rest_since_s: float | None = None

    def edge(self, beam: Beam, time_s: float) -> None:
        """Take an edge."""
        self._edges[beam] += 1
        self.first_edge_s = time_s if self.first_edge_s is None else self.first_edge_s
        self._newest_edge_s = max(self._newest_edge_s, time_s)

    @property
    def edges(self) -> int:
        """How many edges there were."""
        return self._edges.total()

    def over(self, time_s: float, flange: Array) -> bool:
        """Take a reading of the flange; whether the step is over now."""
        rests_s = self._rests_s(time_s, flange)
        if not self.edges or time_s < self._newest_edge_s + AFTER_EDGE_S:
            return False
        if self._start is None:
            self._start = flange
        complete = all(self._edges[beam] >= FEWEST_EDGES[self.kind] for beam in BEAMS)
        even = all(self._edges[beam] % 2 == 0 for beam in BEAMS)
        if complete and even and (self.last or rests_s > 0.0):
            return True
        return rests_s >= GIVEN_UP_S or self._left(flange)

    def _left(self, flange: Array) -> bool:
        if self._start is None:
            return False
        away = flange - self._start
        height = float(away @ self.up)
        if self.kind == "circle":
            return abs(height) > LEFT_M
        return float(np.linalg.norm(away - height * self.up)) > LEFT_M

    def _rests_s(self, time_s: float, flange: Array) -> float:
        """How long the flange has rested by now."""
        self._recent.append((time_s, flange))
        while len(self._recent) > 1 and self._recent[1][0] <= time_s - REST_S:
            self._recent.popleft()
        first_s, first = self._recent[0]
        still = first_s <= time_s - REST_S and float(np.linalg.norm(flange - first)) < REST_M
        if not still:
            self._rest_since_s = None
            return 0.0
        if self._rest_since_s is None:
            self._rest_since_s = first_s
        return time_s - self._rest_since_s
