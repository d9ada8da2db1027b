"""A replayed thermal session, cycle by cycle: what it brought, from its history and the truth."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagMessage
from robocal_ros.cli.bag_truth import CheckPoints
from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import BagOverview
from robocal_ros.ground.proposals import REFERENCE, THERMAL, Action, Entry
from robocal_ros.ground.samples import MEASURING, Measurements, stamp_ns
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.report.drift import figures_of
from robocal_ros.thermal.identification import measured_errors, true_errors
from robocal_ros.thermal.reference import ColdReference, holds_drift, reference_of
from robocal_ros.thermal.session import ThermalSession

Array = NDArray[np.float64]
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
