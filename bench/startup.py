# SPDX-License-Identifier: Apache-2.0
"""From the start of each executable to the first answer of its services.

Needs rclpy, which the other benchmarks' venv has not: ``start_times`` runs this file in the venv
of the nodes, as ``tools/with_ros python -m bench.startup`` does.
"""

import compileall
import contextlib
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.tables import Goal, Table

ROOT = Path(__file__).resolve().parents[1]
# Of the workspace that is sourced; else of the one that make has built.
MADE = ROOT / "install" / "robocal_ros"
SOURCED = (Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":"))
PREFIX = next((p for p in SOURCED if (p / "lib" / "robocal_ros").is_dir()), MADE)
EXECUTABLES = PREFIX / "lib" / "robocal_ros"
SIX = "[0.0, -90.0, 90.0, 0.0, 90.0, 0.0]"
ROBOT, KR150 = ("-p", "robot:=ur10"), ("-p", "robot:=kr150_r3100")
LASER = ROOT / "config" / "cells" / "kr150_laser.yaml"
NODES: dict[str, tuple[str, ...]] = {  # with the parameters that they do not start without
    "thermal_node": ROBOT,
    "hand_eye_node": ROBOT,
    "joint_correction_node": ROBOT,
    "maintenance_node": (*ROBOT, "-p", f"home_deg:={SIX}"),
    "recorder_node": (),
    "replay_node": ("-p", "bag:={bag}"),
    "cell_sim_node": (),
    "tcf_node": (*KR150, "-p", f"laser:={LASER}"),
    "fixture_node": (*KR150, "-p", "fixture_file:={folder}/plate.yaml"),
    "adapter_node": ("-p", "target_frame:=robocal_sphere"),
    "panel_node": (),
    "plc_bridge_node": ("-p", "security_dir:={folder}", "-p", "port:={port}"),
    "sharing_node": (),
}
PROMISED_MEDIAN_S = 1.2
ROUNDS = 7
GIVE_UP_S, ASK_AGAIN_S = 20.0, 1.0
BARE, DOOR = "bare rclpy node", "plc_bridge_node: a PLC may connect"
SPINS = "import rclpy; rclpy.init(); n = rclpy.create_node('bare'); rclpy.spin(n)"


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
        "median: one start among them may take longer. In the last row asyncua builds the "
        "standard's own nodes, beside the node, which works meanwhile.",
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
        promise = "none" if name == DOOR else Goal(middle, PROMISED_MEDIAN_S)
        table.add(name, middle, max(times), promise)
    return table


def measure() -> dict[str, list[float]]:
    """Start times by executable, taking turns."""
    from bench.live.opc_ua import free_port, security_folder
    from robocal_ros.cell_sim.fixture import PLATE
    from robocal_ros.fixture.files import fixture_document

    compileall.compile_dir(ROOT / "robocal_ros", quiet=1)  # as an installation does
    with tempfile.TemporaryDirectory() as folder:
        made = {"folder": folder, "bag": _bag(Path(folder)), "port": free_port()}
        security_folder(Path(folder))
        (Path(folder) / "plate.yaml").write_text(json.dumps(fixture_document(PLATE)))
        commands = {BARE: [sys.executable, "-c", SPINS]}
        for name, given in NODES.items():
            parameters = [text.format(**made) for text in given]
            commands[name] = [str(EXECUTABLES / name), "--ros-args", *parameters]
        found: dict[str, list[float]] = {name: [] for name in (*commands, DOOR)}
        for _ in range(ROUNDS):
            for name, command in commands.items():
                os.environ["ROBOCAL_STATE"] = f"{folder}/{name}"  # their robots differ
                found[name].append(_first_answer(name, command))
            found[DOOR].append(_first_connection(commands["plc_bridge_node"], int(made["port"])))
    return found


@contextlib.contextmanager
def _started(command: list[str]) -> Iterator[float]:
    """A process that runs meanwhile; gives the time of its start."""
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield begin
    finally:
        process.terminate()
        try:
            process.wait(GIVE_UP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _first_connection(command: list[str], port: int) -> float:
    """Start it, knock until it takes a connection."""
    with _started(command) as begin:
        while time.monotonic() < begin + GIVE_UP_S:
            with contextlib.suppress(OSError), socket.create_connection(("localhost", port), 1.0):
                return time.monotonic() - begin
            time.sleep(0.01)
        raise TimeoutError(f"nobody took a connection within {GIVE_UP_S} s")


def _first_answer(name: str, command: list[str]) -> float:
    """Start it, ask for its state until it is active (the bare node: for its parameters)."""
    import rclpy
    from lifecycle_msgs.msg import State
    from lifecycle_msgs.srv import GetState
    from rcl_interfaces.srv import ListParameters

    bare = name == BARE
    kind, service = (
        (ListParameters, "/bare/list_parameters") if bare else (GetState, f"/{name}/get_state")
    )
    rclpy.init()
    node = rclpy.create_node("stopwatch", start_parameter_services=False)
    client = node.create_client(kind, service)
    try:
        with _started(command) as begin:
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
