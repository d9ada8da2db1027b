"""Results as plain documents (JSON), in the units people read: the form that is kept and shown."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.assessment import ErrorSummary, Judgement, Verdict
from robocal_ros.core.identification import CellModel, Identification, JudgedIdentification
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import Measurements
from robocal_ros.core.thermal.reference import ColdReference

Array = NDArray[np.float64]
Document = dict[str, Any]

COMMISSIONED = "commissioned_mdh"  # of a reference's model: the arm without any drift


def transform_document(T: Array) -> Document:
    """A pose (4, 4) as ``xyz_mm`` and ``quat_xyzw``."""
    return {"xyz_mm": (T[:3, 3] * 1e3).tolist(), "quat_xyzw": frames.quat_xyzw(T).tolist()}


def errors_document(errors: ErrorSummary) -> Document:
    """Held-out errors in mm."""
    return {
        "mean_mm": errors.mean_m * 1e3,
        "rms_mm": errors.rms_m * 1e3,
        "p95_mm": errors.p95_m * 1e3,
        "max_mm": errors.max_m * 1e3,
        "n": errors.n,
    }


def judged_errors_document(judged: Judgement) -> Document:
    """Held-out errors before and after, and those that the candidate's covariance predicts."""
    return {
        "nominal": {"held_out": errors_document(judged.nominal)},
        "in_force": {"held_out": errors_document(judged.current)},
        "calibrated": {
            "held_out": errors_document(judged.candidate),
            "predicted": {
                "model_rms_mm": judged.predicted_rms_m * 1e3,
                "total_rms_mm": judged.predicted_total_rms_m * 1e3,
                "workspace_rms_mm": judged.workspace_rms_m * 1e3,
            },
        },
    }


def verdict_document(verdict: Verdict) -> Document:
    """Decision, its code's name and its reason."""
    return {"accept": verdict.accept, "code": verdict.code.name, "reason": verdict.reason}


def model_document(arm: SerialArm) -> Document:
    """A model in full precision, SI; ``arm_of`` reads it back to the last bit."""
    return {
        "robot": arm.name,
        "joint_names": list(arm.joint_names),
        "sign": arm.sign.tolist(),
        "prismatic": arm.prismatic.tolist(),
        "mdh": arm.mdh.tolist(),
        "T_base_root": arm.T_base_root.tolist(),
    }


def identified_model_document(result: Identification) -> Document:
    """``model_document`` of an identified arm, with its parameters' covariance (SI).

    ``parameters`` are those that were unknown, in the order of ``covariance``.
    """
    _, _, place = result.layout.geometry
    covariance = result.estimate.covariance[np.ix_(place, place)]
    return model_document(result.cell.arm) | {
        "parameters": [result.layout.names[i] for i in place],
        "covariance": covariance.tolist(),
    }


def arm_of(model: Document, nominal: SerialArm) -> SerialArm:
    """The nominal arm with the parameters of a model document."""
    return nominal.with_mdh(np.array(model["mdh"], dtype=np.float64))


def holds_drift(model: Document | None) -> bool:
    """Whether a model document holds a drift since a cold reference; None: the nominal model."""
    return "reference_mdh" in (model or {})


def commissioned_of(reference: Document, nominal: SerialArm) -> SerialArm:
    """The arm without any drift, also where the reference was captured with the robot warm."""
    return nominal.with_mdh(np.array(reference.get(COMMISSIONED, reference["mdh"])))


def cell_document(cell: CellModel) -> Document:
    """Base and targets of a cell model."""
    return {
        "T_frame_base": transform_document(cell.T_frame_base),
        "T_flange_target": {
            name: transform_document(T)
            for name, T in zip(cell.targets, cell.T_flange_target, strict=True)
        },
    }


def parameters_document(
    nominal: SerialArm, identified: SerialArm, sigma: dict[str, float]
) -> Document:
    """Nominal value, identified value and standard deviation of every free parameter.

    ``sigma`` in SI by name; a parameter without one was held at its nominal value (null).
    """
    chosen = nominal.parameters
    factor = chosen.to_display
    rows = zip(
        chosen.names,
        (chosen.read(nominal.mdh) * factor).tolist(),
        (chosen.read(identified.mdh) * factor).tolist(),
        factor.tolist(),
        strict=True,
    )
    return {
        name: {
            "nominal": before,
            "value": after,
            "sigma": sigma[name] * unit if name in sigma else None,
        }
        for name, before, after, unit in rows
    }


def identification_document(judged: JudgedIdentification) -> Document:
    """The ``identify`` document: errors before and after, parameters, rank, verdict."""
    result = judged.identification
    seen = result.estimate.observability
    return {
        "robot": result.nominal.name,
        "model_hash": result.nominal.model_hash,
        "method": result.method,
        **judged_errors_document(judged),
        "parameters": parameters_document(result.nominal, result.cell.arm, result.sigma()),
        **cell_document(result.cell),
        "noise_mm": result.noise_m * 1e3,
        "samples": len(result.estimate.rejected),
        "rank": seen.rank,
        "unknowns": len(result.layout.names) + len(result.held),
        "condition": seen.condition,
        "unobservable": list(result.unobservable),
        "held": list(result.held),
        "rejected": list(result.rejected),
        "held_out_rejected": list(judged.held_out_rejected),
        "converged": result.estimate.converged,
        "verdict": verdict_document(judged.verdict),
    }


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
