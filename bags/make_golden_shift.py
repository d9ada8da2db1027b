# SPDX-License-Identifier: Apache-2.0
"""Make the golden shift: ``python bags/make_golden_shift.py``, ``out/golden_shift.mcap``.

Simulated: eight hours of a KR 150 that warms up at its work and keeps itself accurate in 96 gaps,
with a break at noon, a collision at 10:40 and a sphere sensor that is knocked at 13:15; all in
closed loop (`bench.closed_loop`). The bag holds:

- ``joint_states``, ``motor_temperatures``, ``sphere_cloud``, ``reference_sphere_center``,
  ``beam_events``: what the cell says;
- ``/thermal_node/session_events``, ``/tcf_node/session_events``: what the sessions made of it, for
  ``robocal replay``; ``/maintenance_node/session_events``: what was run and decided;
- ``/accuracy_state``: what the line reads;
- ``/truth/state``: for judging only: warmth, faults, true error of the tool at the working poses.

``--excerpt`` makes ``golden_excerpt.mcap`` beside this script instead: ten minutes of it, with the
collision, two thermal cycles, the check that sees the bent tool and its measurement.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from session_events import EventLog

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # for the bench

from bench.cell_samples import Sample  # noqa: E402
from bench.closed_loop import setting  # noqa: E402
from bench.closed_loop.judging import Figures  # noqa: E402
from bench.closed_loop.plant import PASS_S, WORK, Plant  # noqa: E402
from bench.closed_loop.shift import GOLDEN, at, run_shift  # noqa: E402
from robocal_ros.bags.bag_writer import BagWriter, ros_time  # noqa: E402
from robocal_ros.cell_sim.cell import Happened  # noqa: E402
from robocal_ros.ground.samples import (  # noqa: E402
    JOINTS,
    REFERENCE_SPHERE,
    SPHERE_CLOUD,
    TEMPERATURES,
    JointSample,
    PointSample,
    TemperatureSample,
)
from robocal_ros.session.events import MEASURE_TOOL, Command, Outcome  # noqa: E402
from robocal_ros.thermal import session as thermal_session  # noqa: E402
from robocal_ros.tool import session  # noqa: E402
from robocal_ros.tool.edges import (  # noqa: E402
    BREAK,
    EDGES,
    RESTORE,
    EdgeSample,
)

FULL = ROOT / "out" / "golden_shift.mcap"
EXCERPT = Path(__file__).with_name("golden_excerpt.mcap")
SEED = 1
CHUNK_BYTES = 4 << 20  # large, as the excerpt is kept in the repository: nobody kills its writer
WINDOW_S = (at(10, 38), at(10, 48))  # of the excerpt
AHEAD_S = 2.0 * PASS_S  # the sessions hear every reading from so long before it on
NODES = {"thermal": "thermal_node", "tool": "tcf_node", "maintenance": "maintenance_node"}
THERMAL = {kind: f"/{kind}" for kind in (JOINTS, SPHERE_CLOUD, REFERENCE_SPHERE, TEMPERATURES)}
TOOL = {kind: f"/{kind}" for kind in (JOINTS, EDGES)}
ACCURACY, TRUTH = "/accuracy_state", "/truth/state"
CLOUD_FIELDS = [
    {"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")
]


class Recorder:
    """Writes what the plant hears and what its sessions do, within a window of the shift."""

    def __init__(self, bag: BagWriter, window_s: tuple[float, float]) -> None:
        self._bag, self._window_s = bag, window_s
        self._logs = {
            node: EventLog(bag, f"/{name}/session_events") for node, name in NODES.items()
        }
        self._plant: Plant | None = None
        self._shown: dict[str, Any] = {}
        self._second = -1

    def watch(self, plant: Plant) -> None:
        """Take the plant, before its commissioning."""
        self._plant, plant.heard = plant, self.heard

    @property
    def plant(self) -> Plant:
        """The one that is watched."""
        if self._plant is None:
            raise ValueError("watch a plant first")
        return self._plant

    def _inside(self, room_s: float = 0.0) -> bool:
        begin_s, end_s = self._window_s
        since = self.plant.now_s - self.plant.begin_s
        return begin_s - room_s <= since < end_s

    def heard(self, came: Happened, samples: Sequence[Sample]) -> None:
        """Write what came, in the order of its stamps."""
        self.plant.every_reading = self._inside(AHEAD_S)
        if not self._inside():
            return
        self._show_in_force()
        shots = {self.plant.samples.ns(shot.time_s): shot.points for shot in came.shots}
        for sample in samples:
            self._write_sample(sample, shots)
        if int(self.plant.now_s) != self._second:
            self._second = int(self.plant.now_s)
            told = {"data": json.dumps(self._truth())}
            self._write(TRUTH, "std_msgs/msg/String", told, self.plant.clock.now_ns)
            self._write_accuracy()

    def record(self, node: str, command: Command, outcome: Outcome | None) -> None:
        """Write what a session was told, and what came of it."""
        if not self._inside():
            return
        now_ns = self.plant.clock.now_ns
        if command.stamp_ns is None:  # the maintenance has no clock
            command = replace(command, stamp_ns=now_ns)
        if command.name == MEASURE_TOOL:  # a run goes by the thermal model of its begin
            self._show_in_force()
        self._logs[node].write(command, outcome, now_ns)
        self._show_in_force()

    def _show_in_force(self) -> None:
        """Write the sessions' configurations when what is in force has changed, as nodes do."""
        suite = self.plant.suite
        if suite is None:
            return
        thermal, tool = suite.thermal, suite.tool
        follower, current = thermal.follower, tool.current
        cycles = 0 if follower is None else follower.state.cycles
        shown = {
            "thermal": (thermal.in_force.revision, thermal.current.reference_id, cycles),
            "tool": (current.head.revision, current.thermal.revision, current.healthy.revision),
        }
        made = {
            "thermal": lambda: thermal_session.configuration(thermal, THERMAL),
            "tool": lambda: session.configuration(tool, TOOL),
        }
        for node, state in shown.items():
            if self._shown.get(node) != state:
                self._shown[node] = state
                self._logs[node].write(made[node](), None, self.plant.clock.now_ns)

    def _truth(self) -> dict[str, Any]:
        cell = self.plant.cell
        told = {
            "simulated": True,
            "cell_time_s": cell.now_s,
            "faults": dict(cell.faults.sizes),
            "motor_k": cell.warmth.motor.tolist(),
            "link_k": cell.warmth.link.tolist(),
            "T_flange_tool": cell.tool.T_flange_tool.tolist(),
        }
        for name, q in (("", WORK), ("commanded_", self.plant.commanded)):
            if q is not None:
                found = Figures.of(cell.tcp_error(q))
                told[f"{name}tcp_error_rms_m"] = found.rms_m
                told[f"{name}tcp_error_p95_m"] = found.p95_m
                told[f"{name}within_share"] = found.within
        return told

    def _write_accuracy(self) -> None:
        suite = self.plant.suite
        if suite is None:
            return
        message = {
            "header": {"stamp": ros_time(self.plant.clock.now_ns), "frame_id": "base"},
            "robot": suite.thermal.nominal.name,
            "serial": setting.SERIAL,
            **suite.accuracy().document(setting.TOLERANCE_M),
        }
        self._write(ACCURACY, "robocal_msgs/msg/AccuracyState", message, self.plant.clock.now_ns)

    def _write_sample(self, sample: Sample, shots: Mapping[int, np.ndarray]) -> None:
        header: dict[str, Any] = {"stamp": ros_time(sample.stamp_ns)}
        match sample:
            case JointSample():
                message = {
                    "header": header,
                    "name": list(sample.names),
                    "position": sample.position,
                }
                self._write(f"/{JOINTS}", "sensor_msgs/msg/JointState", message, sample.stamp_ns)
            case EdgeSample():
                edge = {
                    "header": header | {"frame_id": sample.station},
                    "beam": sample.beam,
                    "edge": BREAK if sample.blocked else RESTORE,
                    "stamp_sigma_s": sample.sigma_s,
                }
                self._write(f"/{EDGES}", "robocal_msgs/msg/BeamEvent", edge, sample.stamp_ns)
            case TemperatureSample():
                told = {
                    "header": header | {"frame_id": sample.joint},
                    "temperature": sample.celsius,
                }
                self._write(
                    f"/{TEMPERATURES}", "sensor_msgs/msg/Temperature", told, sample.stamp_ns
                )
            case PointSample():
                header["frame_id"] = f"{sample.frame}/{sample.target}"
                self._write_sphere(sample, header, shots)

    def _write_sphere(
        self, sample: PointSample, header: dict[str, Any], shots: Mapping[int, np.ndarray]
    ) -> None:
        if sample.topic == REFERENCE_SPHERE:
            x, y, z = sample.position_m.tolist()
            message = {"header": header, "point": {"x": x, "y": y, "z": z}}
            self._write(
                f"/{REFERENCE_SPHERE}", "geometry_msgs/msg/PointStamped", message, sample.stamp_ns
            )
            return
        data = shots[sample.stamp_ns].astype("<f4")
        cloud = {
            "header": header,
            "height": 1,
            "width": len(data),
            "fields": CLOUD_FIELDS,
            "is_bigendian": False,
            "point_step": 12,
            "row_step": 12 * len(data),
            "data": np.frombuffer(data.tobytes(), dtype=np.uint8),
            "is_dense": True,
        }
        self._write(f"/{SPHERE_CLOUD}", "sensor_msgs/msg/PointCloud2", cloud, sample.stamp_ns)

    def _write(self, topic: str, kind: str, message: Mapping[str, Any], at_ns: int) -> None:
        self._bag.write(topic, kind, message, at_ns)


@contextmanager
def recorder(path: Path, window_s: tuple[float, float]) -> Iterator[Recorder]:
    """Writes a bag of a window of a shift, s from its begin."""
    latched = [f"/{name}/session_events" for name in NODES.values()]
    with BagWriter(path, latched=latched, chunk_bytes=CHUNK_BYTES) as bag:
        yield Recorder(bag, window_s)


def main() -> None:
    """Write one of both."""
    parser = argparse.ArgumentParser(description="make the golden shift, simulated")
    parser.add_argument("--excerpt", action="store_true", help="ten minutes, beside this script")
    path, plan, window_s = FULL, GOLDEN, (-np.inf, np.inf)
    if parser.parse_args().excerpt:
        hours = np.ceil(WINDOW_S[1] / GOLDEN.every_s) * GOLDEN.every_s / 3600.0
        path, plan, window_s = EXCERPT, replace(GOLDEN, hours=float(hours)), WINDOW_S
    path.parent.mkdir(exist_ok=True)
    with recorder(path, window_s) as writes:
        run_shift(plan, SEED, record=writes.record, watch=writes.watch)
    print(f"{path.name} of {setting.SERIAL}: {path.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
