# SPDX-License-Identifier: Apache-2.0
"""Make ``positions.csv`` beside this file: ``.venv/bin/python docs/examples/make_positions.py``.

Simulated, nothing was measured: a robot attains two poses thirty times, some tenths of a millimetre
off, with noise of about 0.02 mm an axis.
"""

from pathlib import Path

import numpy as np

COMMANDED_MM = {"P1": (1200.0, 0.0, 900.0), "P2": (1400.0, -350.0, 650.0)}
OFF_MM = {"P1": (0.31, -0.12, -0.22), "P2": (0.42, 0.15, -0.36)}
NOISE_MM = {"P1": 0.018, "P2": 0.024}
CYCLES = 30


def main() -> None:
    """Write the table."""
    rng = np.random.default_rng(9283)
    lines = ["target,x_mm,y_mm,z_mm"]
    for _ in range(CYCLES):
        for name, commanded in COMMANDED_MM.items():
            attained = np.add(commanded, OFF_MM[name]) + NOISE_MM[name] * rng.standard_normal(3)
            lines.append(f"{name}," + ",".join(f"{value:.3f}" for value in attained))
    Path(__file__).with_name("positions.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
