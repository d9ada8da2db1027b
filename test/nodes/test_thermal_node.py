# SPDX-License-Identifier: Apache-2.0
"""The thermal node over real DDS."""

import json
import math
import re
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cell import DEEP, Cell, message_of
from command import robocal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped
from history_workers import proposal
from joint_errors import with_joint_errors
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from long_form import amount
from rclpy.node import Node
from robocal_msgs.msg import AccuracyState, CorrectionStatus, KinematicModel
from robocal_msgs.srv import Decide, ListCalibrations
from sensor_msgs.msg import JointState
from shift import Shift, built, postures, warmed

from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JointSample
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import acknowledge
from robocal_ros.history.history_records import THERMAL, CalibrationState, Head
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import load_description, load_robot, save_robot
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.endpoints import Health
from robocal_ros.ros.session_node import history_notice
from robocal_ros.session.events import bring_into_force
from robocal_ros.thermal.node import ThermalNode

POSES = 8


@pytest.fixture(scope="module")
def visits(nominal: Any) -> list[list[Any]]:
    """Cold and warm visits of the same poses."""
    shift = Shift(nominal.joint_names)
    cold, q = built(nominal), postures(nominal, POSES)
    return [list(shift.visit(warmed(cold, k), q, after_h=k / 7.5)) for k in (0.0, 15.0, 20.0)]


def candidate(cell: Cell, visits: list[list[Any]]) -> int:
    """Capture a reference and identify a drift; returns the candidate's id."""
    cell.play(visits[0])
    captured = cell.call("capture_reference")
    assert captured.success, captured.message
    assert captured.samples >= POSES - 1
    cell.play(visits[1])
    identified = cell.call("identify", cycle_id="warm")
    assert identified.success, identified.message
    assert identified.status == Code.ACCEPT, identified.message
    return int(identified.candidate_id)


def test_a_cycle_from_measurement_to_force(graph, visits, nominal):
    cell = Cell(graph)
    assert [m.revision for m in cell.models] == [0]
    assert np.array_equal(cell.models[0].d, nominal.mdh[:, 0])
    assert cell.models[0].model_hash == nominal.model_hash
    assert cell.models[0].robot_file_hash == load_description("kr150_r3100").file_hash
    found = candidate(cell, visits)
    graph.spin_until(lambda: cell.candidates and cell.qualities, "candidate and quality")
    quality, proposed = cell.qualities[-1], cell.candidates[-1]
    assert (quality.candidate_id, quality.code, quality.accept) == (found, Code.ACCEPT, True)
    assert quality.candidate_rms_mm < 0.5 * quality.current_rms_mm
    assert quality.current_rms_mm > 0.2
    assert quality.header.frame_id == "sensor"
    assert (quality.robot, quality.serial, quality.cycle_id) == (nominal.name, "s1", "warm")
    assert proposed.state == KinematicModel.CANDIDATE
    k = len(proposed.parameter_names)
    covariance = np.array(proposed.covariance).reshape(k, k)
    assert k == len(nominal.parameters)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert cell.models[-1].revision == 0  # solving changes nothing
    answer = cell.call("accept", id=found, by="me", reason="good")
    assert (answer.success, answer.status, answer.revision) == (True, Code.ACCEPT, 1)
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the model is in force")
    assert cell.models[-1].state == KinematicModel.ACCEPTED
    assert cell.models[-1].a == proposed.a
    listed = cell.call("list").calibrations
    assert [(c.kind, c.state, c.revision) for c in listed] == [
        ("thermal", "in_force", 1),
        ("reference", "in_force", 1),
    ]
    assert (listed[0].by, listed[0].reason) == ("me", "good")
    assert [e.sequence for e in cell.events] == list(range(1, len(cell.events) + 1))
    assert [e.command for e in cell.events] == [
        "configure", "capture_reference", "configure", "identify", "configure", "accept",
        "configure",
    ]  # fmt: skip
    graph.spin_until(lambda: cell.value("joint_states lost") == "0", "none was lost, it is told")


def test_trigger_twins(graph, visits):
    cell = Cell(graph)
    assert cell.call("accept_trigger").message.startswith("0 CONFLICT ")
    assert cell.call("rollback_trigger").message.startswith("0 CONFLICT ")
    assert cell.call("identify_trigger").message.startswith("0 TOO_FEW_SAMPLES ")
    cell.play(visits[0])
    captured = cell.call("capture_reference_trigger")
    assert captured.success
    assert captured.message.startswith("1 ACCEPT cold reference")
    cell.play(visits[1])
    assert cell.call("identify_trigger").message.startswith("2 ACCEPT ")
    accepted = cell.call("accept_trigger")
    assert accepted.success
    assert accepted.message.startswith("2 ACCEPT revision 1")
    assert not cell.call("accept_trigger").success  # nothing fresh any more
    cell.play(visits[2])
    assert cell.call("identify_trigger").message.startswith("3 ACCEPT ")
    assert cell.call("reject_trigger").message.startswith("3 ACCEPT ")
    assert cell.call("rollback_trigger").message.startswith("0 ACCEPT revision 2: the nominal")
    rows = json.loads(cell.call("list_trigger").message)
    assert [(row["id"], row["state"]) for row in rows] == [
        (3, "rejected"),
        (2, "rolled_back"),
        (1, "in_force"),
    ]


def test_a_twin_does_not_choose_between_candidates(graph, visits):
    cell = Cell(graph)
    first = candidate(cell, visits)
    cell.play(visits[2])
    second = cell.call("identify").candidate_id
    answer = cell.call("accept_trigger")
    assert not answer.success
    assert answer.message.startswith("0 CONFLICT ")
    assert f"{second}, {first}" in answer.message
    assert cell.call("reject_trigger").success  # the way out: all of them
    assert cell.call("reject_trigger").message.startswith("0 CONFLICT ")


REFUSALS = [
    ("identify", {}, Code.TOO_FEW_SAMPLES, "no joint states received"),
    ("identify", {"method": "magic"}, Code.BAD_INPUT, "map, lsq"),
    ("capture_reference", {}, Code.TOO_FEW_SAMPLES, "no joint states received"),
    ("accept", {"id": 99}, Code.BAD_INPUT, "no calibration has the id 99"),
    ("accept", {}, Code.BAD_INPUT, "needs the id"),
    ("reject", {"id": 99}, Code.BAD_INPUT, "no calibration has the id 99"),
    ("rollback", {}, Code.CONFLICT, "in force already"),
    ("rollback", {"id": 99}, Code.BAD_INPUT, "no calibration has the id 99"),
]


def test_every_refusal_has_its_code_and_changes_nothing(graph):
    cell = Cell(graph)
    for service, fields, status, words in REFUSALS:
        answer = cell.call(service, **fields)
        assert (answer.success, answer.status) == (False, status), (service, fields)
        assert words in answer.message
    assert cell.call("list").calibrations == []
    graph.spin_until(lambda: cell.qualities, "the reason of a refusal is published too")
    assert cell.qualities[-1].candidate_id == 0
    assert not cell.qualities[-1].accept
    recorded = [e.command for e in cell.events]
    assert recorded.count("identify") == 2


def test_bad_samples_are_counted_and_never_used(graph, visits):
    cell = Cell(graph)
    for sample in visits[0][:100]:
        if isinstance(sample, JointSample):
            cell.joints.publish(message_of(sample))
    at = time_message(visits[0][75].stamp_ns)
    point = PointStamped()
    point.header.stamp, point.header.frame_id = at, "sensor/ball"
    point.point.x = math.nan
    cell.points.publish(point)
    pose = PoseStamped()
    pose.header.stamp, pose.header.frame_id = at, "sensor/ball"
    pose.pose.orientation.w = 0.7
    cell.poses.publish(pose)
    cell.joints.publish(JointState(header=pose.header, name=["elbow"], position=[1.0]))
    cell.joints.publish(JointState(header=pose.header, name=["elbow"], position=[]))
    expected = {
        "measured_point ignored: measured point is not finite: [nan, #, #]",
        "measured_pose ignored: measured orientation has a quaternion of length #, not #",
        "joint_states ignored: joint state has # names but # positions",
    }
    graph.spin_until(
        lambda: expected <= {v.key for v in getattr(cell.status(), "values", [])},
        "the reasons are in the diagnostics",
    )
    assert any("no position of joint_a1" in v.key for v in cell.status().values)
    answer = cell.call("identify")
    assert answer.status == Code.TOO_FEW_SAMPLES
    assert "not finite" in answer.message


def test_a_candidate_of_an_earlier_reference_is_refused_by_node_and_command(graph, visits):
    """No drift is in force: what the cold robot shows now is another beginning."""
    cell = Cell(graph)
    found = candidate(cell, visits)
    cell.play(visits[2])
    captured = cell.call("capture_reference")
    assert captured.success, captured.message
    answer = cell.call("accept", id=found)
    assert (answer.success, answer.status) == (False, Code.STALE), answer.message
    words = "measured with reference revision 1, in force is 2: measure it again"
    assert words in answer.message
    command = ["history", "accept", str(found), "--robot-serial", "s1", "--json"]
    done = robocal(*command, ROBOCAL_STATE=str(graph.state))
    assert done.returncode == 3
    refused = json.loads(done.stdout)["error"]
    assert (refused["code"], words in refused["message"]) == ("STALE", True), refused
    assert cell.models[-1].revision == 0


def test_what_the_command_line_decides_is_in_force_within_a_second(graph, visits):
    cell = Cell(graph)
    found = candidate(cell, visits)
    command = ["history", "accept", str(found), "--robot-serial", "s1", "--by", "shift lead"]
    done = robocal(*command, ROBOCAL_STATE=str(graph.state))
    begin = time.monotonic()
    assert done.returncode == 0, done.stdout + done.stderr
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the node follows")
    assert time.monotonic() - begin < 1.0
    graph.spin_until(lambda: cell.events[-1].command == "configure", "and records it")
    assert cell.events[-2].command == "accept"
    assert json.loads(cell.events[-2].arguments)["arguments"]["by"] == "shift lead"
    assert cell.call("accept", id=found).status == Code.CONFLICT
    (entry,) = [c for c in cell.call("list").calibrations if c.id == found]
    command = ["history", "list", "--robot-serial", "s1", "--json"]
    listed = json.loads(robocal(*command, ROBOCAL_STATE=str(graph.state)).stdout)
    (line,) = [c for c in listed["calibrations"] if c["id"] == found]
    assert (line["state"], line["revision"]) == (entry.state, entry.revision) == ("in_force", 1)


def test_an_accuracy_that_is_no_number_is_a_fault_and_ends_nothing(graph, visits, nominal):
    cell = Cell(graph)
    cell.play(visits[0])
    captured = cell.call("capture_reference")
    assert captured.success, captured.message
    model = model_document(nominal)
    model["mdh"][1][1] = 1e200  # m: its square is infinite
    absurd = proposal(model_hash=nominal.model_hash, model=model)
    with CalibrationHistory.open(cell.serial, state_dir=graph.state) as other:
        other.accept(other.propose(absurd), by="me", reason="", wall_ns=1)
    graph.spin_until(
        lambda: cell.accuracies and "not finite" in cell.accuracies[-1].reason, "the line is told"
    )
    said = cell.accuracies[-1]
    assert (said.state, said.bound_mm) == (AccuracyState.FAULT, -1.0)
    assert cell.call("rollback").success
    graph.spin_until(lambda: cell.accuracies[-1].state != AccuracyState.FAULT, "it goes on")


def propose(history: CalibrationHistory, nominal: Any, number: int) -> int:
    """A candidate that can be accepted now; each one is another model."""
    arm = nominal.with_mdh(nominal.mdh + 1e-6 * number)
    told = {"model_hash": nominal.model_hash, "based_on": history.head().revision}
    return history.propose(proposal(**told, cycle_id=str(number), model=model_document(arm)))


ROUNDS, ROBOTS = amount(2, 20), 3


def test_a_kill_during_accept_leaves_the_old_or_the_new_state(graph, nominal):
    """Killed 0 to 6 ms after the call; an accept takes about 2 ms. Each round is a restart."""
    delays = iter(np.linspace(0.0, 0.006, ROUNDS * ROBOTS))
    for turn in range(ROUNDS):
        started = []
        for robot in range(ROBOTS):
            serial, name = f"s{robot}", f"thermal_{robot}_{turn}"
            with CalibrationHistory.open(serial, state_dir=graph.state) as history:
                before = history.head()
                chosen = propose(history, nominal, 10 * turn + robot + 1)
            models = graph.collect(KinematicModel, f"/{name}/model", endpoints.LATCHED)
            client = graph.probe.create_client(Decide, f"/{name}/accept")
            process = graph.start("thermal_node", {"serial": serial}, {"__node": name})
            started.append((serial, before, chosen, models, client, process))
        for serial, before, chosen, models, client, process in started:
            graph.spin_until(lambda m=models, c=client: m and c.service_is_ready(), "it is there")
            assert models[-1].revision == before.revision
            client.call_async(Decide.Request(id=chosen, by="me"))
            graph.spin_for(next(delays))
            process.kill()
            require_old_or_new(graph, serial, before, chosen)


def require_old_or_new(graph: Any, serial: str, before: Head, chosen: int) -> None:
    with CalibrationHistory.open(serial, state_dir=graph.state, create=False) as history:
        assert history.damaged is None
        after, model = history.head(), history.model(chosen)
        state = history.get(chosen).state
    if after.revision == before.revision:
        assert after == before
        assert state is CalibrationState.PENDING
    else:
        assert (after.revision, after.calibration_id) == (before.revision + 1, chosen)
        assert after.model == model
        assert state is CalibrationState.IN_FORCE


def test_uncorrected_joint_states_are_refused(graph, visits):
    """Who publishes the status of a correction is one, whatever its name."""
    cell = Cell(graph)
    impostor = Node("renamed", context=graph.context)
    impostor.create_publisher(CorrectionStatus, "~/status", endpoints.LATCHED)
    publisher = impostor.create_publisher(JointState, "/joint_states", DEEP)
    graph.spin_until(lambda: publisher.get_subscription_count(), "the node hears it")
    graph.spin_until(
        lambda: cell.status() and "un-corrected" in cell.status().message, "it is refused"
    )
    assert cell.status().level == DiagnosticStatus.ERROR
    publisher.publish(message_of(visits[0][0]))
    graph.spin_until(
        lambda: any("un-corrected" in v.key for v in cell.status().values), "it is counted"
    )
    impostor.destroy_node()
    graph.spin_until(lambda: "un-corrected" not in cell.status().message, "it is over")


def test_every_node_says_that_a_history_was_set_aside_until_it_is_acknowledged(graph):
    """The first one does it, of the robot; the others say it too."""
    graph.state.mkdir()
    path = graph.state / "s1.sqlite"
    path.write_bytes(b"SQLite format 3\0" + bytes(5000))
    kinds = {
        ThermalNode: {},
        HandEyeNode: {},
        MaintenanceNode: {"home_deg": [0.0, -90.0, 90.0, 0.0, 90.0, 0.0]},
    }
    nodes = [graph.add(kind, given | {"serial": "s1"}) for kind, given in kinds.items()]
    said = "damaged history was set aside"
    assert history_notice({"serial": "s1", "state_dir": ""}).count(said) == 1
    for node in nodes:
        assert node.health().level == endpoints.WARN
        assert said in node.health().message
    (aside,) = acknowledge(path, "Ada", time.time_ns())
    assert aside.exists()
    for node in nodes:
        assert said not in node.health().message
    assert history_notice({"serial": "s1", "state_dir": ""}) == ""


FOUND = "what nobody stated .* without masses the model cannot follow"
GIVEN = "10 kg .* up to [0-9.]+ mm at the flange"


@pytest.mark.parametrize("told", [GIVEN, FOUND], ids=["masses given", "masses found"])
def test_every_node_tells_what_another_payload_than_the_models_may_cost(
    graph, nominal, tmp_path, told
):
    model = with_joint_errors(nominal, 1)
    path = tmp_path / "loaded.yaml"
    save_robot(replace(nominal, load=replace(model.load, payload_mass=120.0)), path)
    arm = load_robot(path)
    if told == FOUND:
        model = replace(model, load=ArmLoad.unknown(6))
    graph.state.mkdir()
    with CalibrationHistory.open("s1", model_hash=arm.model_hash, state_dir=graph.state) as history:
        bring_into_force(history, THERMAL, arm, model_document(model), "test")
    for kind in (ThermalNode, HandEyeNode):
        health = graph.add(kind, {"serial": "s1", "robot": str(path)}).health()
        assert health.level != endpoints.OK
        assert re.search(f"payload of {told}", health.message)
        assert "the robot file says 120 kg" in health.message


def test_a_history_that_vanishes_fails_calls_and_not_the_node(graph):
    cell = Cell(graph)
    path = graph.state / "s1.sqlite"
    path.rename(graph.state / "elsewhere")
    answer = cell.call("rollback_trigger")
    assert answer.message.startswith("0 STORAGE_FAILED ")
    graph.spin_until(lambda: "deleted" in (cell.status() or Health()).message, "it is said")
    assert cell.status().level == DiagnosticStatus.ERROR
    (graph.state / "elsewhere").rename(path)
    graph.spin_until(lambda: "deleted" not in cell.status().message, "it is mended")
    assert cell.call("rollback_trigger").message.startswith("0 CONFLICT ")


def test_a_deactivated_node_refuses_and_comes_back(graph):
    cell = Cell(graph)

    def change(transition: int) -> None:
        request = {"transition": Transition(id=transition)}
        assert graph.call(ChangeState, "/thermal_node/change_state", **request).success

    change(Transition.TRANSITION_DEACTIVATE)
    answer = cell.call("identify")
    assert (answer.success, answer.status) == (False, Code.CONFLICT)
    assert "activate it" in answer.message
    cell.models.clear()
    change(Transition.TRANSITION_ACTIVATE)
    graph.spin_until(lambda: cell.models, "the model in force")
    assert cell.call("identify").status == Code.TOO_FEW_SAMPLES
    graph.spin_until(lambda: len(cell.events) == 3, "three events")
    assert [e.command for e in cell.events] == ["configure", "configure", "identify"]


def test_a_state_folder_that_cannot_be_used_does_not_end_the_node(graph):
    graph.state.write_text("a file, not a folder")
    diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
    process = graph.start("thermal_node", {"serial": "s1"})
    graph.spin_until(lambda: diagnostics, "diagnostics")
    status = diagnostics[-1].status[0]
    assert status.level == DiagnosticStatus.ERROR
    assert "cannot configure" in status.message
    assert process.process.poll() is None
    assert process.stop() == 0


def test_it_starts_with_no_parameter_at_all(graph):
    """How soon, bench/startup.py says."""
    client = graph.probe.create_client(ListCalibrations, "/thermal_node/list")
    for _ in range(2):
        process = graph.start("thermal_node")
        graph.spin_until(client.service_is_ready, "the service is there")
        assert _answered(graph, client).result().success
        process.stop()
        graph.spin_until(lambda: not client.service_is_ready(), "it is gone")


def _answered(graph, client):
    """Ask until it answers: an answer is lost that is sent before both sides know each other."""
    for _ in range(5):
        future = client.call_async(ListCalibrations.Request())
        late = time.monotonic() + 1.0
        graph.spin_until(lambda f=future, t=late: f.done() or time.monotonic() > t, "a second")
        if future.done():
            return future
    pytest.fail("asked five times, and no answer came")
