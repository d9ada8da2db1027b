"""The edges of a station's beams, as a tool session takes them."""

from collections.abc import Mapping

from robocal_ros.ground.errors import InputError
from robocal_ros.tool.beam_edges import BEAMS
from robocal_ros.tool.edge_samples import EdgeSample

EDGES = "beam_events"
MOST_EDGES = 1000  # of one step: more is a beam that flickers
AHEAD_NS = 1_000_000_000


class EdgeLog:
    """Edges since the run began, beam by beam in order of time."""

    def __init__(self) -> None:
        self._edges: list[EdgeSample] = []

    def add(self, sample: EdgeSample, newest_ns: dict[str, int], joints_ns: int) -> None:
        """Take an edge; ``newest_ns``: newest stamp of each beam, brought up to date.

        Raises
        ------
        InputError
            When it is not after the beam's last one, or far ahead of the joint readings: one wrong
            stamp must not blind a beam.
        """
        ahead_ns = sample.stamp_ns - joints_ns
        if joints_ns and ahead_ns > AHEAD_NS:
            raise InputError(
                f"edge at {sample.stamp_ns} ns is {ahead_ns * 1e-9:.1f} s ahead of the joint "
                "states: stamp both on one clock"
            )
        topic = f"{EDGES}/{sample.beam}"
        if sample.stamp_ns <= newest_ns.get(topic, -1):
            raise InputError(f"edge at {sample.stamp_ns} ns is not after {newest_ns[topic]} ns")
        newest_ns[topic] = sample.stamp_ns
        if len(self._edges) < MOST_EDGES:
            self._edges.append(sample)

    def take(self, from_ns: int, marks: Mapping[str, int]) -> list[EdgeSample]:
        """Edges after a stamp, up to the marks; they are not given again."""
        found = [
            sample
            for sample in self._edges
            if from_ns < sample.stamp_ns <= marks.get(f"{EDGES}/{sample.beam}", -1)
        ]
        self._edges = [sample for sample in self._edges if sample not in found]
        return sorted(found, key=lambda sample: (sample.stamp_ns, BEAMS.index(sample.beam)))

    def clear(self) -> None:
        """Forget all."""
        self._edges.clear()
