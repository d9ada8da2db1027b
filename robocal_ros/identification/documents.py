"""Identified models as plain documents (JSON), in the units people read."""

import numpy as np

from robocal_ros.estimation.assessment import judged_errors_document, verdict_document
from robocal_ros.ground.frames import Document, transform_document
from robocal_ros.identification import CellModel, Identification, JudgedIdentification
from robocal_ros.kinematics.arm import model_document, parameters_document


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


def cell_document(cell: CellModel) -> Document:
    """Base and targets of a cell model."""
    return {
        "T_frame_base": transform_document(cell.T_frame_base),
        "T_flange_target": {
            name: transform_document(T)
            for name, T in zip(cell.targets, cell.T_flange_target, strict=True)
        },
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
