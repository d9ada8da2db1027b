"""The cold reference: base, targets and static errors, from one visit of the measuring poses."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import LARGEST_RMS_M, summarise
from robocal_ros.ground.errors import ResidualError
from robocal_ros.ground.frames import Document
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell import CellModel
from robocal_ros.identification.mismatch import require_match
from robocal_ros.identification.solve import identify
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ColdReference:
    """Cold visit of the measuring poses.

    Attributes
    ----------
    cell : the cold model with base and targets as fitted to the cold visit.
    data : the cold measurements.
    rejected : names of those that did not fit the others.
    temperature : (n,) of the motors, degrees Celsius; None where they were not read.
    fixed : (n, 3) centres of a sphere fixed in the cell, measured at the same visit, m; n may be 0.
    """

    cell: CellModel
    data: Measurements
    rejected: tuple[str, ...] = ()
    temperature: Array | None = None
    fixed: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def used(self) -> Measurements:
        """The measurements that placed base and targets."""
        return self.data.take(~np.isin(self.data.sample, self.rejected))

    @cached_property
    def spots(self) -> ColdSpots:
        """Each pose and target of the visit once."""
        return ColdSpots.of(self.cell, self.data)


def capture_reference(arm: SerialArm, data: Measurements) -> ColdReference:
    """Place base and targets from a cold visit with the cold model ``arm``.

    Samples that do not fit the others do not place them, and are named in ``rejected``; a warm
    visit of such a pose will not fit either.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the visit cannot place them.
    InputError, ResidualError
        When the visit misses the arm by a mistake that can be named, or by more than 5 mm rms.
    """
    require_match(arm, data, base=True, tool=True)
    placed = identify(arm, data, fit=("base", "tool"), method="lsq")
    reference = ColdReference(placed.cell, data, placed.rejected)
    rms = summarise(placed.cell.residual(reference.used)).rms_m
    if rms > LARGEST_RMS_M:
        raise ResidualError(
            f"the cold visit misses the model by {rms * 1e3:.1f} mm rms, more than any robot's "
            f"static error ({LARGEST_RMS_M * 1e3:.0f} mm): check robot file, units, joint signs "
            "and target names"
        )
    return reference


COMMISSIONED = "commissioned_mdh"  # of a reference's model: the arm without any drift


def holds_drift(model: Document | None) -> bool:
    """Whether a model document holds a drift since a cold reference; None: the nominal model."""
    return "reference_mdh" in (model or {})


def commissioned_of(reference: Document, nominal: SerialArm) -> SerialArm:
    """The arm without any drift, also where the reference was captured with the robot warm."""
    return nominal.with_mdh(np.array(reference.get(COMMISSIONED, reference["mdh"])))


def reference_document(reference: ColdReference) -> Document:
    """A cold reference in full precision, SI; ``reference_of`` reads it back to the last bit."""
    cell, data = reference.cell, reference.data
    return {
        "mdh": cell.arm.mdh.tolist(),
        "T_frame_base": cell.T_frame_base.tolist(),
        "targets": list(cell.targets),
        "T_flange_target": cell.T_flange_target.tolist(),
        "q": data.q.tolist(),
        "position": data.position.tolist(),
        "target": list(data.target),
        "sample": list(data.sample),
        "stamp_ns": None if data.stamp_ns is None else data.stamp_ns.tolist(),
        "fixed": reference.fixed.tolist(),
        "temperature": None if reference.temperature is None else reference.temperature.tolist(),
    }


def reference_of(document: Document, nominal: SerialArm) -> ColdReference:
    """Read a cold reference back from its document."""
    cell = CellModel(
        nominal.with_mdh(document["mdh"]),
        np.array(document["T_frame_base"]),
        tuple(document["targets"]),
        np.array(document["T_flange_target"]),
    )
    stamps = document["stamp_ns"]
    data = Measurements(
        q=np.array(document["q"]),
        position=np.array(document["position"]),
        target=tuple(document["target"]),
        sample=tuple(document["sample"]),
        stamp_ns=None if stamps is None else np.array(stamps, dtype=np.int64),
    )
    warmth = document["temperature"]
    return ColdReference(
        cell,
        data,
        fixed=np.array(document["fixed"]).reshape(-1, 3),
        temperature=None if warmth is None else np.array(warmth),
    )
