"""What a run shows beside the tool: how thick each beam sees it, how late the edges are, how many
joint readings came. No bend changes these; what differs from the healthy tool's run is a fault.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, RobocalError, TooFewSamplesError
from robocal_ros.tool.beam_edges import BEAMS, BeamError
from robocal_ros.tool.crossed_run import ToolEstimate

Array = NDArray[np.float64]

ONE_SIDED = 1.645  # sigmas: what is at a limit looks larger by so much in 5 % of cases
AS_LOW = "circle"  # of a quick check: as high above the tip as the circle `low` of a whole run
LOW = "low"


class WrongToolError(RobocalError):
    """Another tool than the healthy one that was measured."""

    code = Code.WRONG_TOOL


class ClockError(RobocalError):
    """Edges and joint readings are not stamped on one clock, or the input's delay has changed."""

    code = Code.CLOCK_WRONG


@dataclass(frozen=True)
class TraitLimits:
    """Changes against the healthy tool's run that are no fault yet; 0: any.

    Attributes
    ----------
    radius_m : of the tool as a beam sees it.
    latency_s : of the edges behind the joint readings.
    lost : share of the joint readings.
    """

    radius_m: float = 5e-5
    latency_s: float = 5e-3
    lost: float = 0.05


@dataclass(frozen=True)
class RunTraits:
    """Traits of a run.

    Attributes
    ----------
    radius_m : by circle, of the tool as the x- and the y-beam see it; ``radius_sigma_m`` of each.
    latency_s, latency_sigma_s : of the edges behind the joint readings.
    rate_hz : of the joint readings.
    """

    radius_m: Mapping[str, tuple[float, float]]
    radius_sigma_m: float
    latency_s: float
    latency_sigma_s: float
    rate_hz: float

    @classmethod
    def of(cls, estimate: ToolEstimate, circles: Sequence[str], rate_hz: float) -> "RunTraits":
        """Of a measured tool; ``circles``: names in the order of its radii."""
        found = estimate.estimate
        own = np.array([name.startswith("radius_") for name in found.names])
        variance = np.diag(found.covariance)[own]
        radii = zip(circles, estimate.radius.tolist(), strict=True)
        return cls(
            {name: (x, y) for name, (x, y) in radii},
            float(np.sqrt(np.max(variance))),
            estimate.latency_s,
            estimate.latency_sigma_s,
            rate_hz,
        )

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "RunTraits":
        """Read what `document` gave, also after JSON."""
        radius = {name: (x, y) for name, (x, y) in document["radius_m"].items()}
        return cls(**(dict(document) | {"radius_m": radius}))

    def require_readings(self, count: int, span_s: float, limits: TraitLimits) -> None:
        """Refuse ``count`` readings over a time where this run would have had clearly more.

        Raises
        ------
        TooFewSamplesError
            When messages are lost.
        """
        expected = self.rate_hz * span_s
        lost = 1.0 - count / expected if expected > 0.0 else 0.0
        sigma = np.sqrt(max(lost * (1.0 - lost), 0.0) / max(expected, 1.0))
        if _beyond(max(lost, 0.0), float(sigma), limits.lost):
            raise TooFewSamplesError(
                f"{lost:.0%} of the joint readings are missing: {count} in {span_s:.1f} s, the "
                f"healthy tool was measured with {self.rate_hz:.0f} in a second; edges are lost "
                "with them: look at network and load, or measure the healthy tool at this rate"
            )

    def require_like(self, healthy: "RunTraits", limits: TraitLimits) -> None:
        """Refuse a run that differs from the healthy tool's in what no bend changes.

        Raises
        ------
        ClockError
            When the edges are later or earlier than they were.
        BeamError
            When one beam alone sees the tool grown or shrunk.
        WrongToolError
            When both do.
        """
        self._require_clock(healthy, limits)
        change = self._grown(healthy)
        if change is None:
            return
        sigma = float(np.hypot(self.radius_sigma_m, healthy.radius_sigma_m))
        apart, both = float(change[0] - change[1]), float(np.mean(change))
        x, y = (f"{1e3 * part:+.3f}" for part in change)
        words = f"against the healthy tool its radius is {x} mm in beam x and {y} mm in beam y"
        if _beyond(apart, np.sqrt(2.0) * sigma, limits.radius_m):
            worse = BEAMS[int(np.argmax(np.abs(change)))]
            raise BeamError(
                f"{words}: a tool changes for both, so beam {worse} is dirty or out of line; clean "
                "and align it, then measure the healthy tool anew"
            )
        if _beyond(both, np.sqrt(0.5) * sigma, limits.radius_m):
            raise WrongToolError(
                f"{words}: another tool is mounted, this one is worn or fouled, or both beams are "
                "dirty; mount the right one, or measure it in mode REFERENCE"
            )

    def _require_clock(self, healthy: "RunTraits", limits: TraitLimits) -> None:
        later = self.latency_s - healthy.latency_s
        sigma = float(np.hypot(self.latency_sigma_s, healthy.latency_sigma_s))
        if _beyond(later, sigma, limits.latency_s):
            raise ClockError(
                f"the edges are {1e3 * self.latency_s:.1f} ms behind the joint readings, with the "
                f"healthy tool it were {1e3 * healthy.latency_s:.1f} ms: a clock has jumped, or "
                "the input is delayed; put both on one clock, or measure the healthy tool anew"
            )

    def _grown(self, healthy: "RunTraits") -> Array | None:
        """Growth (2,) of the radius in each beam, m; None where no circle is common."""
        pairs = [
            (radii, healthy.radius_m[LOW if name == AS_LOW else name])
            for name, radii in self.radius_m.items()
            if (LOW if name == AS_LOW else name) in healthy.radius_m
        ]
        if not pairs:
            return None
        return np.asarray(np.mean([np.subtract(now, then) for now, then in pairs], axis=0))


def require_even(rates_hz: Sequence[float], limits: TraitLimits) -> None:
    """Refuse a healthy tool's run whose steps (k,) had joint readings at unlike rates.

    Measured under loss it would hide what is lost later. A loss that is alike in all steps does
    not show.

    Raises
    ------
    TooFewSamplesError
        When the slowest and the fastest step differ by more than the limit.
    """
    slowest, fastest = min(rates_hz), max(rates_hz)
    if _beyond(1.0 - slowest / fastest, 0.0, limits.lost):
        raise TooFewSamplesError(
            f"joint readings came at {slowest:.0f} to {fastest:.0f} in a second: some were lost, "
            "and a healthy tool measured so would hide later loss; look at network and load, then "
            "measure it again"
        )


def _beyond(change: float, sigma: float, limit: float) -> bool:
    """Whether a change is larger than the limit in all but 5 % of cases; not a number is."""
    return limit > 0.0 and not abs(change) - ONE_SIDED * sigma <= limit
