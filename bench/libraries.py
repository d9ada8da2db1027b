# SPDX-License-Identifier: Apache-2.0
"""What other libraries would take in the place of our own code, for docs/sources.md.

Processor time, the least of five runs; a library that is not installed is left out:

    .venv/bin/pip install --target out/libs --no-deps msgspec ruckig rosbags-image
    tools/with_ros env PYTHONPATH=out/libs .venv/bin/python -m bench.libraries
"""

import contextlib
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from robocal_ros.bags.bags import BagReader
from robocal_ros.ground.samples import JOINTS, Measurements, image_array
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import read_measurements, write_measurements
from robocal_ros.motion.plan import MotionLimits, Ride, stop

BAG = Path(__file__).resolve().parent.parent / "bags" / "golden_excerpt.mcap"
RUNS, ROWS = 5, 6000


def least_s(act: Callable[[], object]) -> float:
    """Processor time of the fastest of some runs."""
    taken = []
    for _ in range(RUNS):
        begun = time.process_time()
        act()
        taken.append(time.process_time() - begun)
    return min(taken)


def here(*names: str) -> bool:
    """Whether all of these are installed; else it is said."""
    with contextlib.suppress(ModuleNotFoundError):
        if all(importlib.util.find_spec(name) for name in names):
            return True
    print(f"  {', '.join(names)}: not installed")
    return False


def reading() -> None:
    """A bag's joint states: by rosbags, and in place in the serialized buffer."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store, counts = get_typestore(Stores.ROS2_JAZZY), dict[str, int]()

    def by_rosbags() -> None:
        with AnyReader([BAG], default_typestore=store) as bag:
            own = [c for c in bag.connections if c.topic.endswith(JOINTS)]
            counts["rosbags"] = sum(
                len(bag.deserialize(data, c.msgtype).position) > 0
                for c, _, data in bag.messages(own)
            )

    def ours() -> None:
        with BagReader(BAG) as bag:
            topics = [topic for topic in bag.info.topics if topic.endswith(JOINTS)]
            read = (m.message for m in bag.messages(topics, blocks=topics))
            counts["ours"] = sum(len(m) if hasattr(m, "__len__") else 1 for m in read)

    for name, act in (("rosbags", by_rosbags), ("ours", ours)):
        seconds = least_s(act)
        rate = counts[name] / seconds
        print(f"  {name}: {counts[name]} joint states in {seconds:.3f} s, {rate:,.0f} a second")


def tables() -> None:
    """A table of measurements: NumPy's readers, which check nothing, beside ours, which does."""
    arm, rng = load_robot("ur10"), np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (ROWS, arm.n))
    names = tuple(map(str, range(ROWS)))
    data = Measurements(q=q, position=arm.fk(q)[:, :3, 3], target=("tool",) * ROWS, sample=names)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        write_measurements(path, data, arm)
        for name, act in (
            ("ours", lambda: read_measurements(path, arm)),
            ("numpy.genfromtxt", lambda: np.genfromtxt(path, delimiter=",", names=True)),
            ("numpy.loadtxt", lambda: np.loadtxt(path, delimiter=",", skiprows=1, dtype=str)),
        ):
            print(f"  {name}: {least_s(act):.3f} s for {ROWS} rows")


def documents() -> None:
    """A data set of 20 profiles as JSON."""
    rng = np.random.default_rng(0)
    samples = [{"handle": i, "values": rng.normal(size=(1280, 2)).tolist()} for i in range(20)]
    text = json.dumps({"samples": samples})
    print(f"  json: to text {least_s(lambda: json.dumps(samples)):.4f} s, "
          f"back {least_s(lambda: json.loads(text)):.4f} s, {len(text) / 1e6:.2f} MB")  # fmt: skip
    if here("msgspec"):
        import msgspec

        to_s = least_s(lambda: msgspec.json.encode(samples))
        back_s = least_s(lambda: msgspec.json.decode(text))
        print(f"  msgspec: to text {to_s:.4f} s, back {back_s:.4f} s")
        same = msgspec.json.encode(samples).decode() == json.dumps(samples, separators=(",", ":"))
        print(f"  the same text: {same}")


def starts() -> None:
    """What a process pays for an import, beside the command's own start."""
    for code in ("pass", "import jinja2", "import argcomplete", "import msgspec",
                 "import robocal_ros.cli.main"):  # fmt: skip
        name = code.removeprefix("import ")
        if name != "pass" and not here(name):
            continue
        count = "import resource, sys; print(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]))"
        taken = [
            float(subprocess.run([sys.executable, "-c", f"{code}\n{count}"], check=True,
                                 capture_output=True, text=True).stdout)
            for _ in range(RUNS)
        ]  # fmt: skip
        print(f"  {code}: {1e3 * min(taken):.0f} ms")


def motions() -> None:
    """A stop from full speed, and a way of joints from rest to rest."""
    arm = load_robot("ur10")
    limits, q = MotionLimits(), np.zeros(arm.n)
    qd = np.array([1.0, -0.6, 0.3, 0.0, 0.1, -1.0])
    most, push, brake = limits.of_joints(arm)
    ours = stop(arm, limits, q, qd)
    each_s = least_s(lambda: [stop(arm, limits, q, qd) for _ in range(100)]) / 100
    print(f"  ours: stop of {ours.time_s[-1]:.3f} s, along the motion; {1e6 * each_s:.0f} us")
    ride = Ride.within(1.0, float(most.min()), float(push.min()))
    print(f"  ours: 1 rad in {ride.times()[-1]:.3f} s, acceleration without a step")
    if not here("ruckig"):
        return
    from ruckig import ControlInterface, InputParameter, Result, Ruckig, Synchronization, Trajectory

    def planned(jerk: float, velocity: bool) -> tuple[Any, Any]:
        asked, found = InputParameter(arm.n), Trajectory(arm.n)
        asked.synchronization = Synchronization.Phase
        asked.current_position, asked.current_velocity = q.tolist(), [0.0] * arm.n
        asked.current_acceleration = [0.0] * arm.n
        asked.target_position = [1.0] + [0.0] * (arm.n - 1)
        asked.max_velocity, asked.max_acceleration = most.tolist(), push.tolist()
        asked.max_jerk = [jerk] * arm.n
        if velocity:
            asked.control_interface = ControlInterface.Velocity
            asked.current_velocity, asked.max_acceleration = qd.tolist(), brake.tolist()
            asked.target_velocity = [0.0] * arm.n
        result = Ruckig(arm.n).calculate(asked, found)
        if result not in (Result.Working, Result.Finished):
            raise RuntimeError(str(result))
        return found, asked

    for jerk in (np.inf, 100.0):
        halt, _ = planned(jerk, True)
        spent = least_s(lambda jerk=jerk: [planned(jerk, True) for _ in range(100)]) / 100
        way, _ = planned(jerk, False)
        ends = np.array(halt.at_time(halt.duration)[0])
        off = float(np.max(np.abs(ends - qd * (ends @ qd) / (qd @ qd))))
        print(
            f"  ruckig, jerk {jerk:g}: stop of {halt.duration:.3f} s, {1e3 * off:.1f} mrad beside "
            f"the motion; {1e6 * spent:.0f} us; 1 rad in {way.duration:.3f} s"
        )


def images() -> None:
    """A colour image as grey pixels."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    message = SimpleNamespace(
        width=1920, height=1080, step=5760, encoding="rgb8", is_bigendian=0, data=pixels.ravel()
    )
    print(f"  ours: {1e3 * least_s(lambda: image_array(message)):.1f} ms")
    if here("rosbags.image"):
        from rosbags.image import image_to_cvimage

        each_s = least_s(lambda: image_to_cvimage(message, "mono8"))
        print(f"  rosbags-image: {1e3 * each_s:.1f} ms")


if __name__ == "__main__":
    for act in (reading, tables, documents, starts, motions, images):
        print(f"{act.__name__}: {(act.__doc__ or '').strip()}")
        act()
