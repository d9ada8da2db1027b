# SPDX-License-Identifier: Apache-2.0
"""What joint_correction_node adds to a stream of joint messages, beside a bare relay of rclpy.

Needs rclpy, which the other benchmarks' venv has not: ``tables`` runs this file in the venv of the
nodes, as ``tools/with_ros python -m bench.correction_stream`` does (``--seconds 4`` for a look).
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from array import array
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.startup import EXECUTABLES
from bench.tables import Goal, Table
from robocal_ros.ground.frames import Array

if TYPE_CHECKING:
    from bench.stream_probe import Probe, Stream

ROOT = Path(__file__).parents[1]
RATES_HZ = (500, 1000)
SECONDS = 60.0  # of each stream through the node, and through the relay that it is judged by
BLOCK_S = 1.0  # each in its turn: a machine may change its speed within seconds
OTHERS_IN = 5  # rounds; the other relays are there to be looked at
DRIFT_M = 0.5e-3
POINTS, PATHS, PATH_S = 10_000, 10, 3.0
STEP_NS = 200_000  # between two of them
OWN_HZ, BLOCK, BLOCKS = 500, 100, 50
JUDGED = NODE, RELAY = "corrected", "relayed"
BYTES, SINGLE = "relayed_bytes", "relayed_single"
IN_WORDS = {
    NODE: "joint_correction_node",
    RELAY: "bare relay, EventsExecutor",
    BYTES: "bare relay of bytes, EventsExecutor",
    SINGLE: "bare relay, SingleThreadedExecutor",
}
QUANTILES = (0.5, 0.99, 0.999)
MOST_OF_MEDIAN = 1.10
FIGURES = {"p50": "median", "p99": "99 %", "cpu_us": "CPU time per message"}


def tables(seconds: float = SECONDS) -> Sequence[Table]:
    """The streams and whole trajectories, in the venv of the nodes; none where these are not."""
    if not EXECUTABLES.is_dir():
        return []
    command = [ROOT / "tools" / "with_ros", "python", "-m", "bench.correction_stream", "--json"]
    done = subprocess.run(
        [*command, "--seconds", str(seconds)],
        cwd=ROOT,
        env=os.environ | {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return in_tables(json.loads(done.stdout))


def in_tables(found: dict[str, Any]) -> Sequence[Table]:
    """Distributions, their comparison with the goals, whole trajectories."""
    streams = Table(
        "correction_stream",
        "Streams through joint_correction_node and through a bare relay",
        ("through", "topic", "Hz", "n", "lost", "p50, ms", "p99, ms", "p99.9, ms", "longest, ms",
         "CPU per message, µs"),
        f"Position and velocity of six joints, there and back, {BLOCK_S:g} s of each by turns (of "
        f"the other relays in one round of {OTHERS_IN}); "
        "joint_states run beside the targets. The model in force has drifted by up to "
        f"{DRIFT_M * 1e3:g} mm. CPU: of the whole process, both topics. Load of the machine in "
        f"the last minute before and after: {found['load'][0]:.2f}, {found['load'][1]:.2f}; "
        f"{os.cpu_count()} CPUs.",
    )  # fmt: skip
    beside = Table(
        "correction_beside_relay",
        "joint_correction_node beside a bare relay in the same executor",
        ("targets, Hz", "figure", "relay", "node", "node / relay", "half of the rounds", "goal"),
        "Of joint_targets, there and back, ms; CPU in µs: medians of rounds in which one block "
        "follows the other.",
    )
    for row in found["streams"]:
        figures = [row[f"p{q * 100:g}"] for q in QUANTILES]
        streams.add(
            IN_WORDS[row["through"]], row["topic"], row["rate_hz"], row["n"], row["lost"],
            *figures, row["longest"], row["cpu_us"],
        )  # fmt: skip
    for rate in sorted({row["rate_hz"] for row in found["streams"]}):
        for figure, words in FIGURES.items():
            node, relay = (_of_rounds(found["streams"], name, rate, figure) for name in JUDGED)
            least, ratio, most = np.quantile(node / relay, (0.25, 0.5, 0.75)).tolist()
            middles = (float(np.median(of)) for of in (relay, node))
            spread = f"{least:.3f} to {most:.3f}"
            goal = Goal(ratio, MOST_OF_MEDIAN) if figure == "p50" else None
            beside.add(rate, words, *middles, ratio, spread, goal)
    paths = Table(
        "correction_path",
        f"A whole trajectory of {POINTS} points, there and back",
        ("through", "sent", "lost", "goal", "median, ms", "longest, ms", "median / relay"),
        "Positions, velocities and accelerations of six joints: 1.9 MB.",
    )
    own = Table(
        "correction_own",
        "What joint_correction_node itself takes for a message",
        ("topic", "n", "refused", "callback, µs", "of it publishing, µs"),
        f"In process at {OWN_HZ} Hz, nobody subscribed: processor time, the median of blocks of "
        f"{BLOCK}. What rclpy takes to wake up and to take a message comes on top.",
    )
    for topic, figures in found["own"].items():
        own.add(topic, *figures)
    middle = {name: float(np.median(times)) for name, times in found["paths"].items() if times}
    for name, times in found["paths"].items():
        lost = PATHS - len(times)
        figures = (middle[name], max(times), middle[name] / middle[RELAY]) if times else 3 * (None,)
        paths.add(IN_WORDS[name], PATHS, lost, Goal(lost, 0), *figures)
    return [streams, beside, own, paths]


def _of_rounds(rows: list[dict[str, Any]], through: str, rate: int, figure: str) -> Array:
    """A figure of each block of the targets."""
    row = next(
        row for row in rows
        if (row["through"], row["topic"], row["rate_hz"]) == (through, "joint_targets", rate)
    )  # fmt: skip
    return np.array(row["rounds"][figure])


def measure(seconds: float) -> dict[str, Any]:
    """All of it; times in ms."""
    load = [os.getloadavg()[0]]
    with tempfile.TemporaryDirectory() as folder, _subjects(Path(folder)) as (probe, streams):
        rows = [row for rate in RATES_HZ for row in _stream(probe, streams, rate, seconds)]
        paths = _paths(probe, streams)
    load.append(os.getloadavg()[0])
    with tempfile.TemporaryDirectory() as folder:
        own = _own(folder)
    return {"load": load, "streams": rows, "paths": paths, "own": own}


def _own(state_dir: str) -> dict[str, tuple[float, ...]]:
    """Of each topic: messages, those refused, processor time of a callback and of publishing."""
    import rclpy
    from robocal_msgs.msg import KinematicModel

    from bench.stream_probe import LEAD_S, SERIAL, STATES, TARGETS, Buffer, drifted, offered, path
    from robocal_ros.correction.node import JointCorrectionNode

    given = {"robot": "kr150_r3100", "serial": SERIAL, "state_dir": state_dir}
    given["enable_on_start"] = "true"
    words = (word for name, value in given.items() for word in ("-p", f"{name}:={value}"))
    rclpy.init(args=["--ros-args", *words])
    node = JointCorrectionNode()
    try:
        node.autostart()
        arm, take = node.robot.arm, {topic: act for topic, *_, act in node._takers}
        take["kinematic_model"](offered(arm, drifted(arm, DRIFT_M), 1, KinematicModel.ACCEPTED))
        buffer, still = Buffer(arm.joint_names), np.zeros(arm.n)
        begin_s, out = time.monotonic(), node._session.output.out
        while time.monotonic() - begin_s < LEAD_S:
            take[STATES](buffer.filled(time.time_ns(), path(0.0)[0], still))
            time.sleep(1e-3)
        take[TARGETS](buffer.filled(time.time_ns(), *path(0.0)))
        begin_s, took = time.monotonic(), defaultdict[str, list[float]](list)
        due_s = begin_s
        for _ in range(BLOCKS):
            used = dict.fromkeys((STATES, TARGETS), 0.0)
            for _ in range(BLOCK):
                for topic in used:
                    due_s = max(due_s + 0.5 / OWN_HZ, time.monotonic())
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                    joints = (out, still) if topic == STATES else path(time.monotonic() - begin_s)
                    data = buffer.filled(time.time_ns(), *joints)
                    before = time.thread_time()
                    take[topic](data)
                    used[topic] += time.thread_time() - before
            for topic, cpu_s in used.items():
                before = time.thread_time()
                for _ in range(BLOCK):
                    node._outputs[topic].publish(data)
                took[f"{topic} out"].append((time.thread_time() - before) / BLOCK * 1e6)
                took[topic].append(cpu_s / BLOCK * 1e6)
        return {
            topic: (
                BLOCKS * BLOCK,
                node.inputs[topic].invalid,
                *(float(np.median(took[of])) for of in (topic, f"{topic} out")),
            )
            for topic in used
        }
    finally:
        node.close()
        rclpy.try_shutdown()


@contextlib.contextmanager
def _subjects(folder: Path) -> "Iterator[tuple[Probe, list[Stream]]]":
    """All processes with their streams, the correction in force and settled."""
    from bench.stream_probe import Probe, Stream, Subject
    from robocal_ros.kinematics.robots import load_robot

    arm = load_robot("kr150_r3100")
    relay = [sys.executable, Path(__file__).with_name("bare_relay.py")]
    node = [EXECUTABLES / "joint_correction_node", "--ros-args", "-p", "robot:=kr150_r3100"]
    given = {
        NODE: ("joint_correction_node", node),
        RELAY: ("relay", [*relay, "events"]),
        BYTES: ("relay", [*relay, "bytes"]),
        SINGLE: ("relay", [*relay, "single"]),
    }
    probe = Probe()
    subjects: list[Subject] = []
    try:
        for name, (own, command) in given.items():
            subjects.append(Subject(name, own, command, folder))
        streams = [Stream(probe, subject, arm.joint_names) for subject in subjects]
        for stream in streams:
            probe.wait(lambda s=stream: s.connected, stream.subject.name)
        _correct(probe, streams[0], arm)
        yield probe, streams
    except Exception:
        for log in folder.glob("*.log"):
            print(f"{log.stem}: {log.read_text()[-2000:]}", file=sys.stderr)
        raise
    finally:
        probe.close(*subjects)


def _correct(probe: "Probe", stream: "Stream", arm: Any) -> None:
    """Bring a drift in force; stream until what comes back is corrected by it."""
    from robocal_msgs.msg import KinematicModel

    from bench.stream_probe import drifted, offered, path
    from robocal_ros.correction.bounds import CorrectionConfig, correction_between
    from robocal_ros.correction.joint_correction import pack_model

    actual = drifted(arm, DRIFT_M)
    models = probe.model_publisher(stream.subject)
    models.publish(offered(arm, actual, 1, KinematicModel.ACCEPTED))
    probe.enable(stream.subject)
    models = pack_model(arm), pack_model(actual)
    correction = correction_between(*models, arm, CorrectionConfig())
    for _ in range(10):
        probe.stream(stream, 250, 0.5)
        probe.drain()
        wanted = correction.correct(path(stream.t)[0][None]).q[0]
        if np.allclose(stream.robot, wanted, rtol=0.0, atol=1e-9):
            return
    raise TimeoutError("the correction did not come in force: see the node's diagnostics")


def _stream(
    probe: "Probe", streams: "list[Stream]", rate: int, seconds: float
) -> Iterator[dict[str, Any]]:
    """Blocks of each by turns, there and back, so that all meet the same machine.

    Rows of all blocks, those of what is judged with the figures of each block too.
    """
    judged = [stream for stream in streams if stream.subject.name in JUDGED]
    took: dict[tuple[str, str], list[float]] = defaultdict(list)
    sent: dict[tuple[str, str], int] = defaultdict(int)
    lost: dict[tuple[str, str], int] = defaultdict(int)
    cpu_s: dict[str, float] = defaultdict(float)
    rounds: dict[str, dict[str, list[float]]] = {n: defaultdict(list) for n in JUDGED}
    for block in range(max(1, round(seconds / BLOCK_S))):
        chosen = streams if block % OTHERS_IN == 0 else judged
        for stream in chosen if block % 2 else reversed(chosen):
            name = stream.subject.name
            stream.forget()
            begin = stream.subject.cpu_s()
            probe.stream(stream, rate, BLOCK_S)
            probe.drain()
            used_s = stream.subject.cpu_s() - begin
            cpu_s[name] += used_s
            for topic, count in stream.sent.items():
                sent[name, topic] += count
                lost[name, topic] += count - len(stream.took[topic])
                took[name, topic] += stream.took[topic]
            if name in rounds:
                ms = 1e3 * np.array(stream.took["joint_targets"])
                rounds[name]["p50"].append(float(np.quantile(ms, 0.5)))
                rounds[name]["p99"].append(float(np.quantile(ms, 0.99)))
                rounds[name]["cpu_us"].append(1e6 * used_s / sum(stream.sent.values()))
    for (name, topic), times in took.items():
        ms = np.array(times) * 1e3
        messages = sum(count for (of, _), count in sent.items() if of == name)
        figures = {f"p{q * 100:g}": float(np.quantile(ms, q)) for q in QUANTILES}
        yield {
            "through": name,
            "topic": topic,
            "rate_hz": rate,
            "n": sent[name, topic],
            "lost": lost[name, topic],
            "longest": float(ms.max()),
            "cpu_us": cpu_s[name] / messages * 1e6,
            "rounds": rounds.get(name),
        } | figures


def _paths(probe: "Probe", streams: "list[Stream]") -> dict[str, list[float]]:
    """How long whole trajectories take, ms, by turns."""
    from rclpy.serialization import serialize_message
    from trajectory_msgs.msg import JointTrajectory

    from robocal_ros.ros import endpoints

    came: list[float] = []
    chosen = [stream for stream in streams if stream.subject.name in (NODE, RELAY)]
    publishers = {}
    for stream in chosen:
        subject = stream.subject
        name = subject.topic("joint_trajectory")
        publishers[subject.name] = probe.node.create_publisher(
            JointTrajectory, name, endpoints.RELIABLE
        )
        out = subject.topic(f"{subject.node}/joint_trajectory")
        probe.node.create_subscription(
            JointTrajectory,
            out,
            lambda _: came.append(time.perf_counter()),
            endpoints.RELIABLE,
            raw=True,
        )
    for publisher in publishers.values():
        probe.wait(publisher.get_subscription_count, "the trajectories' inputs")
    probe.drain()
    found: dict[str, list[float]] = defaultdict(list)
    for turn in range(-1, PATHS):  # the first may come before its way back is discovered
        for stream in chosen:
            data = serialize_message(_trajectory(stream))
            name = stream.subject.name
            _stand(probe, stream, 2.0 * POINTS * STEP_NS * 1e-9)  # the one before has ended
            came.clear()
            begin = time.perf_counter()
            publishers[name].publish(data)
            _stand(probe, stream, PATH_S, came)
            if not came:
                print(f"{name} lost one: {stream.subject.log.read_text()[-2000:]}", file=sys.stderr)
            elif turn >= 0:
                found[name].append((came[0] - begin) * 1e3)
    return dict(found)


def _stand(probe: "Probe", stream: "Stream", seconds: float, until: Sequence[float] = ()) -> None:
    """Say where the robot is, as its driver does all the time: without it nothing is corrected."""
    end_s = time.monotonic() + seconds
    while not until and time.monotonic() < end_s:
        stream.send_state()
        probe.spin(0.005)


def _trajectory(stream: "Stream") -> Any:
    """The path from where the stream stands."""
    from builtin_interfaces.msg import Duration
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    from bench.stream_probe import path

    points = []
    for i in range(POINTS):
        q, speed = path(stream.t + i * STEP_NS * 1e-9)
        rows = [array("d", row.tobytes()) for row in (q, speed, np.zeros(len(q)))]
        point = JointTrajectoryPoint(positions=rows[0], velocities=rows[1], accelerations=rows[2])
        sec, nanosec = divmod(i * STEP_NS, 10**9)
        point.time_from_start = Duration(sec=sec, nanosec=nanosec)
        points.append(point)
    return JointTrajectory(joint_names=list(stream.names), points=points)


def main() -> None:
    """Measure here, in the venv of the nodes."""
    from bench.tables import show

    parser = argparse.ArgumentParser(prog="python -m bench.correction_stream", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each stream")
    parser.add_argument("--json", action="store_true", help="figures for the tables")
    given = parser.parse_args()
    found = measure(given.seconds)
    if given.json:
        print(json.dumps(found))
    else:
        show(in_tables(found))


if __name__ == "__main__":
    main()
