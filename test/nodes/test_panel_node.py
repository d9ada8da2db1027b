# SPDX-License-Identifier: Apache-2.0
"""panel_node over DDS: what maintenance_node says reaches the page, and decisions reach it."""

import contextlib
import json
import logging
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from robocal_msgs.msg import AccuracyState, CorrectionStatus, MaintenanceStatus
from std_srvs.srv import Trigger
from test_maintenance_calls import Plc, candidates, process

from bench.live.opc_ua import ENGINEER, OPERATOR, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.panel.node import PanelNode
from robocal_ros.panel.server import ANSWER_S, TOKEN
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import trigger_text


class Page:
    """A node, and a browser's requests to it while the graph goes on."""

    def __init__(self, graph: Any, folder: Path | None, loop: Any) -> None:
        self.graph, self.folder, self.port, self.loop = graph, folder, free_port(), loop
        self.node = self.start()
        scheme = "https" if folder else "http"
        self.url, self.token = f"{scheme}://127.0.0.1:{self.port}", ""
        self.http = self.do(self._open())
        graph.spin_until(lambda: not self.node._server.trouble, "it listens")

    def start(self) -> Any:
        given = {"page_port": self.port}
        if self.folder is not None:
            given |= {"security_dir": str(self.folder)}
        return self.graph.add(PanelNode, given)

    async def _open(self) -> aiohttp.ClientSession:
        return aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.graph.meanwhile(self.loop, work)

    async def ask(self, path: str, body: Any) -> tuple[int, Any]:
        headers = {"Origin": self.url, TOKEN: self.token}
        async with self.http.post(self.url + path, json=body, headers=headers, ssl=False) as answer:
            return answer.status, await answer.json()

    async def event(self, wanted: Callable[[Any], bool], name: str = "state") -> Any:
        """The first event that is wanted."""
        async with self.http.get(f"{self.url}/events", ssl=False) as answer:
            kind = ""
            async for line in answer.content:
                field, _, rest = line.decode().rstrip().partition(": ")
                if field == "event":
                    kind = rest
                elif field == "data" and kind == name and wanted(json.loads(rest)):
                    return json.loads(rest)

    def post(self, path: str, **body: Any) -> tuple[int, Any]:
        """Asked again, as a person does, where a busy machine does not answer in time."""
        for _ in range(5):
            number, answer = self.do(self.ask(path, body))
            if number != 504:
                break
        return number, answer

    def until(self, wanted: Callable[[Any], bool], name: str = "state") -> Any:
        return self.do(self.event(wanted, name))

    def login(self, user: tuple[str, str]) -> None:
        assert self.post("/login", name=user[0], password=user[1])[0] == 200

        async def about() -> str:
            async with self.http.get(f"{self.url}/session", ssl=False) as answer:
                return str((await answer.json())["token"])

        self.token = self.do(about())

    def close(self) -> None:
        self.do(self.http.close())


@pytest.fixture
def loop() -> Iterator[Any]:
    from panel_page import Loop

    logging.getLogger("aiohttp").setLevel(logging.CRITICAL)
    made = Loop()
    yield made
    made.close()


def test_a_shift_at_the_page(graph, loop, tmp_path):
    """Reading, a gap, a decision that the history knows, a fault, maintenance_node killed."""
    plc = Plc(graph, lambda: process(graph, mortal=True))
    page = Page(graph, security_folder(tmp_path), loop)
    first = page.until(lambda told: told["headline"] != "SILENT")
    said = plc.states[-1]
    assert (first["serial"], first["maintenance"]) == ("K7", "IDLE")
    assert first["headline"] == "FAULT"  # nothing to measure is configured: a person must look
    assert first["tasks"][0]["detail"] == said.reason

    page.login(OPERATOR)
    for _ in range(10):  # a busy machine has late joint states, with which none begins
        number, answer = page.post("/act/run")
        if answer["done"]:
            break
        graph.spin_for(1.0)
    assert (number, answer["done"]) == (200, True), answer
    ended = page.until(lambda told: told["last"] is not None)
    assert ended["last"]["code"] == "ACCEPT"
    assert ended["shift"]["gaps"] == 1
    assert page.post("/act/cancel") == (200, {"done": False, "message": "no cycle runs"})
    (first_id, second_id) = candidates(graph, 2)
    assert page.post("/act/accept", id=second_id)[0] == 403

    page.login(ENGINEER)
    shown = page.until(lambda told: len(told["results"]) == 2, "history")
    assert {row["state"] for row in shown["results"]} == {"pending"}
    page.until(lambda told: told["waiting"] == [second_id])
    refused = page.post("/act/accept", id=99)
    assert (refused[0], refused[1]["done"]) == (200, False)
    assert page.post("/act/reject", id=first_id, reason="older")[1]["done"]
    assert page.post("/act/accept", id=second_id, reason="drift")[1]["done"]
    shown = page.until(lambda told: told["in_force"] == [second_id], "history")
    with CalibrationHistory.open("K7", state_dir=graph.state) as history:
        last = history.decisions(1)[0]
        assert (last.calibration_id, last.by, last.reason) == (second_id, "ada", "drift")
        listed = json.loads(json.dumps([entry.document() for entry in history.list()]))
    assert shown["results"] == listed

    plc.q = plc.q + 0.1  # the robot is not at home any more
    graph.spin_for(0.3)
    assert plc.run("away").status == Code.LIMIT_EXCEEDED
    fault = page.until(lambda told: told["headline"] == "FAULT" and told["maintenance"] == "FAULT")
    assert fault["tasks"][0]["key"] == "LIMIT_EXCEEDED/fault"
    assert not page.post("/act/acknowledge")[1]["done"]  # not where it stands
    plc.q = plc.q - 0.1
    graph.spin_for(0.3)
    assert page.post("/act/acknowledge")[1]["done"]
    page.until(lambda told: told["maintenance"] == "IDLE")

    plc.node.kill()
    silent = page.until(lambda told: told["headline"] == "SILENT")
    assert (silent["maintenance"], silent["bound_mm"]) == (None, None)
    plc.node = process(graph)
    page.until(lambda told: told["headline"] != "SILENT")
    page.close()


def test_a_page_that_is_started_anew_trusts_no_latched_message(graph, loop):
    """The publishers are there, and say nothing more: a node that hangs."""
    accuracy = graph.probe.create_publisher(AccuracyState, "accuracy_state", endpoints.LATCHED)
    status = graph.probe.create_publisher(
        MaintenanceStatus, "maintenance_node/status", endpoints.LATCHED
    )

    def say() -> None:
        for publisher, message in (
            (accuracy, AccuracyState(state=AccuracyState.OK, bound_mm=0.1, serial="K7")),
            (status, MaintenanceStatus(state=MaintenanceStatus.IDLE)),
        ):
            message.header.stamp = graph.probe.get_clock().now().to_msg()
            publisher.publish(message)

    page = Page(graph, None, loop)
    timer = graph.probe.create_timer(0.2, say)
    assert page.until(lambda told: told["headline"] == "OK")["bound_mm"] == 0.1
    timer.cancel()
    graph.executor.remove_node(page.node)
    graph._nodes.remove(page.node)
    page.node.close()
    page.node = page.start()
    graph.spin_until(
        lambda: page.node._server.panel.sources["accuracy_state"].values, "the latched one"
    )
    graph.spin_for(0.5)
    assert page.do(page.event(lambda told: True))["headline"] == "SILENT"
    timer.reset()
    page.until(lambda told: told["headline"] == "OK")
    page.close()


def test_requests_hold_up_no_executor_and_nothing_is_passed_on_late(graph, loop, tmp_path):
    called: list[Any] = []

    def cancel(request: Any, response: Any) -> Any:
        called.append(request)
        response.success, response.message = True, trigger_text(0, Code.ACCEPT, "cancelled")
        return response

    graph.probe.create_service(Trigger, "maintenance_node/cancel_trigger", cancel)
    page = Page(graph, security_folder(tmp_path), loop)
    page.login(OPERATOR)
    graph.spin_until(page.node._calls._clients["cancel_trigger"].service_is_ready, "the service")
    graph.spin_for(0.3)
    assert page.post("/act/cancel") == (200, {"done": True, "message": "cancelled"})
    called.clear()
    # nothing of the node runs meanwhile, and the page answers all the same
    assert loop.do(page.ask("/act/cancel", {}))[0] == 504
    began_s = time.monotonic()
    with contextlib.suppress(TimeoutError):
        loop.start(page.event(lambda told: True)).result(5.0)
    assert time.monotonic() - began_s < 2.0
    graph.spin_for(ANSWER_S)
    assert not called
    absent = {"done": False, "message": "maintenance_node is not there: start it"}
    assert page.post("/act/run") == (200, absent)
    page.node.trigger_deactivate()
    graph.spin_for(0.2)
    inactive = {"done": False, "message": "panel_node is inactive: activate it"}
    assert page.post("/act/cancel") == (200, inactive)
    assert page.do(page.event(lambda told: True))  # it shows on
    page.close()


def test_whatever_is_published_ends_nothing(graph, loop):
    page = Page(graph, None, loop)
    publisher = graph.publisher(AccuracyState, "accuracy_state", endpoints.LATCHED)
    others = graph.publisher(MaintenanceStatus, "maintenance_node/status", endpoints.LATCHED)
    corrections = graph.publisher(
        CorrectionStatus, "joint_correction_node/status", endpoints.LATCHED
    )
    for k in range(1, 30):
        hostile = AccuracyState(
            state=k % 256, bound_mm=float("nan"), predicted_error_mm=float("inf"),
            due_in_s=float("-inf"), reason="<script>" * 5000, serial="../../etc" * k,
        )  # fmt: skip
        hostile.header.stamp.sec = k
        told = MaintenanceStatus(state=9 * k % 256, fault_code=k * 8, doing="x" * 100_000)
        told.header.stamp.sec = k
        told.last.cycle_id, told.last.code = f"c{k}", 255
        told.last.left, told.last.accepted = ["y" * 10_000] * 500, [7] * 5000
        for sender, message in ((publisher, hostile), (others, told)):
            sender.publish(message)
        corrections.publish(CorrectionStatus(state=200, reason="z" * 10_000))
        graph.spin_for(0.02)
    shown = page.until(lambda told: told["headline"] == "FAULT")
    assert len(json.dumps(shown)) < 100_000
    assert (shown["bound_mm"], shown["due_in_s"]) == (None, None)
    page.close()


def test_what_it_does_not_start_with(graph, tmp_path):
    node = graph.add(PanelNode, {"security_dir": str(tmp_path), "page_port": free_port()})
    assert node.state == "unconfigured"
    assert "server.der" in node._failure.message
    node = graph.add(PanelNode, {"address": "my.host", "page_port": free_port()})
    assert node.state == "unconfigured"
    assert "is no IP address" in node._failure.message
