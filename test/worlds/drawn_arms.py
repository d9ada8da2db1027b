# SPDX-License-Identifier: Apache-2.0
"""Arms of several kinds and joint vectors, as hypothesis draws them, and twists between poses."""

import numpy as np
from hypothesis import strategies as st

from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import ALPHA


def twist(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Displacement [v; w] (6,) from one pose to another, in base axes."""
    turn = frames.log_rotation(after[:3, :3] @ before[:3, :3].T)
    return np.concatenate([after[:3, 3] - before[:3, 3], turn])


KINDS = st.sampled_from(["six revolute", "parallel axes", "sliding"])


@st.composite
def arms(draw: st.DrawFn) -> tuple[SerialArm, np.ndarray]:
    """An arm of a kind, off its nominal geometry, and a joint vector."""
    kind, rng = draw(KINDS), np.random.default_rng(draw(st.integers(0, 2**31)))
    n = {"six revolute": 6, "parallel axes": 6, "sliding": int(rng.integers(2, 8))}[kind]
    mdh = rng.uniform(-1.0, 1.0, (n, 5)) * [1.0, np.pi, 1.0, np.pi, 0.02]
    if kind == "parallel axes":
        mdh[1:3, ALPHA] = rng.normal(0.0, 1e-3, 2)
    prismatic = rng.random(n) < 0.5 if kind == "sliding" else np.zeros(n, dtype=bool)
    arm = SerialArm(
        kind,
        tuple(f"joint_{i + 1}" for i in range(n)),
        mdh,
        rng.choice([-1.0, 1.0], n),
        prismatic,
        np.full(n, -np.inf),
        np.full(n, np.inf),
        T_base_root=frames.transform(frames.exp_rotation(rng.normal(size=3)), rng.normal(size=3)),
    )
    return arm, rng.uniform(-2.0, 2.0, n)
