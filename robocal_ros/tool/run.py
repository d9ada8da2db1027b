"""One run through the beams: its steps, and the edges and joint readings of each."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise
from robocal_ros.tool.crossed_run import (
    RunTraits,
    ToolEstimate,
    TraitLimits,
    estimate_tool,
    require_even,
    run_problem,
)
from robocal_ros.tool.edges import Beam, EdgeSample, InputRule, debounced
from robocal_ros.tool.flange_path import JointPath
from robocal_ros.tool.judging import ToolLimits
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.measuring_plan import MeasuringMotion, MeasuringPlan, PlannedStep, StepWatch
from robocal_ros.tool.quick_check import CheckRule
from robocal_ros.tool.witness import BendRule

# ---- settings of the tool session ---------------------------------------------------------------


Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ToolConfig:
    """Settings of a tool session; plain values, so that a recording carries them.

    Attributes
    ----------
    points_m : four points (A, B on the x-beam, C, D on the y-beam), base.
    laser_sigma_m, reach_m : see `LaserFrame`.
    taught : rows of T_flange_tool (4, 4) as taught.
    station : frame_id of the beams' edges; empty: any.
    beams : names of the x- and the y-beam in the edges.
    mandrel : rows of T_flange_mandrel (4, 4), z along its axis to its end; None: there is none.
    taper : growth of the tool's radius per length above the tip.
    spin_rad : turn of the flange about the laser's z while it measures.
    step_timeout_s : a step without any edge for so long ends the run.
    """

    points_m: Rows
    taught: Rows
    mandrel: Rows | None = None
    laser_sigma_m: float = 0.0
    reach_m: tuple[float, float] = (0.0, 0.0)
    station: str = ""
    beams: tuple[str, str] = ("x", "y")
    taper: float = 0.0
    spin_rad: float = 0.0
    step_timeout_s: float = 30.0
    motion: MeasuringMotion = field(default_factory=MeasuringMotion)
    input: InputRule = field(default_factory=InputRule)
    noise: RobotNoise = field(default_factory=RobotNoise)
    check: CheckRule = field(default_factory=CheckRule)
    limits: ToolLimits = field(default_factory=ToolLimits)
    traits: TraitLimits = field(default_factory=TraitLimits)

    @property
    def laser(self) -> LaserFrame:
        """The beams."""
        return LaserFrame(np.array(self.points_m), self.laser_sigma_m, np.array(self.reach_m))

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

        Raises
        ------
        InputError
            When it has other settings than this version knows.
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


# ---- one run through the beams: its steps, and the edges and joint readings of each -------------


PLANNING = Held(along_m=5e-3)  # before any plunge the tip is taken where it was taught
BEFORE_NS = AFTER_NS = 1_000_000_000  # joint readings kept about the edges of a step


@dataclass(eq=False)
class ToolRun:
    """A run as it grows.

    Attributes
    ----------
    number : of the run in its session, from 1; ``mode`` as it was asked for.
    arm, thermal_revision : the model in force when it began.
    begun_ns : origin of its times.
    from_ns : the step that is awaited counts from here.
    healthy : traits of the healthy tool's run, which this one must share; None: none are known.
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
        """Add the awaited step with its edges and joint readings.

        Raises
        ------
        RobocalError
            When the edges make no sense, no tool explains the steps so far, or they differ from the
            healthy tool's in what no bend changes.
        """
        step, rule = self.awaited, self.config.input
        beams: list[Beam] = [sample.beam for sample in edges]
        found = [sample.edge(self.begun_ns, rule.sigma_s) for sample in edges]
        if beams:
            first, last = edges[0].stamp_ns - BEFORE_NS, edges[-1].stamp_ns + AFTER_NS
            near = (stamps >= first) & (stamps <= last)
            stamps, q = stamps[near], q[near]
        self._time.append(1e-9 * (stamps - self.begun_ns).astype(np.float64))
        self._q.append(q)
        self._require_readings()  # first: with readings edges are lost
        self.steps.append(BeamStep(step.name, step.kind, debounced(found, rule.debounce_s)))
        if self.complete:
            return
        if self.plan.needs_tool(len(self.steps) + 1):
            tool = self.estimate(PLANNING)
            self.require_like_healthy(tool)
            self.seen = tool.T_flange_tool
        else:
            self._check()

    @property
    def path(self) -> JointPath:
        """The flange during the steps so far."""
        return JointPath(self.arm, np.concatenate(self._time), np.concatenate(self._q))

    @property
    def last_edge_s(self) -> Array:
        """Time (1,) of its last edge."""
        return np.array([max(edge.time_s for edge in self.steps[-1].edges)])

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

    def require_even_readings(self) -> None:
        """Refuse unlike rates of the joint readings, see `require_even`."""
        require_even([count / span_s for count, span_s in self._readings], self.config.traits)

    @property
    def _readings(self) -> list[tuple[int, float]]:
        """Of each step so far: joint readings after its first, and over what time, s."""
        return [(len(t) - 1, float(t[-1] - t[0])) for t in self._time if len(t) > 1]

    def _require_readings(self) -> None:
        """Judge the run so far: a short burst in one step is no lossy line."""
        if self.healthy is not None and (readings := self._readings):
            count, span_s = np.sum(readings, axis=0).tolist()
            self.healthy.require_readings(int(count), span_s, self.config.traits)

    def arrays(self) -> dict[str, NDArray[Any]]:
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

    def _check(self) -> None:
        """Refuse steps whose edges or joint readings are of no use, before more are driven."""
        tool, noise = self.plan.T_flange_tool, self.config.noise
        run_problem(self.plan.laser, self.path, self.steps, tool, noise)

    def _watched(self) -> StepWatch:
        if self._watch is None:
            step = self.awaited
            self._watch = StepWatch(step.kind, step.number == step.of, step.R_base_laser[:, 2])
        return self._watch

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self.begun_ns) * 1e-9
