# SPDX-License-Identifier: Apache-2.0
"""The executor of one thread: what it keeps from one wait to the next never hides what changed."""

import threading
import time
from typing import Any

import pytest
from conftest import DISCOVERY_S
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from robocal_msgs.action import MeasureTool
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from test_base import Doubler

from robocal_ros.ros import endpoints

LONG_S = 20.0  # a change that is not seen would be seen so late
ALL = QoSProfile(depth=1000)


def test_a_callback_does_not_wake_its_executor(graph: Any, monkeypatch: Any) -> None:
    """Nor is its wait set made anew: after it the executor waits once, until the time is over."""
    node = graph.add(Doubler)
    graph.publisher(Float64, "/number").publish(Float64(data=1.0))
    graph.spin_until(lambda: node.inputs["number"].received)
    kept, waited = graph.executor._kept, []
    wait = kept.wait
    monkeypatch.setattr(kept, "wait", lambda *of, **how: waited.append(1) or wait(*of, **how))
    node._diagnostics._timer.cancel()  # nothing else is to come
    graph.executor._events_ns = 0  # so that this wait is for QoS events too, and lasts
    begin_s = time.monotonic()
    graph.executor.spin_once(timeout_sec=0.05)
    assert len(waited) == 1
    assert time.monotonic() - begin_s > 0.04
    assert graph.executor._kept is kept


def test_events_of_qos_come_while_messages_keep_it_busy(graph: Any) -> None:
    node, matched = graph.add(Doubler), []
    node.create_timer(1e-3, lambda: None)
    told = SubscriptionEventCallbacks(matched=matched.append)
    node.create_subscription(Float64, "/told", lambda _: None, ALL, event_callbacks=told)
    for count in (1, 2):
        graph.publisher(Float64, "/told")
        graph.spin_until(lambda n=count: len(matched) == n, "the event")


def test_a_callback_that_awaited_something_wakes_its_executor(graph: Any, monkeypatch: Any) -> None:
    """Others may wait for what it did: they come at once, not with the next message."""
    node, gate, begun = graph.add(Doubler), Future(), []

    async def answer(request: Any, response: Any) -> Any:
        begun.append(request)
        await gate
        return response

    node.add_service(Trigger, "~/wait", answer)
    asked = graph.client(Trigger, "/doubler/wait").call_async(Trigger.Request())
    graph.spin_until(lambda: begun)
    woken: list[int] = []
    monkeypatch.setattr(graph.executor, "wake", lambda: woken.append(1))
    graph.spin_for(0.1)
    assert not woken
    gate.set_result(None)
    graph.spin_until(asked.done)
    assert woken


@pytest.mark.parametrize("timeout_s", [0.0, 0.05])
def test_it_waits_for_no_longer_than_it_may(graph: Any, timeout_s: float) -> None:
    graph.spin_for(0.1)
    begin_s = time.monotonic()
    for _ in range(3):
        graph.executor.spin_once(timeout_sec=timeout_s)
    assert time.monotonic() - begin_s >= 2.9 * timeout_s
    assert time.monotonic() - begin_s < LONG_S


def test_what_another_thread_makes_while_it_waits_is_heard(graph: Any) -> None:
    graph.spin_for(0.1)
    heard: list[Float64] = []
    publisher = graph.probe.create_publisher(Float64, "/number", endpoints.own(endpoints.LATCHED))
    publisher.publish(Float64(data=1.0))

    def listens() -> None:
        time.sleep(0.2)  # the executor waits
        latched = endpoints.own(endpoints.LATCHED)
        graph.probe.create_subscription(Float64, "/number", heard.append, latched)

    other, begin_s = threading.Thread(target=listens), time.monotonic()
    other.start()
    while not heard and time.monotonic() - begin_s < LONG_S:
        graph.executor.spin_once(timeout_sec=LONG_S)
    other.join()
    assert heard
    assert time.monotonic() - begin_s < LONG_S


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_is_destroyed_goes_at_once(graph: Any, elsewhere: bool) -> None:
    """By another thread, as soon as the executor no longer waits for it."""
    probe = graph.probe
    subscription = probe.create_subscription(Float64, "/number", print, 1)
    graph.spin_for(0.1)
    assert probe.count_subscribers("/number") == 1
    if elsewhere:
        other = threading.Timer(0.2, lambda: probe.destroy_subscription(subscription))
        other.start()
        begin_s = time.monotonic()
        graph.executor.spin_once(timeout_sec=0.5)
        other.join()
        assert time.monotonic() - begin_s > 0.4
    else:
        probe.destroy_subscription(subscription)
    assert probe.count_subscribers("/number") == 0


def test_what_a_callback_destroys_is_not_called_any_more(graph: Any) -> None:
    """All are ready at once: the first that is called takes the others away."""
    probe, called = graph.probe, []
    made: list[Any] = []

    def first(message: Any = None) -> None:
        called.append(message)
        while made:
            made.pop()()

    for _ in range(2):
        one = probe.create_subscription(Float64, "/number", first, 10)
        made.append(lambda one=one: probe.destroy_subscription(one))
        guard = probe.create_guard_condition(first)
        made.append(lambda guard=guard: probe.destroy_guard_condition(guard))
        timer = probe.create_timer(0.05, first)
        made.append(lambda timer=timer: probe.destroy_timer(timer))
        guard.trigger()
    publisher = probe.create_publisher(Float64, "/number", 10)
    publisher.publish(Float64(data=1.0))
    time.sleep(0.1)
    graph.spin_for(0.2)
    assert len(called) == 1


def test_a_timer_that_another_one_cancels_is_not_called(graph: Any) -> None:
    """Both are due in the same wait."""
    called: list[int] = []
    timers: list[Any] = []

    def cancel_other(own: int) -> None:
        called.append(own)
        timers[1 - own].cancel()

    timers += [graph.probe.create_timer(0.02, lambda own=own: cancel_other(own)) for own in (0, 1)]
    time.sleep(0.05)
    graph.spin_for(0.1)
    assert len(set(called)) == 1
    for timer in timers:
        graph.probe.destroy_timer(timer)


def test_what_was_ready_is_called_by_whoever_spins_next(graph: Any) -> None:
    """With another time-out too, for which rclpy waits anew."""
    called: list[int] = []
    guards = [graph.probe.create_guard_condition(lambda n=n: called.append(n)) for n in (0, 1, 2)]
    graph.spin_for(0.1)
    for guard in guards:
        guard.trigger()
    for timeout_s in (0.05, 0.06, 0.07):
        graph.executor.spin_once(timeout_sec=timeout_s)
    assert sorted(called) == [0, 1, 2]


def test_what_another_thread_is_about_to_destroy_ends_no_wait(graph: Any, monkeypatch: Any) -> None:
    """It has asked for it, and comes to tell the executor only later."""
    probe, numbers = graph.probe, []
    # with callbacks for its events, which the probe leaves out
    subscription = Node.create_subscription(probe, Float64, "/number", numbers.append, 1)
    guard = probe.create_guard_condition(lambda: numbers.append(None))
    graph.spin_for(0.1)
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(graph.executor, "wake", lambda: None)
        guard.trigger()
        probe.destroy_guard_condition(guard)
        probe.destroy_subscription(subscription)
        graph.executor.spin_once(timeout_sec=0.05)
    assert not numbers
    assert probe.count_subscribers("/number") == 0


def test_callbacks_that_await_one_another_go_on_at_once(graph: Any) -> None:
    """The one that is asked first awaits the one asked last; the wait set stays all the time."""
    node, gate, first, ended = graph.add(Doubler), Future(), Future(), []

    async def wait_for_gate() -> None:
        await gate
        first.set_result(None)

    async def wait_for_first() -> None:
        await first
        ended.append(1)

    def wakes(callback: Any) -> None:
        guard = node.create_guard_condition(callback, node.async_group)
        guard.trigger()
        graph.spin_for(0.1)

    node._diagnostics._timer.cancel()  # nothing else is to come
    wakes(wait_for_gate)
    wakes(wait_for_first)
    kept = graph.executor._kept
    graph.spin_for(0.1)
    assert graph.executor._kept is kept is not None
    assert len(graph.executor._pending()) == 2
    begin_s = time.monotonic()
    last = node.create_guard_condition(lambda: gate.set_result(None))
    last.trigger()
    while not ended and time.monotonic() - begin_s < LONG_S:
        graph.executor.spin_once(timeout_sec=LONG_S)
    assert ended
    assert time.monotonic() - begin_s < LONG_S / 2


def test_a_callback_that_awaits_holds_back_its_group_alone(graph: Any) -> None:
    node, gate, begun, rest = graph.add(Doubler), Future(), [], []

    async def waits() -> None:
        timer.cancel()
        begun.append(1)
        await gate

    timer = node.create_timer(0.01, waits)
    held = node.create_timer(0.01, lambda: rest.append("held"))
    free = node.create_timer(0.01, lambda: rest.append("free"), callback_group=node.async_group)
    graph.spin_until(lambda: begun)
    rest.clear()
    turns = graph.executor.turn
    graph.spin_until(lambda: len(rest) > 10)
    assert "held" not in rest
    assert graph.executor.turn - turns < 10 * len(rest)  # it waits, though one is due that may not
    gate.set_result(None)
    graph.spin_until(lambda: "held" in rest)
    for one in (held, free):
        node.destroy_timer(one)


def test_a_node_that_is_taken_out_is_not_called_until_it_is_back(graph: Any) -> None:
    node = graph.add(Doubler)
    number = graph.publisher(Float64, "/number")
    graph.executor.remove_node(node)
    number.publish(Float64(data=1.0))
    graph.spin_for(0.2)
    assert node.inputs["number"].received == 0
    graph.executor.add_node(node)
    graph.spin_until(lambda: node.inputs["number"].received == 1)


def test_an_action_server_that_its_own_goal_takes_down_answers_it(graph: Any) -> None:
    """It goes as its callback ends, not in the middle of it."""
    probe = graph.probe

    def accept(goal: Any) -> GoalResponse:
        server.destroy()
        return GoalResponse.REJECT

    server = ActionServer(probe, MeasureTool, "/measure", print, goal_callback=accept)
    client = ActionClient(probe, MeasureTool, "/measure")
    graph.spin_until(client.server_is_ready)
    graph.spin_for(DISCOVERY_S)
    assert not graph.awaited(client.send_goal_async(MeasureTool.Goal())).accepted
    graph.spin_until(lambda: not client.server_is_ready())


def test_no_wake_up_of_another_thread_is_lost(graph: Any) -> None:
    """Each is answered before the next is made, beside messages; one that is lost takes LONG_S."""
    probe, rounds = graph.probe, 2000
    answered, answers, heard = threading.Semaphore(0), [], []
    guard = probe.create_guard_condition(lambda: (answers.append(1), answered.release()))
    number = graph.publisher(Float64, "/number", subscribers=0)
    probe.create_subscription(Float64, "/number", heard.append, ALL)
    graph.spin_until(number.get_subscription_count)
    late: list[int] = []

    def triggers() -> None:
        for n in range(rounds):
            if n % 20 == 0:
                number.publish(Float64(data=float(n)))
            guard.trigger()
            if not answered.acquire(timeout=LONG_S / 2):
                late.append(n)
                return

    other = threading.Thread(target=triggers)
    other.start()
    while not late and len(answers) < rounds:
        graph.executor.spin_once(timeout_sec=LONG_S)
    other.join()
    assert not late
    graph.spin_until(lambda: len(heard) == rounds // 20)


def test_entities_and_nodes_come_and_go_while_it_spins(graph: Any) -> None:
    """Another thread makes and destroys them: none of what stays is lost, nothing is raised."""
    probe, heard, sent, rounds = graph.probe, [], [], 200
    probe.create_subscription(Float64, "/number", heard.append, ALL)
    number = graph.publisher(Float64, "/number")
    failed: list[BaseException] = []

    def changes() -> None:
        try:
            for n in range(rounds):
                number.publish(Float64(data=float(n)))
                sent.append(float(n))
                # with callbacks for its events, which the probe leaves out
                subscription = Node.create_subscription(probe, Float64, "/number", id, 1)
                timer, guard = probe.create_timer(1e-3, int), probe.create_guard_condition(int)
                guard.trigger()
                if n % 10 == 0:
                    node = Node("passing", context=graph.context, start_parameter_services=False)
                    graph.executor.add_node(node)
                    graph.executor.remove_node(node)
                    node.destroy_node()
                probe.destroy_guard_condition(guard)
                probe.destroy_timer(timer)
                probe.destroy_subscription(subscription)
        except BaseException as error:
            failed.append(error)

    other = threading.Thread(target=changes)
    other.start()
    graph.spin_until(lambda: not other.is_alive())
    graph.spin_until(lambda: len(heard) == rounds)
    assert not failed
    assert [message.data for message in heard] == sent


def test_entities_are_gathered_without_the_executors_lock(graph: Any, monkeypatch: Any) -> None:
    """For that takes one of rclpy's, under which another thread that adds a node takes this one."""
    executor, nodes, free = graph.executor, graph.executor.get_nodes, []

    def try_lock() -> None:
        if executor._lock.acquire(timeout=1.0):
            free.append(True)
            executor._lock.release()

    def gather() -> Any:
        other = threading.Thread(target=try_lock)
        other.start()
        other.join()
        return nodes()

    monkeypatch.setattr(executor, "get_nodes", gather)
    executor.wake()
    executor.spin_once(timeout_sec=0.05)
    assert free
