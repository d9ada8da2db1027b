# SPDX-License-Identifier: Apache-2.0
"""From the start of each executable to the first answer of its services.

Needs rclpy, which the other benchmarks' venv has not: ``start_times`` runs this file in the venv
of the nodes, as ``tools/with_ros python -m bench.startup`` does.
"""

import compileall
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench.tables import Goal, Table

ROOT = Path(__file__).resolve().parents[1]
# Of the workspace that is sourced; else of the one that make has built.
MADE = ROOT / "install" / "robocal_ros"
SOURCED = (Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":"))
PREFIX = next((p for p in SOURCED if (p / "lib" / "robocal_ros").is_dir()), MADE)
EXECUTABLES = PREFIX / "lib" / "robocal_ros"
SIX = "[0.0, -90.0, 90.0, 0.0, 90.0, 0.0]"
ROBOT = ("-p", "robot:=ur10")
LASER = ROOT / "config" / "cells" / "kr150_laser.yaml"
NODES: dict[str, tuple[str, ...]] = {  # with the parameters that they do not start without
    "thermal_node": ROBOT,
    "hand_eye_node": ROBOT,
    "joint_correction_node": ROBOT,
    "maintenance_node": (*ROBOT, "-p", f"home_deg:={SIX}"),
    "recorder_node": (),
    "replay_node": ("-p", "bag:={bag}"),
    "cell_sim_node": (),
    "tcf_node": ("-p", "robot:=kr150_r3100", "-p", f"laser:={LASER}"),
    "adapter_node": ("-p", "target_frame:=robocal_sphere"),
    "panel_node": (),
    "sharing_node": (),
}
PROMISED_MEDIAN_S = 1.2
ROUNDS = 7
GIVE_UP_S, ASK_AGAIN_S = 20.0, 1.0
BARE = "import rclpy; rclpy.init(); n = rclpy.create_node('bare'); rclpy.spin(n)"


def tables() -> Sequence[Table]:
    """All tables of this module; none where no nodes are installed."""
    if EXECUTABLES.is_dir():
        return [start_times()]
    print("no nodes in install/ (run `make setup`): their start is left out")
    return []


def start_times() -> Table:
    """Seconds to the first answer, with no parameter file and compiled kernels in the cache."""
    table = Table(
        "startup",
        "Start of the executables: first service answered, s",
        ("executable", "median", "longest", "promised median"),
        f"{ROUNDS} starts each; in the first row a node of rclpy alone. The promise is of the "
        "median: one start among them may take longer.",
    )
    done = subprocess.run(
        [ROOT / "tools" / "with_ros", "python", "-m", "bench.startup"],
        cwd=ROOT,
        env=os.environ | {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    for name, times in json.loads(done.stdout).items():
        middle = statistics.median(times)
        table.add(name, middle, max(times), Goal(middle, PROMISED_MEDIAN_S))
    return table


def measure() -> dict[str, list[float]]:
    """Start times by executable, taking turns."""
    compileall.compile_dir(ROOT / "robocal_ros", quiet=1)  # as an installation does
    with tempfile.TemporaryDirectory() as folder:
        bag = _bag(Path(folder))
        commands = {"bare rclpy node": [sys.executable, "-c", BARE]}
        for name, given in NODES.items():
            parameters = [text.format(bag=bag) for text in given]
            commands[name] = [str(EXECUTABLES / name), "--ros-args", *parameters]
        found: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(ROUNDS):
            for name, command in commands.items():
                os.environ["ROBOCAL_STATE"] = f"{folder}/{name}"  # their robots differ
                found[name].append(_first_answer(name, command))
    return found


def _first_answer(name: str, command: list[str]) -> float:
    """Start it, ask for its state until it is active (the bare node: for its parameters)."""
    import rclpy
    from lifecycle_msgs.msg import State
    from lifecycle_msgs.srv import GetState
    from rcl_interfaces.srv import ListParameters

    bare = name not in NODES
    kind, service = (
        (ListParameters, "/bare/list_parameters") if bare else (GetState, f"/{name}/get_state")
    )
    rclpy.init()
    node = rclpy.create_node("stopwatch", start_parameter_services=False)
    client = node.create_client(kind, service)
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while time.monotonic() < begin + GIVE_UP_S:
            rclpy.spin_once(node, timeout_sec=0.005)
            if not client.service_is_ready():
                continue
            future = client.call_async(kind.Request())
            rclpy.spin_until_future_complete(node, future, timeout_sec=ASK_AGAIN_S)
            answer = future.result()
            if answer is None:  # a server drops its answer to whom it has not discovered itself
                continue
            if bare or answer.current_state.id == State.PRIMARY_STATE_ACTIVE:
                return time.monotonic() - begin
        raise TimeoutError(f"{name} did not answer within {GIVE_UP_S} s")
    finally:
        process.terminate()
        try:
            process.wait(GIVE_UP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        node.destroy_node()
        rclpy.shutdown()


def _bag(folder: Path) -> Path:
    from robocal_ros.bags.bags import BagWriter

    path = folder / "one.mcap"
    with BagWriter(path) as bag:
        bag.write("/note", "std_msgs/msg/String", {"data": "one"}, 1)
    return path


if __name__ == "__main__":
    print(json.dumps(measure()))
