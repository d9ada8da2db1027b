"""The housing of a beam station, and the tool and flange that must stay clear of it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.motion.limits import MotionLimits

# ---- the housing of a beam station, and the tool and flange that must stay clear of it ----------


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Housing:
    """What is solid at a station, seen from the laser frame: z up, the crossing as origin.

    Solid is all that lies below ``top_m`` outside a cylinder about z, and all below ``floor_m``, as
    far as the housing reaches.

    Attributes
    ----------
    clear_radius_m : of that cylinder, the opening.
    top_m, floor_m : heights above the beam plane; the floor's is negative.
    retract_m : height of the tool's tip on a way over the housing.
    reach_m : radius about z beyond which nothing is solid; infinite: all around.
    """

    clear_radius_m: float
    top_m: float
    floor_m: float
    retract_m: float
    reach_m: float = np.inf

    def __post_init__(self) -> None:
        opening, top, depth = 1e3 * self.clear_radius_m, 1e3 * self.top_m, -1e3 * self.floor_m
        retract, reach = 1e3 * self.retract_m, 1e3 * self.reach_m
        needed = {
            f"opening radius {opening:g} mm: must be positive": 0.0 < opening < np.inf,
            f"housing top {top:g} mm: must not be below the beams": 0.0 <= top < np.inf,
            f"housing depth {depth:g} mm: must be positive, down from the beams": (
                0.0 < depth < np.inf
            ),
            f"retract height {retract:g} mm: the tip passes over the housing there, it must be "
            f"above the housing top, {top:g} mm": top < retract < np.inf,
            f"housing reach {reach:g} mm: must be more than the opening radius, {opening:g} mm": (
                reach > opening
            ),
        }
        if wrong := [words for words, kept in needed.items() if not kept]:
            raise InputError("; ".join(wrong))

    def opening_holds(self, p_laser: Array) -> bool:
        """Whether a point (3,) is in the opening."""
        across = np.hypot(p_laser[0], p_laser[1])
        return bool(across < self.clear_radius_m and self.floor_m < p_laser[2] < self.top_m)

    def cut_by(self, start: Array, end: Array, radius_m: float) -> Array:
        """How far capsules cut into the housing (m,), m; 0 where they are clear of it.

        ``start``, ``end`` (m, 3): ends of their axes, laser frame. At the edge of the opening
        what is round counts as square: no cut is overlooked.
        """
        swapped = start[:, 2:] > end[:, 2:]
        low, high = np.where(swapped, end, start), np.where(swapped, start, end)
        brim = self.top_m + radius_m
        rise = np.maximum(high[:, 2] - low[:, 2], 1e-300)
        share = np.clip((brim - low[:, 2]) / rise, 0.0, 1.0)[:, None]
        cut = low + share * (high - low)
        # The distance from z is convex along the axis: it is largest at an end of what is below.
        widest = np.maximum(np.hypot(low[:, 0], low[:, 1]), np.hypot(cut[:, 0], cut[:, 1]))
        wall = self.clear_radius_m - radius_m - widest
        open_space = np.maximum(wall, low[:, 2] - brim)
        above_floor = low[:, 2] - radius_m - self.floor_m
        free = np.maximum(np.minimum(open_space, above_floor), self._beyond(start, end) - radius_m)
        return np.asarray(np.maximum(-free, 0.0))

    def _beyond(self, start: Array, end: Array) -> Array:
        """How far beyond the housing's reach lines (m,) pass z, m."""
        a, along = start[:, :2], end[:, :2] - start[:, :2]
        length = np.maximum(np.sum(along**2, axis=1), 1e-300)
        share = np.clip(-np.sum(a * along, axis=1) / length, 0.0, 1.0)
        nearest = a + share[:, None] * along
        return np.asarray(np.hypot(nearest[:, 0], nearest[:, 1]) - self.reach_m)


@dataclass(frozen=True, eq=False)
class ToolBody:
    """A tool as two capsules, along its axis from the tip and on to the flange, and the flange.

    Attributes
    ----------
    T_flange_tool : (4, 4) tip, and axis from flange to tip along z.
    length_m, radius_m : of the part along the axis; the rest of the tool has this radius too.
    flange_radius_m : of a ball around the flange's origin.
    """

    T_flange_tool: Array
    length_m: float
    radius_m: float
    flange_radius_m: float

    def __post_init__(self) -> None:
        sizes = {
            "tool length": self.length_m,
            "tool radius": self.radius_m,
            "flange radius": self.flange_radius_m,
        }
        for name, size in sizes.items():
            if not 0.0 < size < np.inf:
                raise InputError(f"{name} {1e3 * size:g} mm: must be positive and finite")

    @property
    def p_tip(self) -> Array:
        """(3,) flange frame."""
        return np.asarray(self.T_flange_tool[:3, 3])

    @property
    def corners(self) -> Array:
        """Tip, upper end of the axis, flange (3, 3), flange frame."""
        upper = self.p_tip - self.length_m * self.T_flange_tool[:3, 2]
        return np.stack([self.p_tip, upper, np.zeros(3)])

    def cuts(self, housing: Housing, p_laser: Array, margin_m: float) -> dict[str, Array]:
        """How far each part, grown by a margin, cuts into the housing (m,), m.

        ``p_laser`` (m, 3, 3): the corners' places.
        """
        tip, upper, flange = np.swapaxes(p_laser, 0, 1)
        radius = self.radius_m + margin_m
        return {
            "the tool": housing.cut_by(tip, upper, radius),
            "the tool's upper part": housing.cut_by(upper, flange, radius),
            "the flange": housing.cut_by(flange, flange, self.flange_radius_m + margin_m),
        }


# ---- settings of a driven tool measurement ------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DrivingConfig:
    """What a driven measurement may do.

    Attributes
    ----------
    tool_length_m, tool_radius_m, flange_radius_m : see `ToolBody`.
    deviation_m, deviation_rad : largest distance of the tip, and of a turning joint, from the plan.
    silence_s : joint states may pause for so long while the robot moves.
    late_s : the robot lags at most so far behind its plan.
    armed_s : without a run it disarms after so long.
    """

    housing: Housing
    tool_length_m: float
    tool_radius_m: float
    flange_radius_m: float
    limits: MotionLimits = field(default_factory=MotionLimits)
    deviation_m: float = 2e-3
    deviation_rad: float = float(np.radians(0.5))
    silence_s: float = 0.1
    late_s: float = 0.15
    armed_s: float = 60.0
