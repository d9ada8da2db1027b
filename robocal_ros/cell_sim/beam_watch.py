"""The edges at a beam station while a robot moves, found only where there can be any."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import BeamStation, Poses, RoundTool
from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.edges import BeamEdge

Array = NDArray[np.float64]

ROOM_M = 0.15  # beams, bends and the way within a tick
DETOUR = 1.5  # a way within a tick is at most so much longer than the straight one
SLACK_M = 1e-5


class BeamWatch:
    """Looks at one tick after the other, many at once."""

    def __init__(self, arm: SerialArm, draws: Draws) -> None:
        self._arm, self._draws = arm, draws

    def edges(
        self,
        station: BeamStation,
        tool: RoundTool,
        ticks: NDArray[np.int64],
        time_s: Array,
        q: Array,
        joints: Callable[[Array], Array],
        flange: Callable[[Array], Array],
    ) -> list[BeamEdge]:
        """Edges between ticks (k,) at times (k,), in the order of the ticks.

        ``q`` (k, n): joints there; ``joints`` and ``flange``: joints (m, n) and true T_base_flange
        (m, 4, 4) at times (m,).
        """
        first, last = self._near(station, tool, q)
        if last - first < 1:
            return []
        inside = slice(first, last + 1)
        T = flange(time_s[inside])
        found: list[BeamEdge] = []
        for i in np.flatnonzero(_may_cross(station, tool, T)):
            at = first + i
            window = float(time_s[at]), float(time_s[at + 1])
            poses = self._between(window, T[i : i + 2], joints)
            rng = self._draws.of(Stream.EDGES, int(ticks[at]))
            found += station.edges(tool, poses, window, rng)
        return found

    def _near(self, station: BeamStation, tool: RoundTool, q: Array) -> tuple[int, int]:
        """First and last tick with the tool near the beams; last < first where there is none."""
        middle = np.array([0.5 * (beam.start + beam.end) for beam in station.beams])
        tip = (self._arm.fk(q) @ tool.T_flange_tool[:, 3])[:, :3]
        away = np.min(np.linalg.norm(tip[:, None] - middle, axis=2), axis=1)
        near = away < np.max(tool.height) + ROOM_M
        places = np.flatnonzero(near)
        return (int(places[0]), int(places[-1])) if len(places) else (0, -1)

    def _between(
        self, window: tuple[float, float], T: Array, joints: Callable[[Array], Array]
    ) -> Poses:
        """The true flange within a tick: the nominal one, off by what changes little in a tick."""
        begin, end = window
        off = T @ np.linalg.inv(self._arm.fk(joints(np.array(window))))

        def poses(time_s: Array) -> Array:
            share = ((time_s - begin) / (end - begin))[:, None, None]
            return np.asarray((off[0] + share * (off[1] - off[0])) @ self._arm.fk(joints(time_s)))

        return poses


def _may_cross(station: BeamStation, tool: RoundTool, T: Array) -> NDArray[np.bool_]:
    """Between which of flange poses (k + 1, 4, 4) an edge can lie (k,).

    No surface comes nearer to a beam than the tool moves.
    """
    T_tool = T @ tool.T_flange_tool
    ends = (
        T_tool[:, None, :3, 3] - np.array([0.0, tool.height[-1]])[:, None] * T_tool[:, None, :3, 2]
    )
    way = np.max(np.linalg.norm(np.diff(ends, axis=0), axis=2), axis=1)
    may = np.zeros(len(way), dtype=np.bool_)
    for beam in station.beams:
        clear = beam.clearance(tool, T)
        pair = np.stack([clear[:-1], clear[1:]])
        room = DETOUR * way + SLACK_M
        may |= (np.min(pair, axis=0) - room < max(beam.levels)) & (
            np.max(pair, axis=0) + room > min(beam.levels)
        )
    return may
