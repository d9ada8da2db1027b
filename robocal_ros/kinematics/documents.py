"""Arms and their parameters as plain documents (JSON), in the units people read."""

import numpy as np

from robocal_ros.ground.frame_texts import Document
from robocal_ros.kinematics import SerialArm


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


def arm_of(model: Document, nominal: SerialArm) -> SerialArm:
    """The nominal arm with the parameters of a model document."""
    return nominal.with_mdh(np.array(model["mdh"], dtype=np.float64))


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
