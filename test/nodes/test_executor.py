"""The executor of nodes: events of the middleware come, what awaits goes on; one wait for each."""

import time

import pytest
import rclpy
from domains import free_domain
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from robocal_ros.ros.executor import NodeExecutor

WITHIN_S = 20.0
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def executor():
    with free_domain() as domain:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        made = NodeExecutor(context=context)
        yield made
        made.shutdown()
        context.try_shutdown()


@pytest.fixture
def node(executor):
    made = Node("tried", context=executor.context)
    executor.add_node(made)
    yield made
    executor.remove_node(made)
    made.destroy_node()


def spin_until(executor, condition):
    until_s = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < until_s
        executor.spin_once(timeout_sec=0.5)


def test_an_event_of_the_middleware_arrives(executor, node):
    """Of one of several subscriptions, and once."""
    told = {"a": [], "b": []}
    for topic, events in told.items():
        callbacks = SubscriptionEventCallbacks(incompatible_qos=events.append)
        node.create_subscription(String, topic, print, 10, event_callbacks=callbacks)
    node.create_publisher(String, "b", BEST_EFFORT)
    spin_until(executor, lambda: told["b"])
    for _ in range(3):
        executor.spin_once(timeout_sec=0.05)
    assert told["a"] == []
    assert [event.total_count for event in told["b"]] == [1]


def test_events_of_what_goes_and_comes_meanwhile_harm_nothing(executor, node):
    """A callback takes down and makes what the wait that called it was waiting for."""
    events, made = [], []

    def anew(_):
        while made:
            node.destroy_subscription(made.pop())
        callbacks = SubscriptionEventCallbacks(incompatible_qos=events.append)
        made.append(node.create_subscription(String, "b", print, 10, event_callbacks=callbacks))

    for _ in range(3):
        node.create_subscription(String, "a", anew, 10)
    node.create_publisher(String, "b", BEST_EFFORT)
    said = node.create_publisher(String, "a", 10)
    for round_number in range(5):
        said.publish(String())
        spin_until(executor, lambda before=round_number: len(events) > before)


def test_each_message_takes_one_wait(executor, node):
    heard = []
    node.create_subscription(String, "a", heard.append, 10)
    said = node.create_publisher(String, "a", 10)
    spin_until(executor, lambda: said.get_subscription_count() == 1)
    executor.spin_once(timeout_sec=0.2)
    before = executor.events.waits
    for number in range(50):
        said.publish(String())
        spin_until(executor, lambda before=number: len(heard) > before)
        executor.spin_once(timeout_sec=0.01)  # one for nothing
    assert executor.events.waits - before < 2.5 * 50  # rclpy's own executor: 3 * 50


def test_what_awaits_goes_on_at_once_when_it_may(executor, node):
    """And no later: nothing else happens meanwhile that would wake the executor."""
    group, answers, at_s = ReentrantCallbackGroup(), [], []
    first, second = Future(), Future()

    async def between(_):
        at_s.append(0.0)
        await first
        second.set_result(True)

    async def serve(_, response):
        at_s.append(0.0)
        await second
        at_s.append(time.monotonic())
        return response

    def hear(_):
        at_s.append(time.monotonic())
        first.set_result(True)

    said = []
    for topic, callback in (("a", hear), ("b", between)):
        node.create_subscription(String, topic, callback, 10, callback_group=group)
        said.append(node.create_publisher(String, topic, 10))
        spin_until(executor, lambda: said[-1].get_subscription_count() == 1)
    node.create_service(Trigger, "serve", serve, callback_group=group)
    client = node.create_client(Trigger, "serve", callback_group=group)
    spin_until(executor, client.service_is_ready)
    said[1].publish(String())
    spin_until(executor, lambda: len(at_s) == 1)
    client.call_async(Trigger.Request()).add_done_callback(answers.append)
    spin_until(executor, lambda: len(at_s) == 2)  # it is the newest, and looked at first
    for _ in range(3):
        executor.spin_once(timeout_sec=0.1)
    assert len(at_s) == 2
    said[0].publish(String())
    for _ in range(20):
        executor.spin_once(timeout_sec=3.0)
        if answers:
            break
    _, _, heard_s, served_s = at_s
    assert answers
    assert served_s - heard_s < 2.0
