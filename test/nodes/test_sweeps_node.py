# SPDX-License-Identifier: Apache-2.0
"""Tools without crossed beams, by the Triggers of tcf_node over DDS: swept, or touched."""

from pathlib import Path
from typing import Any

import numpy as np
from beam_cell import make_cell
from command import robocal_json
from robocal_msgs.msg import CalibrationQuality, SessionEvent, ToolFrame
from robocal_msgs.srv import Decide
from scipy.stats import chi2
from std_srvs.srv import Trigger
from tool_cell_live import LiveCell
from tool_driver import NOISE, START_NS, TAUGHT
from tool_driver import TRUTH as TOUCHED
from transforms import matrix_of, off_m

from bench.measured_runs import touching
from bench.parallel_sweeps import STATION, STRAIGHT, SweepProgram, plunge_at, upright_of
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, bent
from robocal_ros.ground.samples import JointSample
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.tool.touch_points import PLUNGE

TRUTH = bent(TAUGHT, [0.0015, -0.001, 0.0006], [0.012, 0.018, 0.0])
EVENT_TOPIC = "/tcf_node/session_events"
TOUCHES = 6
POLLED = TrueInput(latency_s=0.004, sample_period_s=0.002)


def test_a_tool_is_swept_solved_accepted_and_replayed(graph: Any, tmp_path: Path) -> None:
    """By two parallel beams alone."""
    cell = LiveCell(
        graph,
        tmp_path,
        TRUTH,
        laser="",
        parallel_up_mm=1e3 * STATION.up_m,
        parallel_down_mm=1e3 * STATION.down_m,
        parallel_x_mm=1e3 * STATION.x_m,
    )
    cell.program = SweepProgram(
        make_cell(exact=False, source=POLLED, noise=NOISE),
        RoundTool.cylinder(TRUTH, 0.0025),
        np.random.default_rng(2),
        START_NS,
    )
    events = graph.collect(SessionEvent, EVENT_TOPIC, EVENTS)
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    qualities = graph.collect(CalibrationQuality, "/tcf_node/quality", endpoints.LATCHED)

    def swept(R: np.ndarray, name: str, x_m: float | None = None) -> str:
        cell.play(cell.program.sweep(R, TAUGHT[:3, 3], name, x_m))
        taken = graph.call(Trigger, "/tcf_node/sweep_trigger")
        assert taken.success, taken.message
        return str(taken.message)

    early = graph.call(Trigger, "/tcf_node/sweep_trigger")
    assert not early.success
    assert "no beam was broken" in early.message
    for name in ("straight", "turned"):
        told = swept(STRAIGHT[name], name)
    for name, R in upright_of(told).items():
        told = swept(R, name)
    swept(R, PLUNGE, plunge_at(told))
    solved = graph.call(Trigger, "/tcf_node/solve_sweeps_trigger")
    assert solved.success, solved.message
    number = int(solved.message.split()[0])
    graph.spin_until(lambda: qualities, "the verdict")
    assert qualities[-1].candidate_id == number
    assert graph.call(Decide, "/tcf_node/accept", id=number, by="me").success
    graph.spin_until(lambda: tools[-1].revision == 1, "the tool is in force")
    T = matrix_of(tools[-1].tool)
    error = np.concatenate([TRUTH[:3, 3] - T[:3, 3], T[:3, :2].T @ TRUTH[:3, 2]])
    covariance = np.array(tools[-1].covariance).reshape(5, 5)
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, 5)

    bag = tmp_path / "live.mcap"
    written(cell.samples, events, bag)
    document = robocal_json("replay.tool.json", "replay", bag)
    assert (document["recorded"], document["differs"]) == (True, [])
    assert [run["method"] for run in document["runs"]] == ["parallel beams"]


def written(samples: list[Any], events: list[SessionEvent], path: Path) -> None:
    """The samples that were published, and what the node recorded of its session."""
    with BagWriter(path, latched=[EVENT_TOPIC]) as bag:
        for sample in samples:
            header = {"stamp": ros_time(sample.stamp_ns), "frame_id": ""}
            if isinstance(sample, JointSample):
                kind, topic = "sensor_msgs/msg/JointState", "/joint_states"
                more = {"name": list(sample.names), "position": sample.position}
            else:
                kind, topic = "robocal_msgs/msg/BeamEvent", "/beam_events"
                edge = 1 if sample.blocked else 2
                more = {"beam": sample.beam, "edge": edge, "stamp_sigma_s": sample.sigma_s}
            bag.write(topic, kind, {"header": header} | more, sample.stamp_ns)
        for event in events:
            kind = "robocal_msgs/msg/SessionEvent"
            bag.write(EVENT_TOPIC, kind, event, samples[-1].stamp_ns)


def test_a_tip_is_touched_solved_and_accepted(graph: Any, tmp_path: Path) -> None:
    cell = LiveCell(graph, tmp_path, TOUCHED)
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    candidates = graph.collect(ToolFrame, "/tcf_node/candidate", endpoints.LATCHED)
    qualities = graph.collect(CalibrationQuality, "/tcf_node/quality", endpoints.LATCHED)
    arm, near = cell.cell.arm, cell.cell.q_near
    for q in touching(arm, TOUCHED, near, TOUCHES):
        cell.program.q = q
        cell.rest(0.45)
        taken = graph.call(Trigger, "/tcf_node/touch_trigger")
        assert taken.success, taken.message
    solved = graph.call(Trigger, "/tcf_node/solve_touches_trigger")
    assert solved.success, solved.message
    graph.spin_until(lambda: candidates and qualities, "candidate and quality")
    number = int(solved.message.split()[0])
    assert qualities[-1].candidate_id == number
    assert graph.call(Decide, "/tcf_node/accept", id=number, by="me").success
    graph.spin_until(lambda: tools[-1].revision == 1, "the tool is in force")
    # Exact touches of an exact robot: what is left is the readings' rounding.
    assert off_m(tools[-1].tool, TOUCHED) < 1e-6
