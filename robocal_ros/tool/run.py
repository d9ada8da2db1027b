# SPDX-License-Identifier: Apache-2.0
"""Which circles and plunges measure a tool: each follows from what is known by then."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.crossed_model import (
    TURNED_SIGMAS,
    BeamStep,
    Held,
    RobotNoise,
    ToolEstimate,
    estimate_tool,
    run_problem,
)
from robocal_ros.tool.edges import (
    BEAMS,
    PARALLEL,
    Beam,
    BeamError,
    EdgeSample,
    InputRule,
    ParallelStation,
    StepKind,
    StepWatch,
    debounced,
)
from robocal_ros.tool.judging import BendRule, CheckRule, ToolLimits
from robocal_ros.tool.laser_frame import JointPath, LaserFrame, upright_pose

Mode = Literal["full", "quick", "laser"]
STEPS: Mapping[Mode, tuple[str, ...]] = {
    "full": ("low", "high", "upright", "plunge_1", "plunge_2"),
    "quick": ("circle", "plunge"),
    "laser": (
        *(f"circle_{i}" for i in range(1, 5)),
        *(f"plunge_{point}{i}" for i in (1, 2) for point in "abcd"),
    ),
}
# Of a plunge beside the crossing: along which beam, and which way.
BESIDE: Mapping[str, tuple[int, int]] = {"a": (0, -1), "b": (0, 1), "c": (1, -1), "d": (1, 1)}
LITTLE_TURN_RAD = 2e-3  # of the beams; ten times what a robot turns that warms up by 0.5 mm in 3 m
START_RAD = float(np.pi / 4.0)  # in mid-quadrant: no circle begins on a beam


@dataclass(frozen=True)
class MeasuringMotion:
    """Sizes and speeds of the steps, m and m/s.

    ``radius_m``, ``speed_m_s``: of the circles. ``height_m``: between the circles; the longer, the
    better the axis. ``above_tip_m``: where the lower circles meet the tool. ``plunge_depth_m``,
    ``plunge_speed_m_s``: of the plunges, half of the depth below the beams.
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


@dataclass(frozen=True, eq=False)
class PlannedStep:
    """A circle or a plunge to be driven; the flange's orientation is held.

    ``number``, ``of``: place in the run, from 1. ``T_base_flange`` (4, 4): at the circle's centre,
    or where the plunge begins and ends. ``R_base_laser`` (3, 3): the circle lies in its x-y plane;
    the plunge goes along -z and back. ``radius_m``, ``speed_m_s``: of a circle; ``direction`` +1
    counter-clockwise about the laser's z. ``depth_m``: of a plunge; its speed is ``speed_m_s``.
    ``beams``: those that the step breaks.
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
    beams: tuple[Beam, ...] = BEAMS


@dataclass(frozen=True, eq=False)
class MeasuringPlan:
    """The steps of a run.

    ``T_flange_tool`` (4, 4): the taught tool (full), the stored one (quick), the mandrel (laser).
    ``spin_rad``: turn of the flange about the laser's z: with 0 its x lies along the laser's x.
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

        Raises `InputError` when it is missing.
        """
        name = self.names[number - 1]
        if self.needs_tool(number) and seen is None:
            raise InputError(f"step {name} follows from the steps before it: measure them first")
        tool = self.T_flange_tool if seen is None or not self.needs_tool(number) else seen
        plunge = name.startswith("plunge")
        above_tip_m = -0.5 * self.motion.plunge_depth_m if plunge else self.motion.above_tip_m
        # Flange pose with the tool upright and a point of its axis on the crossing.
        spin = frames.exp_rotation([0.0, 0.0, self.spin_rad])
        down = self.laser.T_base_laser[:3, :3] @ spin @ np.diag([1.0, -1.0, -1.0])
        near, point = frames.transform(down, np.zeros(3)), tool[:3, 3] - above_tip_m * tool[:3, 2]
        T = upright_pose(self.laser, near, tool[:3, 2], point)
        if name == "high":
            # Straight below the first circle: the tool is not set upright yet.
            T[:3, 3] -= self.motion.height_m * self.laser.T_base_laser[:3, 2]
        beams: tuple[Beam, ...] = BEAMS
        if self.mode == "laser" and plunge:  # as far from the other beam as a circle ever is
            beam, way = BESIDE[name[-2]]
            T[:3, 3] += way * self.motion.radius_m * self.laser.direction[beam]
            beams = (BEAMS[beam],)
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
            beams=beams,
        )

    def needs_tool(self, number: int) -> bool:
        """Whether a step follows from what the ones before it show."""
        return self.mode == "full" and self.names[number - 1] not in ("low", "high")


# Traits are the radii, the latency and the rate of the joint readings. No bend changes these; what
# differs from the healthy tool's run is a fault.
ONE_SIDED = 1.645  # sigmas: what is at a limit looks larger by so much in 5 % of cases
AS_LOW = "circle"  # of a quick check: as high above the tip as the circle `low` of a whole run
LOW = "low"


class WrongToolError(RobocalError):
    """Another tool than the healthy one that was measured."""

    code = Code.WRONG_TOOL


class ClockError(RobocalError):
    """Edges and joint readings are not stamped on one clock, or the input's delay has changed."""

    code = Code.CLOCK_WRONG


@dataclass(frozen=True)
class TraitLimits:
    """Changes against the healthy tool's run that are no fault yet; 0: any.

    ``radius_m``: of the tool as a beam sees it. ``latency_s``: of the edges behind the joint
    readings. ``lost``: share of the joint readings.
    """

    radius_m: float = 5e-5
    latency_s: float = 5e-3
    lost: float = 0.05


@dataclass(frozen=True)
class RunTraits:
    """Traits of a run.

    ``radius_m``: by circle, of the tool as the x- and the y-beam see it; ``radius_sigma_m`` of
    each. ``latency_s``, ``latency_sigma_s``: of the edges behind the joint readings. ``rate_hz``:
    of the joint readings. ``turn_rad``, ``turn_sigma_rad``: of the beams, as of a `ToolEstimate`;
    older runs have none.
    """

    radius_m: Mapping[str, tuple[float, float]]
    radius_sigma_m: float
    latency_s: float
    latency_sigma_s: float
    rate_hz: float
    turn_rad: float | None = None
    turn_sigma_rad: float = 0.0

    @classmethod
    def of(cls, estimate: ToolEstimate, circles: Sequence[str], rate_hz: float) -> "RunTraits":
        """Of a measured tool; ``circles``: names in the order of its radii."""
        found = estimate.estimate
        own = np.array([name.startswith("radius_") for name in found.names])
        variance = np.diag(found.covariance)[own]
        radii = zip(circles, estimate.radius.tolist(), strict=True)
        return cls(
            {name: (x, y) for name, (x, y) in radii},
            float(np.sqrt(np.max(variance))),
            estimate.latency_s,
            estimate.latency_sigma_s,
            rate_hz,
            estimate.turn_rad,
            estimate.turn_sigma_rad,
        )

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "RunTraits":
        """Read what `document` gave, also after JSON."""
        radius = {name: (x, y) for name, (x, y) in document["radius_m"].items()}
        return cls(**(dict(document) | {"radius_m": radius}))

    def require_readings(self, count: int, span_s: float, limits: TraitLimits) -> None:
        """Refuse ``count`` readings over a time where this run would have had clearly more.

        Raises `TooFewSamplesError` when messages are lost.
        """
        expected = self.rate_hz * span_s
        lost = 1.0 - count / expected if expected > 0.0 else 0.0
        sigma = np.sqrt(max(lost * (1.0 - lost), 0.0) / max(expected, 1.0))
        if beyond(max(lost, 0.0), float(sigma), limits.lost):
            raise TooFewSamplesError(
                f"{lost:.0%} of the joint readings are missing: {count} in {span_s:.1f} s, the "
                f"healthy tool was measured with {self.rate_hz:.0f} in a second; edges are lost "
                "with them: look at network and load, or measure the healthy tool at this rate"
            )

    def require_like(self, healthy: "RunTraits", limits: TraitLimits) -> None:
        """Refuse a run that differs from the healthy tool's in what no bend changes.

        Raises `ClockError` when the edges are later or earlier than they were; `BeamError` when one
        beam alone sees the tool grown or shrunk; `WrongToolError` when both do.
        """
        later = self.latency_s - healthy.latency_s
        sigma = float(np.hypot(self.latency_sigma_s, healthy.latency_sigma_s))
        if beyond(later, sigma, limits.latency_s):
            raise ClockError(
                f"the edges are {1e3 * self.latency_s:.1f} ms behind the joint readings, with the "
                f"healthy tool it were {1e3 * healthy.latency_s:.1f} ms: a clock has jumped, or "
                "the input is delayed; put both on one clock, or measure the healthy tool anew"
            )
        # Growth of the radius in each beam, over the circles that both runs have.
        common = [
            np.subtract(radii, healthy.radius_m[name])
            for name, radii in (
                (LOW if name == AS_LOW else name, radii) for name, radii in self.radius_m.items()
            )
            if name in healthy.radius_m
        ]
        if not common:
            return
        change = np.mean(common, axis=0)
        sigma = float(np.hypot(self.radius_sigma_m, healthy.radius_sigma_m))
        apart, both = float(change[0] - change[1]), float(np.mean(change))
        x, y = (f"{1e3 * part:+.3f}" for part in change)
        words = f"against the healthy tool its radius is {x} mm in beam x and {y} mm in beam y"
        if beyond(apart, np.sqrt(2.0) * sigma, limits.radius_m):
            worse = BEAMS[int(np.argmax(np.abs(change)))]
            raise BeamError(
                f"{words}: a tool changes for both, so beam {worse} is dirty or out of line; clean "
                "and align it, then measure the healthy tool anew"
            )
        if beyond(both, np.sqrt(0.5) * sigma, limits.radius_m):
            raise WrongToolError(
                f"{words}: another tool is mounted, this one is worn or fouled, or both beams are "
                "dirty; mount the right one, or measure it in mode REFERENCE"
            )


def require_even(rates_hz: Sequence[float], limits: TraitLimits) -> None:
    """Refuse a healthy tool's run whose steps (k,) had joint readings at unlike rates.

    Measured under loss it would hide what is lost later. A loss that is alike in all steps does
    not show.

    Raises `TooFewSamplesError` when the slowest and the fastest step differ by more than the limit.
    """
    slowest, fastest = min(rates_hz), max(rates_hz)
    if beyond(1.0 - slowest / fastest, 0.0, limits.lost):
        raise TooFewSamplesError(
            f"joint readings came at {slowest:.0f} to {fastest:.0f} in a second: some were lost, "
            "and a healthy tool measured so would hide later loss; look at network and load, then "
            "measure it again"
        )


def beyond(change: float, sigma: float, limit: float) -> bool:
    """Whether a change is larger than the limit in all but 5 % of cases; not a number is."""
    return limit > 0.0 and not abs(change) - ONE_SIDED * sigma <= limit


Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ToolConfig:
    """Settings of a tool session; plain values, so that a recording carries them.

    ``points_m``: four points (A, B on the x-beam, C, D on the y-beam), base; empty: no such beams.
    ``laser_sigma_m``, ``reach_m``: see `LaserFrame`. ``taught``: rows of T_flange_tool (4, 4) as
    taught. ``station``: frame_id of the beams' edges; empty: any. ``beams``: names of the x- and
    the y-beam in the edges. ``parallel``: two parallel beams, where there are any. ``mandrel``:
    rows of T_flange_mandrel (4, 4), z along its axis to its end; None: there is none.
    ``mandrel_radius_m``: as certified, where it places the beams. ``taper``: growth of the tool's
    radius per length above the tip. ``spin_rad``: turn of the flange about the laser's z while it
    measures. ``step_timeout_s``: a step without any edge for so long ends the run.
    ``joint_error_rad``: rms by which joints turn otherwise than their encoders show, where no model
    in force holds it; 0: nothing is said of it.
    """

    points_m: Rows
    taught: Rows
    mandrel: Rows | None = None
    mandrel_radius_m: float = 0.01
    laser_sigma_m: float = 0.0
    reach_m: tuple[float, float] = (0.0, 0.0)
    station: str = ""
    beams: tuple[str, str] = ("x", "y")
    parallel: ParallelStation | None = None
    taper: float = 0.0
    spin_rad: float = 0.0
    step_timeout_s: float = 30.0
    joint_error_rad: float = 0.0
    motion: MeasuringMotion = field(default_factory=MeasuringMotion)
    input: InputRule = field(default_factory=InputRule)
    noise: RobotNoise = field(default_factory=RobotNoise)
    check: CheckRule = field(default_factory=CheckRule)
    limits: ToolLimits = field(default_factory=ToolLimits)
    traits: TraitLimits = field(default_factory=TraitLimits)

    @property
    def laser(self) -> LaserFrame:
        """The crossed beams. Raises `ConflictError` where there are none."""
        if not self.points_m:
            raise ConflictError("there are no crossed beams: name their laser file ('laser')")
        return LaserFrame(np.array(self.points_m), self.laser_sigma_m, np.array(self.reach_m))

    @property
    def beam_names(self) -> dict[str, Beam]:
        """Which beam has which name in the edges."""
        crossed = dict(zip(self.beams, BEAMS, strict=True)) if self.points_m else {}
        if self.parallel is None:
            return crossed
        return crossed | dict(zip(self.parallel.names, PARALLEL, strict=True))

    @property
    def T_flange_taught(self) -> Array:
        """The taught tool (4, 4)."""
        return np.array(self.taught)

    @property
    def bend(self) -> BendRule:
        """Where the tool may bend: between the mount and the upper circle."""
        nearest_m = self.motion.above_tip_m + self.motion.height_m
        return BendRule(nearest_m, max(nearest_m, self.check.lever_m))

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "ToolConfig":
        """Read what `document` gave, also after JSON.

        Raises `InputError` when it has other settings than this version knows.
        """
        parts: dict[str, Any] = {
            "motion": MeasuringMotion,
            "input": InputRule,
            "noise": RobotNoise,
            "check": CheckRule,
            "limits": ToolLimits,
            "traits": TraitLimits,
        }
        try:
            values: dict[str, Any] = {"traits": {}} | dict(document)  # older ones have none
            rows: dict[str, Any] = {
                key: tuple(map(tuple, values.pop(key))) for key in ("points_m", "taught")
            }
            if values.get("mandrel") is not None:  # older ones have none
                rows["mandrel"] = tuple(map(tuple, values.pop("mandrel")))
            if (known := values.get("parallel")) is not None:
                values["parallel"] = ParallelStation(**(known | {"names": tuple(known["names"])}))
            pairs: dict[str, Any] = {key: tuple(values.pop(key)) for key in ("reach_m", "beams")}
            made: dict[str, Any] = {key: part(**values.pop(key)) for key, part in parts.items()}
            return cls(**rows, **pairs, **made, **values)
        except (KeyError, TypeError) as error:
            raise InputError(f"the recorded configuration cannot be read: {error}") from error


def rows_of(matrix: Array) -> Rows:
    """A matrix as plain rows."""
    return tuple(tuple(float(x) for x in row) for row in matrix)


def made_with(config: ToolConfig) -> dict[str, Any]:
    """What two measurements must share to be compared: taught tool, beams and station."""
    document = {"taught": config.taught, "points_m": config.points_m, "station": config.station}
    return {name: json.loads(json.dumps(value)) for name, value in document.items()}


# m, and of unit vectors: a file in millimetres changes the last digit of what it is given.
SAME = 1e-6


def alike(one: object, other: object) -> bool:
    """Whether two `made_with`, or parts of them, are the same but for rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(alike(one[name], other[name]) for name in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, int | float) and isinstance(other, int | float):
        return abs(one - other) <= SAME
    return one == other


ANOTHER_M, ANOTHER_RAD = 1e-4, float(np.radians(0.1))  # a pendant rounds by less


def taught_apart(taught: Array, other: Array) -> str:
    """By how much one taught tool (4, 4) is from another one, in words; empty: it is the same."""
    away = frames.invert(taught) @ other
    size_m = float(np.linalg.norm(away[:3, 3]))
    angle_rad = float(np.linalg.norm(frames.log_rotation(away[:3, :3])))
    if size_m <= ANOTHER_M and angle_rad <= ANOTHER_RAD:
        return ""
    return f"{1e3 * size_m:.2f} mm and {np.degrees(angle_rad):.2f} deg"


PLANNING = Held(along_m=5e-3)  # before any plunge the tip is taken where it was taught
BEFORE_NS = AFTER_NS = 1_000_000_000  # joint readings kept about the edges of a step


@dataclass(eq=False)
class ToolRun:
    """A run as it grows.

    ``number``: of the run in its session, from 1; ``mode`` as it was asked for. ``arm``,
    ``thermal_revision``: the model in force when it began. ``begun_ns``: origin of its times.
    ``from_ns``: the step that is awaited counts from here. ``healthy``: traits of the healthy
    tool's run, which this one must share; None: none are known.
    """

    number: int
    mode: str
    cycle_id: str
    plan: MeasuringPlan
    config: ToolConfig
    arm: SerialArm
    thermal_revision: int
    begun_ns: int
    from_ns: int
    healthy: RunTraits | None = None
    seen: Array | None = None
    steps: list[BeamStep] = field(default_factory=list)
    _time: list[Array] = field(default_factory=list)
    _q: list[Array] = field(default_factory=list)
    _watch: StepWatch | None = None

    @property
    def complete(self) -> bool:
        """Whether all steps are measured."""
        return len(self.steps) == len(self.plan.names)

    @property
    def circles(self) -> list[str]:
        """Names of the circles so far."""
        return [step.name for step in self.steps if step.kind == "circle"]

    @property
    def awaited(self) -> PlannedStep:
        """The step to be driven now."""
        return self.plan.step(len(self.steps) + 1, self.seen)

    @property
    def edges(self) -> int:
        """How many edges the awaited step had so far."""
        return 0 if self._watch is None else self._watch.edges

    def waited_s(self, stamp_ns: int) -> float:
        """How long the step has been awaited, or since its first edge."""
        first_s = None if self._watch is None else self._watch.first_edge_s
        start_s = self._seconds(self.from_ns) if first_s is None else first_s
        return self._seconds(stamp_ns) - start_s

    def begin_step(self, stamp_ns: int) -> None:
        """The awaited step counts from a stamp."""
        self.from_ns, self._watch = stamp_ns, None

    def watch_edge(self, sample: EdgeSample) -> None:
        """Take an edge of the awaited step."""
        if sample.stamp_ns > self.from_ns:
            self._watched().edge(sample.beam, self._seconds(sample.stamp_ns))

    def step_over(self, stamp_ns: int, q: Array) -> bool:
        """Take a joint reading; whether the awaited step is over with it."""
        place = self.arm.fk(q)[:3, 3]
        return self._watched().over(self._seconds(stamp_ns), place)

    def take(self, edges: Sequence[EdgeSample], stamps: NDArray[np.int64], q: Array) -> None:
        """Add the awaited step with its edges and joint readings."""
        step, rule = self.awaited, self.config.input
        beams: list[Beam] = [sample.beam for sample in edges]
        found = [sample.edge(self.begun_ns, rule.sigma_s) for sample in edges]
        if beams:
            first, last = edges[0].stamp_ns - BEFORE_NS, edges[-1].stamp_ns + AFTER_NS
            near = (stamps >= first) & (stamps <= last)
            stamps, q = stamps[near], q[near]
        self._time.append(1e-9 * (stamps - self.begun_ns).astype(np.float64))
        self._q.append(q)
        # First: with readings edges are lost. The run so far: a short burst is no lossy line.
        if self.healthy is not None and (readings := self._readings):
            count, span_s = np.sum(readings, axis=0).tolist()
            self.healthy.require_readings(int(count), span_s, self.config.traits)
        edges_found = debounced(found, rule.debounce_s)
        self.steps.append(BeamStep(step.name, step.kind, edges_found, step.beams))
        if self.complete:
            return
        if self.plan.needs_tool(len(self.steps) + 1):
            tool = self.estimate(PLANNING)
            self.require_like_healthy(tool)
            self.seen = tool.T_flange_tool
        else:  # refuse what is of no use before more is driven
            taught, noise = self.plan.T_flange_tool, self.config.noise
            run_problem(self.plan.laser, self.path, self.steps, taught, noise)

    @property
    def path(self) -> JointPath:
        """The flange during the steps so far."""
        return JointPath(self.arm, np.concatenate(self._time), np.concatenate(self._q))

    @property
    def last_edge_s(self) -> Array:
        """Time (1,) of its last edge."""
        return np.array([max(edge.time_s for edge in self.steps[-1].edges)])

    @property
    def last_q(self) -> Array:
        """Joints (n,) there."""
        path = self.path
        return np.asarray(path.q[np.searchsorted(path.time_s, self.last_edge_s[0])])

    def estimate(self, held: Held) -> ToolEstimate:
        """The tool as the steps so far show it."""
        return estimate_tool(
            self.plan.laser,
            self.path,
            self.steps,
            self.plan.T_flange_tool,
            noise=self.config.noise,
            taper=self.config.taper,
            held=held,
        )

    def traits(self, estimate: ToolEstimate) -> RunTraits:
        """What the run shows beside the tool that it found."""
        count, span_s = np.sum(self._readings, axis=0).tolist()
        return RunTraits.of(estimate, self.circles, count / span_s)

    def require_like_healthy(self, estimate: ToolEstimate) -> None:
        """Refuse what is no bend, see `RunTraits.require_like`."""
        if self.healthy is not None:
            self.traits(estimate).require_like(self.healthy, self.config.traits)

    def turned(self, estimate: ToolEstimate) -> str:
        """That the beams have turned since the healthy tool's run, in words; else empty."""
        before_rad = None if self.healthy is None else self.healthy.turn_rad
        if self.healthy is None or before_rad is None or estimate.turn_rad is None:
            return ""
        off_rad = estimate.turn_rad - before_rad
        sigma_rad = float(np.hypot(estimate.turn_sigma_rad, self.healthy.turn_sigma_rad))
        if abs(off_rad) <= max(TURNED_SIGMAS * sigma_rad, LITTLE_TURN_RAD):
            return ""
        return (
            f"the beams have turned by {np.degrees(off_rad):.2f} deg (sigma "
            f"{np.degrees(sigma_rad):.2f}) since the healthy tool was measured, which no bend "
            "makes of them: the beam station was knocked"
        )

    def require_even_readings(self) -> None:
        """Refuse unlike rates of the joint readings, see `require_even`."""
        require_even([count / span_s for count, span_s in self._readings], self.config.traits)

    @property
    def _readings(self) -> list[tuple[int, float]]:
        """Of each step so far: joint readings after its first, and over what time, s."""
        return [(len(t) - 1, float(t[-1] - t[0])) for t in self._time if len(t) > 1]

    @property
    def inputs(self) -> dict[str, NDArray[Any]]:
        """All that was measured, for keeping."""
        edges = [(i, edge) for i, step in enumerate(self.steps) for edge in step.edges]
        return {
            "step": np.array([i for i, _ in edges]),
            "kind": np.array([step.kind for step in self.steps]),
            "beam": np.array([edge.beam for _, edge in edges]),
            "blocked": np.array([edge.blocked for _, edge in edges]),
            "edge_s": np.array([edge.time_s for _, edge in edges]),
            "edge_sigma_s": np.array([edge.sigma_s for _, edge in edges]),
            "joint_s": np.concatenate(self._time),
            "q": np.concatenate(self._q),
        }

    def _watched(self) -> StepWatch:
        if self._watch is None:
            step = self.awaited
            last, up = step.number == step.of, step.R_base_laser[:, 2]
            self._watch = StepWatch(step.kind, last, up, step.beams)
        return self._watch

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self.begun_ns) * 1e-9
