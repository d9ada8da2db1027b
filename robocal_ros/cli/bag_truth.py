"""What a bag is judged by: the truth of a simulated one, else its own measurements."""

import json
import math
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import BagOverview
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import REFERENCE, THERMAL, Action, Entry
from robocal_ros.ground.samples import MEASURING, Measurements, stamp_ns
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.report.validation import figures_of
from robocal_ros.thermal.reference import (
    ColdReference,
    holds_drift,
    measured_errors,
    reference_of,
    true_errors,
)
from robocal_ros.thermal.session import ThermalSession

Array = NDArray[np.float64]
Transforms = list[tuple[int, Array]]

CHECK_POINTS, TOOL, HAND_EYE = "/truth/check_points", "/truth/tool", "/truth/hand_eye"
TRANSFORMS = {TOOL: "T_flange_tool", HAND_EYE: "T_flange_sensor"}
STATE = "/truth/state"  # of whichever node tells it
NEAREST_NS = 120_000_000_000  # a truth is told within two minutes of its cycle
SERIES = {  # of a state, by what it is called here, the first that is told
    "without_m": ("visited_tcp_error_rms_m", "tcp_error_rms_m"),
    "with_m": ("commanded_tcp_error_rms_m",),
    "p95_m": ("commanded_tcp_error_p95_m",),
    "lambda_without": ("visited_within_share", "within_share"),
    "lambda_with": ("commanded_within_share",),
}


@dataclass(frozen=True, eq=False)
class CheckPoints:
    """Where the tool truly was at poses that were never measured, without correction.

    Attributes
    ----------
    q : (m, n) joints commanded, rad.
    tool : (3,) in the flange, m.
    stamp_ns : (t,) when it was told.
    position : (t, m, 3), base, m; the first is the cold robot.
    """

    q: Array
    tool: Array
    stamp_ns: NDArray[np.int64]
    position: Array

    def moved(self, at_ns: int) -> Array | None:
        """Displacement (m, 3) since the cold robot, told nearest to a stamp; None: not near it."""
        away = np.abs(self.stamp_ns - at_ns)
        nearest = int(np.argmin(away))
        if away[nearest] > NEAREST_NS:
            return None
        return np.asarray(self.position[nearest] - self.position[0])


@dataclass(frozen=True, eq=False)
class ToldStates:
    """States of a simulated cell: 48 bytes of each, however much it tells.

    Attributes
    ----------
    stamp_ns : (t,) when each was told.
    series : the `SERIES`, (t,) each; not a number where it is not told.
    faults : stamp, ns, fault and size, SI (0: it ended), as they changed.
    transforms : by their names, as they changed.
    """

    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    series: "dict[str, array[float]]" = field(
        default_factory=lambda: {name: array("d") for name in SERIES}
    )
    faults: list[tuple[int, str, float]] = field(default_factory=list)
    transforms: dict[str, Transforms] = field(
        default_factory=lambda: {name: [] for name in TRANSFORMS.values()}
    )
    _sizes: dict[str, float] = field(default_factory=dict)

    def add(self, stamp_ns: int, state: dict[str, Any]) -> None:
        """Take the next state. Raises ValueError or TypeError for what is no finite number."""
        self.stamp_ns.append(stamp_ns)
        for name, keys in SERIES.items():
            key = next((key for key in keys if key in state), None)
            self.series[name].append(math.nan if key is None else finite(state[key], key))
        now = state.get("faults", {})
        for fault in sorted({*now, *self._sizes}):
            size = finite(now.get(fault, 0.0), f"faults.{fault}")
            if size != self._sizes.get(fault, 0.0):
                self.faults.append((stamp_ns, fault, size))
                self._sizes[fault] = size
        for name, told in self.transforms.items():
            if name in state:
                _add_changed(told, stamp_ns, _transform(state, name))


class BagTruth:
    """The truth that a bag tells, of each robot by its namespace; the states are read once."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._topics = reader.info.topics

    @cached_property
    def states(self) -> dict[str, ToldStates]:
        """Those of each cell, by their topic; without a cell that tells none.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        found = {topic: ToldStates() for topic in self._topics if topic.endswith(STATE)}
        for topic, states in found.items():
            with self.reading(topic):
                for stamp_ns, state in self._told(topic):
                    states.add(stamp_ns, state)
        return {topic: states for topic, states in found.items() if states.stamp_ns}

    def state_topic(self, namespace: str) -> str | None:
        """Topic of the states that are told in a namespace, by a node or not; None without any.

        Raises
        ------
        InputError
            When there are several, and nothing says which is meant.
        """
        places = {topic: topic.removesuffix(STATE) for topic in self.states}
        found = [topic for topic, place in places.items() if place == namespace]
        found = found or [topic for topic, place in places.items() if above(place) == namespace]
        if len(found) > 1:
            raise InputError(
                f"{' and '.join(found)} tell two truths of what is in namespace "
                f"'{namespace or '/'}': give each robot's topics a namespace of their own",
                file=self._reader.info.path,
            )
        return found[0] if found else None

    def transforms(self, topic: str, namespace: str) -> Transforms:
        """Stamps, ns, and transforms (4, 4) from then on, of `TRANSFORMS`; empty: none is told.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        name, own = TRANSFORMS[topic], f"{namespace}{topic}"
        told: Transforms = []
        with self.reading(own):
            for stamp_ns, truth in self._told(own):
                _add_changed(told, stamp_ns, _transform(truth, name))
        if told:
            return told
        states = self.state_topic(namespace)
        return [] if states is None else self.states[states].transforms[name]

    def check_points(self, namespace: str) -> CheckPoints | None:
        """The true positions that a bag tells; None where it tells none.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        topic = f"{namespace}{CHECK_POINTS}"
        stamps: list[int] = []
        positions: list[Array] = []
        with self.reading(topic):
            for stamp_ns, truth in self._told(topic):
                if not stamps:
                    q, tool = _array(truth, "q_rad"), _array(truth, "tool_in_flange_m")
                stamps.append(stamp_ns)
                positions.append(_array(truth, "position_m"))
            if not stamps:
                return None
            return CheckPoints(q, tool, np.array(stamps, dtype=np.int64), np.array(positions))

    def _told(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        if topic in self._topics:
            for recorded in self._reader.messages([topic]):
                yield recorded.log_time_ns, json.loads(recorded.message.data)

    @contextmanager
    def reading(self, topic: str) -> Iterator[None]:
        """Tell what goes wrong with a topic as an `InputError` that names it."""
        try:
            yield
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            why = f"no {error}" if isinstance(error, KeyError) else error
            words = f"topic {topic} cannot be read: {why}"
            raise InputError(words, file=self._reader.info.path) from error


def is_simulated(reader: BagReader) -> bool:
    """Whether a bag tells any truth: what is measured has none."""
    return any("truth" in topic.split("/") for topic in reader.info.topics)


def above(name: str) -> str:
    """The namespace of a node or topic: empty for the root."""
    return name.rpartition("/")[0]


def finite(value: Any, name: str) -> float:
    """A number that was told. Raises ValueError, with its name, when it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}, which is no finite number")
    return float(value)


def _array(truth: dict[str, Any], name: str) -> Array:
    found = np.array(truth[name], dtype=np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} holds what is no finite number: {truth[name]}")
    return found


def _transform(truth: dict[str, Any], name: str) -> Array:
    found = _array(truth, name)
    if found.shape != (4, 4):
        raise ValueError(f"{name} has the shape {found.shape}, not (4, 4)")
    return found


def _add_changed(told: Transforms, stamp_ns: int, T: Array) -> None:
    if not told or not np.array_equal(told[-1][1], T):
        told.append((stamp_ns, T))


# ---- what the measurements of a thermal session say of it ---------------------------------------


EVERYTHING = 1_000_000


@dataclass
class Forecasts:
    """What the session expected of the tool's error whenever something was measured.

    ``known`` has the stamp, ns, the rms and the 95 % bound, mm.
    """

    known: list[tuple[int, float, float]] = field(default_factory=list)

    def beside(
        self, session: ThermalSession, recording: BagOverview, samples: Iterator[BagMessage]
    ) -> Iterator[BagMessage]:
        """Ask before each measurement; the session learns of a cycle only when it ends."""
        for sample in samples:
            kind = recording.inputs.get(sample.topic)
            if kind in MEASURING and session.reference is not None:
                now_ns = stamp_ns(sample.message.header.stamp)
                if (error := session.accuracy(now_ns).error) is not None:
                    self.known.append((now_ns, error.rms_m * 1e3, error.bound_m * 1e3))
            yield sample

    def at(self, first_ns: int) -> Document | None:
        """The forecast when a cycle's first measurement came; None where there is none."""
        found = next((known for known in self.known if known[0] >= first_ns), None)
        return None if found is None else {"rms_mm": found[1], "bound_mm": found[2]}


@dataclass(frozen=True, eq=False)
class CycleErrors:
    """Errors (m, 3), m: without correction, with the model in force before, and (truth) after."""

    without: Array
    in_force: Array
    after: Array | None = None

    def document(self) -> Document:
        """Their figures; ``after`` only where it is known."""
        found = {"without": figures_of(self.without), "in_force": figures_of(self.in_force)}
        return found if self.after is None else found | {"after": figures_of(self.after)}


@dataclass(frozen=True, eq=False)
class ReplayedCycle:
    """A candidate of the history, with the errors around it.

    Attributes
    ----------
    hours : since the cold reference, else since the first joint reading.
    measured : at the cycle's own poses, by models that it did not make; None for a calibration.
    true : at check poses that were never measured; None without a truth.
    drift, sigma : (k,) since the cold reference, SI.
    """

    entry: Entry
    document: Document
    hours: float
    measured: CycleErrors | None
    true: CycleErrors | None
    forecast: Document | None
    drift: Array
    sigma: Array


class ThermalHistory:
    """The history of a replayed thermal session.

    Parameters
    ----------
    nominal : the arm without any calibration.
    start_ns : first joint reading.
    """

    def __init__(self, history: CalibrationHistory, nominal: SerialArm, start_ns: int) -> None:
        self._history, self._nominal, self._start_ns = history, nominal, start_ns
        entries = sorted(history.list(EVERYTHING), key=lambda entry: entry.id)
        # what was in force when the recording began has no cycle of its own in it
        self.candidates = [e for e in entries if e.kind == THERMAL and e.stamp_ns >= start_ns]
        self._references = [e for e in entries if e.kind == REFERENCE]

    @cached_property
    def _in_force(self) -> dict[int, int | None]:
        """Calibration of each thermal revision; None for the nominal model."""
        made = [d for d in self._history.decisions() if d.kind == THERMAL]
        changes = [d for d in made if d.action is not Action.REJECT]
        return {0: None} | {d.head_after: d.calibration_id for d in changes}

    def _model(self, revision: int) -> SerialArm:
        chosen = self._in_force[revision]
        if chosen is None:
            return self._nominal
        return arm_of(self._history.model(chosen), self._nominal)

    def _reference(self, model: Document) -> ColdReference | None:
        """The cold reference that a model counts from; None for one that counts from none."""
        for entry in reversed(self._references if holds_drift(model) else []):
            reference = reference_of(self._history.model(entry.id), self._nominal)
            if reference.data.middle_ns == model["reference_stamp_ns"]:
                return reference
        return None

    def cycles(
        self, forecasts: Forecasts, truth: CheckPoints | None, sigma_m: float
    ) -> list[ReplayedCycle]:
        """Every candidate, in the order in which they were made."""
        last = self._history.head(THERMAL).revision
        following = [entry.based_on for entry in self.candidates[1:]] + [last]
        return [
            self._cycle(entry, after, forecasts, truth, sigma_m)
            for entry, after in zip(self.candidates, following, strict=True)
        ]

    def _cycle(
        self,
        entry: Entry,
        after: int,
        forecasts: Forecasts,
        truth: CheckPoints | None,
        sigma_m: float,
    ) -> ReplayedCycle:
        model, document = self._history.model(entry.id), self._history.document(entry.id)
        reference = self._reference(model)
        before, arm = self._model(entry.based_on), arm_of(model, self._nominal)
        cold = self._nominal if reference is None else reference.cell.arm
        start_ns = self._start_ns
        measured = true = forecast = None
        if reference is not None:
            start_ns = reference.data.middle_ns
            data = Measurements.of_arrays(self._history.inputs(entry.id))
            measured = self._measured(reference, data, document, [cold, before], sigma_m)
            first_ns = entry.stamp_ns if data.stamp_ns is None else int(data.stamp_ns.min())
            forecast = forecasts.at(first_ns)
            true = None if truth is None else self._true(truth, entry, cold, before, after)
        return ReplayedCycle(
            entry=entry,
            document=document,
            hours=(entry.stamp_ns - start_ns) / 3.6e12,
            measured=measured,
            true=true,
            forecast=forecast,
            drift=cold.parameters.read(arm.mdh - cold.mdh),
            sigma=_sigma(model, cold),
        )

    def _measured(
        self,
        reference: ColdReference,
        data: Measurements,
        document: Document,
        models: list[SerialArm],
        sigma_m: float,
    ) -> CycleErrors | None:
        rejected = document["held_out_rejected"]
        errors = measured_errors(reference, data, models, left_out=rejected, sigma_m=sigma_m)
        return CycleErrors(*errors) if len(errors[0]) else None

    def _true(
        self, truth: CheckPoints, entry: Entry, cold: SerialArm, before: SerialArm, after: int
    ) -> CycleErrors | None:
        moved = truth.moved(entry.stamp_ns)
        if moved is None:
            return None
        errors = [
            true_errors(cold, model, truth.q, truth.tool, moved)
            for model in (before, self._model(after))
        ]
        return CycleErrors(moved, *errors)


def _sigma(model: dict[str, Any], arm: SerialArm) -> Array:
    """Standard deviations (k,) of the free parameters; zero for one that was held."""
    given = dict(zip(model["parameters"], np.sqrt(np.diag(model["covariance"])), strict=True))
    return np.array([given.get(name, 0.0) for name in arm.parameters.names])
