# SPDX-License-Identifier: Apache-2.0
"""The house node, by a small node of its own kind."""

import subprocess
import sys
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.lifecycle import LifecycleNode
from robocal_msgs.srv import Decide
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, InputError, StaleError
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode
from robocal_ros.ros.endpoints import LOG_EVERY_S, MOST_KEPT, WARN, Health, LogLimit
from robocal_ros.ros.parameters import Setting
from robocal_ros.session.inputs import MOST_REASONS

BUG = 5e5  # of this number the callback has a defect
UNTOLD = 7.0  # with this factor it cannot tell its health


class Doubler(HouseNode):
    """Doubles numbers; refuses negative ones."""

    NAME = "doubler"
    SETTINGS = (
        Setting("factor", 2.0, "What to multiply with", unit="1", low=0.0, high=10.0, live=True),
        Setting("start_fails", "no", "Where to fail", choices=("no", "badly", "with a reason")),
        Setting("labels", [""], "An optional list"),
    )

    def configure(self) -> None:
        self.released = 0
        self.factor = self.settings["factor"]
        self.output = self.add_output(Float64, "~/doubled", endpoints.RELIABLE)
        self.add_input(Float64, "number", self.on_number, endpoints.RELIABLE)
        self.add_service(Decide, "~/decide", self.on_decide)
        self.add_service(Trigger, "~/decide_trigger", self.on_trigger)
        self.add_service(Trigger, "~/defect_trigger", self.on_defect)
        self.decide = self.create_client(Decide, "~/decide")
        if self.settings["start_fails"] == "badly":
            raise KeyError("a bug")
        if self.settings["start_fails"] == "with a reason":
            raise InputError("no robot file", file="robot.yaml")

    def cleanup(self) -> None:
        self.released += 1

    def settings_changed(self) -> None:
        self.factor = self.settings["factor"]

    def on_number(self, message: Float64) -> None:
        if message.data < 0:
            raise InputError(f"{message.data} is negative")
        if message.data == BUG:
            raise KeyError("a bug")
        if message.data > 1e6:
            raise InputError(f"{message.data} is too large")
        self.output.publish(Float64(data=self.factor * message.data))

    def on_decide(self, request: Decide.Request, response: Decide.Response) -> Decide.Response:
        if request.id == 0:
            raise StaleError("too old")
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    async def on_trigger(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        answer = await self.decide.call_async(Decide.Request(id=7))
        response.success = answer.success
        return response

    def on_defect(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        raise KeyError("a bug")

    def health(self) -> Health:
        if self.factor == UNTOLD:
            raise OSError(5, "Input/output error")
        health = Health(values={"factor": self.factor})
        if self.factor > 5:
            health.worsen(WARN, "a large factor")
        return health


class Keeper(HouseNode):
    """Has an input that is kept while the node is inactive, and one that is heard."""

    NAME = "keeper"

    def configure(self) -> None:
        self.heard: dict[str, list[float]] = {"kept": [], "passive": []}
        for topic, how in (("kept", {"kept": True}), ("passive", {"inactive": True})):
            self.add_input(
                Float64,
                topic,
                lambda message, topic=topic: self.heard[topic].append(message.data),
                endpoints.RELIABLE,
                **how,
            )


def set_parameter(graph: Any, **value: Any) -> Any:
    (name, typed) = value.popitem()
    kind = {float: ("double_value", 3), str: ("string_value", 4), int: ("integer_value", 2)}
    field, number = kind[type(typed)]
    request = Parameter(name=name, value=ParameterValue(type=number, **{field: typed}))
    return graph.call(SetParameters, "/doubler/set_parameters", parameters=[request]).results[0]


def change_state(graph: Any, transition: int) -> bool:
    request = Transition(id=transition)
    return bool(graph.call(ChangeState, "/doubler/change_state", transition=request).success)


def state_of(graph: Any) -> str:
    return str(graph.call(GetState, "/doubler/get_state").current_state.label)


def test_starts_by_itself_and_works(graph: Any) -> None:
    graph.add(Doubler)
    doubled = graph.collect(Float64, "/doubler/doubled")
    number = graph.publisher(Float64, "number")
    number.publish(Float64(data=21.0))
    graph.spin_until(lambda: doubled, "a doubled number")
    assert doubled[0].data == 42.0
    assert state_of(graph) == "active"


def test_a_defect_in_a_callback_is_counted_and_the_node_lives_on(graph: Any) -> None:
    node = graph.add(Doubler)
    doubled = graph.collect(Float64, "/doubler/doubled")
    number = graph.publisher(Float64, "number")
    number.publish(Float64(data=BUG))
    graph.spin_until(lambda: node.inputs["number"].invalid == 1, "the defect is counted")
    number.publish(Float64(data=2.0))
    graph.spin_until(lambda: doubled, "a doubled number")
    assert doubled[0].data == 4.0


def test_waits_for_commands_without_autostart_and_ignores_inputs_while_inactive(graph: Any) -> None:
    node = graph.add(Doubler, {"autostart": False})
    assert state_of(graph) == "unconfigured"
    assert change_state(graph, Transition.TRANSITION_CONFIGURE)
    doubled = graph.collect(Float64, "/doubler/doubled")
    number = graph.publisher(Float64, "number")
    number.publish(Float64(data=1.0))
    graph.spin_until(lambda: node.inputs["number"].ignored == 1, "the number is counted")
    answer = graph.call(Decide, "/doubler/decide", id=1)
    assert (answer.success, answer.status) == (False, Code.CONFLICT)
    assert "inactive" in answer.message
    twin = graph.call(Trigger, "/doubler/decide_trigger")  # has no status: its words carry the code
    assert (twin.success, twin.message) == (
        False,
        "0 CONFLICT doubler is inactive: activate it to use ~/decide_trigger",
    )
    assert change_state(graph, Transition.TRANSITION_ACTIVATE)
    number.publish(Float64(data=2.0))
    graph.spin_until(lambda: doubled, "a doubled number")
    assert [message.data for message in doubled] == [4.0]


def test_inputs_are_kept_in_their_order_or_heard_while_inactive_where_it_is_said(
    graph: Any,
) -> None:
    node = graph.add(Keeper)
    node.trigger_deactivate()
    numbers = [float(i) for i in range(MOST_KEPT + 2)]
    for topic in node.heard:
        publisher, count = graph.publisher(Float64, topic), node.inputs[topic]
        for number in numbers:
            publisher.publish(Float64(data=number))
        graph.spin_until(lambda count=count: count.received == len(numbers), f"{topic} is received")
    assert node.heard == {"kept": [], "passive": numbers}
    for _ in range(2):  # once
        node.trigger_activate()
        assert node.heard == {"kept": numbers[2:], "passive": numbers}
        node.trigger_deactivate()
    assert node.inputs["kept"].ignored == 2
    assert node.inputs["passive"].ignored == 0


@pytest.mark.parametrize(
    ("how", "said"),
    [("badly", "KeyError: 'a bug'"), ("with a reason", "robot.yaml: no robot file")],
)
def test_a_failed_configure_is_reported_and_undone(graph: Any, how: str, said: str) -> None:
    statuses = graph.collect(DiagnosticArray, "/diagnostics")
    node = graph.add(Doubler, {"start_fails": how, "serial": "R1"})
    assert state_of(graph) == "unconfigured"
    assert node.released == 1
    graph.spin_until(lambda: statuses, "diagnostics")
    status = statuses[-1].status[0]
    assert status.level == DiagnosticStatus.ERROR
    assert said in status.message
    assert (status.name, status.hardware_id) == ("doubler", "R1")
    # What is wrong can be put right without a new process.
    assert set_parameter(graph, start_fails="no").successful
    assert change_state(graph, Transition.TRANSITION_CONFIGURE)
    assert change_state(graph, Transition.TRANSITION_ACTIVATE)
    assert graph.call(Decide, "/doubler/decide", id=1).success


def test_a_bad_parameter_at_the_start_is_named_and_can_be_put_right(graph: Any) -> None:
    node = graph.add(Doubler, {"factor": 11.0, "labels": 3})
    assert state_of(graph) == "unconfigured"
    health = node._full_health()
    assert "factor = 11 is out of bounds: at least 0 and at most 10 1" in health.message
    assert "labels = 3 is not a list" in health.message
    assert set_parameter(graph, factor=4.0).successful


def test_a_parameter_that_no_node_has_is_named(graph: Any) -> None:
    """rclpy drops it unsaid: a misspelt limit would be the default."""
    node = graph.add(Doubler, {"facter": 4.0})
    assert state_of(graph) == "unconfigured"
    message = node._full_health().message
    assert "facter is no parameter of this node (did you mean 'factor'?)" in message


def test_what_is_given_to_all_nodes_need_not_be_a_parameter_of_each(graph: Any) -> None:
    """Of config/cell.yaml, what a launch file sets for all, and what rclpy itself takes."""
    shared = {"robot": "ur10", "laser": "", "use_sim_time": False, "robot_description": "<robot/>"}
    graph.add(Doubler, shared | {"qos_overrides./number.subscription.depth": 7})
    assert state_of(graph) == "active"


def test_whole_numbers_stand_for_floats_and_blanks_for_no_entry(graph: Any) -> None:
    node = graph.add(Doubler, {"factor": 3})
    assert node.settings["factor"] == 3.0
    assert isinstance(node.settings["factor"], float)
    assert node.settings["labels"] == []


def test_parameters_change_only_where_it_is_safe_and_within_bounds(graph: Any) -> None:
    node = graph.add(Doubler)
    assert set_parameter(graph, factor=6.0).successful
    assert node.factor == 6.0
    refused = set_parameter(graph, factor=10.5)
    assert not refused.successful
    assert "factor" in refused.reason
    assert "10.5" in refused.reason
    assert not set_parameter(graph, factor=float("nan")).successful
    assert not set_parameter(graph, start_fails="sometimes").successful
    refused = set_parameter(graph, start_fails="badly")
    assert not refused.successful
    assert "unconfigured" in refused.reason
    assert node.factor == 6.0


def test_parameters_describe_themselves(graph: Any) -> None:
    graph.add(Doubler)
    answer = graph.call(
        DescribeParameters, "/doubler/describe_parameters", names=["factor", "start_fails"]
    )
    factor, start_fails = answer.descriptors
    assert factor.description == "What to multiply with [1]"
    assert factor.floating_point_range[0].to_value == 10.0
    assert "may change at any time" in factor.additional_constraints
    assert "badly" in start_fails.additional_constraints


def test_an_invalid_message_is_counted_and_does_no_harm(graph: Any) -> None:
    node = graph.add(Doubler)
    doubled = graph.collect(Float64, "/doubler/doubled")
    number = graph.publisher(Float64, "number")
    number.publish(Float64(data=-1.0))
    number.publish(Float64(data=1.0))
    graph.spin_until(lambda: doubled, "a doubled number")
    assert (node.inputs["number"].received, node.inputs["number"].invalid) == (2, 1)


def test_services_answer_errors_with_their_code_and_may_wait_for_others(graph: Any) -> None:
    graph.add(Doubler)
    answer = graph.call(Decide, "/doubler/decide", id=0)
    assert (answer.success, answer.status, answer.message) == (False, Code.STALE, "too old")
    assert graph.call(Trigger, "/doubler/decide_trigger").success
    defect = graph.call(Trigger, "/doubler/defect_trigger")
    assert not defect.success
    assert defect.message.startswith("0 BAD_INPUT a defect of this software, please report it")


def test_diagnostics_tell_the_health_of_an_active_node_once_a_second(graph: Any) -> None:
    statuses = graph.collect(DiagnosticArray, "/diagnostics")
    graph.add(Doubler, {"factor": 6.0})
    graph.spin_until(lambda: len(statuses) >= 3, "three reports", within_s=5.0)
    status = statuses[-1].status[0]
    assert (status.level, status.message) == (DiagnosticStatus.WARN, "a large factor")
    values = {item.key: item.value for item in status.values}
    assert values["state"] == "active"
    assert values["factor"] == "6.0"
    assert values["number received"] == "0"


def test_a_health_that_cannot_be_told_is_an_error_and_the_node_lives_on(graph: Any) -> None:
    statuses = graph.collect(DiagnosticArray, "/diagnostics")
    graph.add(Doubler, {"factor": UNTOLD})
    graph.spin_until(
        lambda: any(one.status[0].level == DiagnosticStatus.ERROR for one in statuses), "an error"
    )
    status = statuses[-1].status[0]
    assert status.message == "cannot tell how it is: OSError: [Errno 5] Input/output error"
    assert {item.key: item.value for item in status.values}["state"] == "active"
    assert set_parameter(graph, factor=2.0).successful
    graph.spin_until(lambda: statuses[-1].status[0].message == "ok", "it is told again")


def test_configures_again_after_cleanup(graph: Any) -> None:
    node = graph.add(Doubler)
    assert change_state(graph, Transition.TRANSITION_DEACTIVATE)
    assert change_state(graph, Transition.TRANSITION_CLEANUP)
    assert node.released == 1
    assert change_state(graph, Transition.TRANSITION_CONFIGURE)
    assert change_state(graph, Transition.TRANSITION_ACTIVATE)
    doubled = graph.collect(Float64, "/doubler/doubled")
    graph.publisher(Float64, "number").publish(Float64(data=1.0))
    graph.spin_until(lambda: doubled, "a doubled number")
    assert len(doubled) == 1


def test_no_attribute_of_the_house_hides_one_of_rclpy(graph: Any) -> None:
    bare = LifecycleNode("bare", context=graph.context)
    house = set(vars(HouseNode)) - {"__init__", "__module__", "__doc__", "__annotations__"}
    overridden = {name for name in house if name.startswith("on_")}
    taken = set(dir(bare))
    bare.destroy_node()
    assert not (house - overridden) & taken
    own = set(vars(graph.add(Doubler, {"autostart": False}))) - set(vars(bare))
    assert not own & taken


def test_a_flood_of_one_reason_hides_no_other(graph: Any, capfd: Any) -> None:
    node = graph.add(Doubler)
    number = graph.publisher(Float64, "number")
    for value in (-1.0, -2.0, 2e6):
        number.publish(Float64(data=value))
    graph.spin_until(lambda: node.inputs["number"].invalid == 3, "all are refused")
    log = capfd.readouterr().err
    assert "number: -1.0 is negative" in log
    assert "number: 2000000.0 is too large" in log


def test_each_reason_of_a_topic_is_logged_once_in_a_while() -> None:
    limit = LogLimit()
    assert limit.allows("a", "-1.0 is negative", 100.0)
    assert not limit.allows("a", "-2.5 is negative", 100.0 + 0.9 * LOG_EVERY_S)
    assert limit.allows("a", "7 is too large", 100.1)
    assert limit.allows("b", "-1.0 is negative", 100.1)
    assert limit.allows("a", "-3.0 is negative", 100.0 + LOG_EVERY_S)


def test_endless_reasons_neither_flood_the_log_nor_the_memory() -> None:
    limit = LogLimit()
    names = [f"joint {chr(ord('a') + i % 26)}{chr(ord('a') + i // 26)} missing" for i in range(600)]
    logged = sum(limit.allows("a", name, 100.0) for name in names)
    assert logged == MOST_REASONS + 1


@pytest.mark.parametrize(
    "module", ["ros.base", "ros.conversions", "bags.recorder_node", "ros.graph"]
)
def test_what_every_node_imports_brings_no_session_and_no_kernels(module: str) -> None:
    """They cost each start of each node 80 ms."""
    program = f"import sys, robocal_ros.{module}; print(*sys.modules)"
    told = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, check=True, text=True
    )
    heavy = {"numba", "scipy", "robocal_ros.thermal.session", "robocal_ros.thermal.tracking"}
    assert heavy.isdisjoint(told.stdout.split())


def test_a_robot_and_its_tables_are_read_without_scipys_rotations() -> None:
    """Finding: each node with a robot imported scipy.spatial, which takes a tenth of a second."""
    program = (
        "import sys, robocal_ros.ros.robot, robocal_ros.tool.files, numpy as np\n"
        "from robocal_ros.ground import frames\n"
        "frames.log_rotation(frames.rotation_from_rpy([0.1, 0.2, 0.3]))\n"
        "print(*sys.modules)"
    )
    told = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, check=True, text=True
    )
    assert "scipy.spatial" not in told.stdout.split()
