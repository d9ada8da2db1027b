# SPDX-License-Identifier: Apache-2.0
"""Harness of the node tests: a graph of its own for each test, spun in the test's own thread."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from trajectory_msgs.msg import JointTrajectory

from bench.processes import ENDS_WITH_PARENT
from robocal_ros.ros import endpoints
from robocal_ros.ros.executor import OneThreadExecutor

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(Path(__file__).parent))  # some tests share helpers of another
from domains import free_domain  # noqa: E402
from forked import ForkedScript  # noqa: E402
from jumps import JumpError  # noqa: E402
from trajectory_controllers import missing_packages  # noqa: E402

EXECUTABLES = ROOT / "install" / "robocal_ros" / "lib" / "robocal_ros"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
LEASE = "<leaseDuration><sec>2</sec></leaseDuration>"
# The arm of most tests' worlds, where a test names none.
ROBOTS = {
    name: {"robot": robot}
    for robot, names in {
        "kr150_r3100": ("thermal_node", "joint_correction_node"),
        "ur10": ("tcf_node", "hand_eye_node", "maintenance_node"),
    }.items()
    for name in names
}
NO_CALL = SimpleNamespace(id="")  # of a test without parameters
DEADLINE_S = 30.0  # of what takes a second, on a machine that is busy otherwise
ENDS_WITHIN_S = 10.0
DISCOVERY_S = 0.25
GONE_WITHIN_S = 0.25  # of another one
LEAVES_WITHIN_S = 3.0
TRIES = 8
SHOWN_OF_RERUN = 3000
LATE_S = 0.03  # half of what stops begin ahead of now
CALM_S, CALM_SHARE, CALM_WITHIN_S = 0.5, 0.5, 10.0  # a share of waits is usual


# All nodes of a cell at once, which take more than a core: first, so that xdist gives them to one
# process, one after the other, and none starves another.
WHOLE_CELLS = {
    "test_demo", "test_fault_matrix", "test_fixture_cell", "test_plc_killed", "test_tool_cell",
}  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here, missing = Path(__file__).parent, missing_packages()
    no_controller = pytest.mark.skip(
        reason=f"ros2_control is not installed: no {', '.join(missing)}"
    )
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.ros)
            # Not when it runs: a graph that ends while DDS is still discovering it may crash.
            if missing and "real" in getattr(item, "callspec", NO_CALL).id.split("-"):
                item.add_marker(no_controller)
            # other examples in a second try would hide what was found
            if isinstance(item, pytest.Function) and hasattr(item.module, "given"):
                item.add_marker(pytest.mark.flaky(reruns=0))
    items.sort(key=lambda item: item.path.stem not in WHOLE_CELLS)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Tell why a test was run again: what it counts on can be mended only if it is seen."""
    for report in terminalreporter.stats.get("rerun", []):
        terminalreporter.section(f"run again: {report.nodeid}")
        terminalreporter.write_line(report.longreprtext[-SHOWN_OF_RERUN:])


Waits = dict[str, int]


def waits_of(pid: int | str) -> Waits:
    """For how long each thread of a process was to run and had no core, ns (sched-stats.rst).

    Those of DDS too: a message goes through them before a node takes it.
    """
    found = {}
    for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            found[file.parent.name] = int(file.read_text().split()[1])
    return found


class Executable:
    """A node that runs as its own process, at most as long as the one that starts it.

    ``forked``: a script of the install tree, from a process that has read its code already.
    """

    def __init__(
        self, name: str, command: list[str], environment: dict[str, str], *, forked: bool = False
    ) -> None:
        self.name, self._waits = name, Waits()
        self._log = tempfile.NamedTemporaryFile("w+")  # noqa: SIM115 (closed by stop)
        self.process: subprocess.Popen[str] | ForkedScript
        if forked:
            self.process = ForkedScript(command, environment, Path(self._log.name))
        else:
            self.process = subprocess.Popen(
                [*ENDS_WITH_PARENT, *command],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=subprocess.STDOUT,
            )

    @property
    def output(self) -> str:
        """What the process wrote so far."""
        self._log.seek(0)
        return self._log.read()

    @property
    def waits(self) -> Waits:
        """As `waits_of`, as far as that was seen before it ended."""
        if self.process.poll() is None:
            self._waits = waits_of(self.process.pid)
        return self._waits

    def kill(self) -> None:
        """End it as a power cut would."""
        self.process.kill()
        self.process.wait(DEADLINE_S)  # an error beats a run that hangs for good

    def stop(self, by: signal.Signals = signal.SIGINT) -> int:
        """Ask it to end, and return its exit status; one that stays is a failure."""
        if self.process.poll() is None:
            self.process.send_signal(by)
        try:
            return self.process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.kill()
            pytest.fail(f"{self.name} did not end at {by.name}:\n{self.output}")

    def close(self) -> None:
        """Make sure that it is gone."""
        if self.process.poll() is None:
            self.kill()
        self._log.close()


class Probe(Node):
    """Nobody reads what the middleware warns of at its endpoints, and each look for it costs time:
    rclpy adds two entities of each to every wait.
    """

    def create_publisher(self, *given: Any, **named: Any) -> Publisher:
        """Without callbacks for its events."""
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*given, **({"event_callbacks": quiet} | named))

    def create_subscription(self, *given: Any, **named: Any) -> Subscription:
        """Without callbacks for its events."""
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        return super().create_subscription(*given, **({"event_callbacks": quiet} | named))


def destroy_actions(node: Node) -> None:
    """What the traceback of a failed test keeps would command the next one's robot."""
    for waitable in list(node.waitables):
        if isinstance(waitable, (ActionClient, ActionServer)):
            waitable.destroy()


class Graph:
    """One ROS graph: nodes in this process, executables beside it, and a probe that talks to them.

    Nothing runs by itself: nodes of this process work only inside ``spin_until``, ``spin_for``
    and ``call``.
    """

    def __init__(self, domain: int, state: Path) -> None:
        self.domain = domain
        self.state = state
        self.context = Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.probe = Probe("probe", context=self.context, start_parameter_services=False)
        self.executor = OneThreadExecutor(context=self.context)
        self.executor.add_node(self.probe)
        self._environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROBOCAL_STATE": str(state),
            "PYTHONUNBUFFERED": "1",
        }
        profiles = (ROOT / "tools" / "fastdds.xml").read_text()
        self._short_lease = state.parent / "short_lease.xml"
        self._short_lease.write_text(profiles.replace("<leaseAnn", f"{LEASE}<leaseAnn"))
        self._nodes: list[Any] = []
        self._others: list[Any] = []
        self._apart = False  # whether there was another participant
        self._clients: dict[str, Any] = {}
        self._executables: list[Executable] = []
        self.at_close: list[Callable[[], None]] = []  # before all else

    def add(
        self, node_class: type, parameters: dict[str, Any] | None = None, **options: Any
    ) -> Any:
        """Start a house node in this process, as ``run`` would."""
        self._forget_clients()
        given = ROBOTS.get(getattr(node_class, "NAME", ""), {}) | (parameters or {})
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        node = node_class(
            context=self.context,
            parameter_overrides=overrides,
            use_global_arguments=False,
            **options,
        )
        self._nodes.append(node)
        self.executor.add_node(node)
        node.autostart()
        return node

    def start(
        self,
        executable: str | Path,
        parameters: dict[str, Any] | None = None,
        remap: dict[str, str] | None = None,
        *arguments: str,
        mortal: bool = False,
    ) -> Executable:
        """Start an executable of the install tree (or a script); it is ended with the test.

        ``arguments``: given as they are, a parameter file with the robot among them.
        ``mortal``: DDS misses it 2 s after it was killed, not 20 s.
        """
        self._forget_clients()
        given = ({} if arguments else ROBOTS.get(str(executable), {})) | (parameters or {})
        ros = [f"-p{name}:={value}" for name, value in given.items()]
        ros += [f"-r{old}:={new}" for old, new in (remap or {}).items()]
        ros_arguments = [item for pair in ros for item in (pair[:2], pair[2:])]
        script = str(EXECUTABLES / executable)
        environment = self._environment | ({PROFILES: str(self._short_lease)} if mortal else {})
        command = [script, *arguments, "--ros-args", *ros_arguments]
        return self._started(Executable(str(executable), command, environment, forked=True))

    def run(self, name: str, command: list[str]) -> Executable:
        """Start any command; it is ended with the test."""
        return self._started(Executable(name, command, self._environment))

    def _started(self, process: Executable) -> Executable:
        self._apart = True
        self._executables.append(process)
        return process

    def other(self, name: str, kind: type[Node] = Node) -> Any:
        """A node of a DDS participant of its own, as another process has; it ends with the test."""
        self._apart, context = True, Context()
        rclpy.init(args=[], context=context, domain_id=self.domain)
        self._others.append(kind(name, context=context))
        return self._others[-1]

    def end(self, other: Any) -> None:
        """End what `other` has made, before the test ends."""
        self._others.remove(other)
        destroy_actions(other)
        other.destroy_node()
        other.context.try_shutdown()

    @property
    def waits(self) -> list[Waits]:
        """Of this process, which plays what is not there, and of all executables."""
        return [waits_of("self"), *(one.waits for one in self._executables)]

    def starved_s(self, since: list[Waits]) -> float:
        """For how long processes had no core since then: each that thread which waited longest.

        What a thread did itself meanwhile, a stall of its own, does not count.
        """
        longest = (
            max((ns - before.get(thread, ns) for thread, ns in now.items()), default=0)
            for now, before in zip(self.waits, since, strict=False)
        )
        return 1e-9 * sum(longest)

    def calm(self) -> None:
        """Wait until nobody waits most of the time for a core, as others do that start."""
        ends = time.monotonic() + CALM_WITHIN_S
        while time.monotonic() < ends:
            before = self.waits
            self.spin_for(CALM_S)
            if self.starved_s(before) < CALM_SHARE * CALM_S:
                return

    def undisturbed(self, trial: Callable[[], None]) -> None:
        """Try anew what jumped while a process waited for a core: once heard late, any plan jumps.

        What jumps while none did is a fault.
        """
        for _ in range(TRIES):
            before = self.waits
            try:
                return trial()
            except JumpError as error:
                waited_s = self.starved_s(before)
                if waited_s < LATE_S:
                    raise
                jumped = error
                self.calm()
        raise AssertionError(f"each of {TRIES} tries, in the last {waited_s:.3f} s") from jumped

    def spin_until(
        self, condition: Callable[[], object], what: str = "", within_s: float = DEADLINE_S
    ) -> None:
        """Let the graph work until the condition holds; fail at the deadline."""
        deadline = time.monotonic() + within_s
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0:
                logs = "".join(f"\n--- {e.name}:\n{e.output}" for e in self._executables)
                pytest.fail(f"not within {within_s} s: {what or condition}{logs}")
            self.executor.spin_once(timeout_sec=min(left, 0.05))

    def awaited(self, future: Any, what: str = "", within_s: float = DEADLINE_S) -> Any:
        """Let the graph work until a future is done; its result."""
        self.spin_until(future.done, what, within_s)
        return future.result()

    def spin_for(self, seconds: float) -> None:
        """Let the graph work for a time, to show that something does not happen."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            # The same time-out again and again: with another one rclpy begins anew, with tasks
            # that wait, and comes to nothing else.
            self.executor.spin_once(timeout_sec=min(left, 0.05))

    def client(self, kind: type, name: str, within_s: float = DEADLINE_S) -> Any:
        """A client of a service that is there and has discovered it."""
        self.discover({name: kind}, within_s)
        return self._clients[name]

    def discover(self, kinds: Mapping[str, type], within_s: float = DEADLINE_S) -> None:
        """Have clients of services by their names, so that calls take no time later."""
        new = [name for name in kinds if name not in self._clients]
        self._clients |= {name: self.probe.create_client(kinds[name], name) for name in new}
        clients = [self._clients[name] for name in kinds]
        ready = lambda: all(client.service_is_ready() for client in clients)  # noqa: E731
        self.spin_until(ready, f"services {', '.join(kinds)} appear", within_s)
        if not all(self._serves(self._clients[name].service_name) for name in new):
            # A server drops its answer to a client that it has not discovered itself yet.
            self.spin_for(DISCOVERY_S)
            self.spin_until(ready, f"services {', '.join(kinds)} appear", within_s)

    def _serves(self, name: str) -> bool:
        """Whether a node of this participant does: nothing of it has to be discovered."""
        nodes = (self.probe, *self._nodes)
        return name in {service.service_name for node in nodes for service in node.services}

    def call(self, kind: type, name: str, within_s: float = DEADLINE_S, **fields: Any) -> Any:
        """Call a service, waiting for it to appear, and return its response."""
        asked = self.client(kind, name, within_s).call_async(kind.Request(**fields))
        return self.awaited(asked, f"service {name} answers", within_s)

    def meanwhile(self, client: Any, work: Any) -> Any:
        """What a coroutine gives that a client runs in its own loop while the graph goes on."""
        return self.awaited(client.start(work), "what a client does", 70.0)

    def _forget_clients(self) -> None:
        """A node that starts has to discover whom it answers."""
        for client in self._clients.values():
            self.probe.destroy_client(client)
        self._clients.clear()

    def collect(
        self, kind: type, topic: str, profile: QoSProfile = endpoints.RELIABLE
    ) -> list[Any]:
        """Subscribe; return the list that gathers what arrives."""
        inbox: list[Any] = []
        self.probe.create_subscription(kind, topic, inbox.append, endpoints.own(profile))
        return inbox

    def publisher(
        self, kind: type, topic: str, profile: QoSProfile = endpoints.RELIABLE, subscribers: int = 1
    ) -> Publisher:
        """Publish as the probe, once so many subscribers are there."""
        publisher = self.probe.create_publisher(kind, topic, endpoints.own(profile))
        self.spin_until(
            lambda: publisher.get_subscription_count() >= subscribers,
            f"{subscribers} subscribers of {topic}",
        )
        return publisher

    def drive(
        self, topic: str, message: JointTrajectory, moves: Callable[[], object], subscribers: int
    ) -> None:
        """Command a robot as a person does: again, until it moves.

        A controller reads the topic as best effort, and may yet be to find a new publisher that
        has found it.
        """
        drive = self.publisher(JointTrajectory, topic, subscribers=subscribers)
        for _ in range(3):
            drive.publish(message)
            until_s = time.monotonic() + 1.0
            while not moves() and time.monotonic() < until_s:
                self.spin_for(0.02)
            if moves():
                break
        self.probe.destroy_publisher(drive)  # nobody else commands while the cell does

    def close(self) -> None:
        """End everything."""
        for ended in self.at_close:
            ended()
        for other in list(self._others):
            self.end(other)
        # Fast DDS crashes, once in 40 times, where a participant ends soon after others that it
        # knows were killed: who can leaves by itself.
        for executable in self._executables:
            executable.process.send_signal(signal.SIGINT)  # nothing where it has ended
        until_s = time.monotonic() + LEAVES_WITHIN_S
        for executable in self._executables:
            with contextlib.suppress(subprocess.TimeoutExpired):
                executable.process.wait(max(until_s - time.monotonic(), 0.0))
            executable.close()
        for node in self._nodes:
            self.executor.remove_node(node)
            node.close()
        self.executor.shutdown()
        destroy_actions(self.probe)
        # Nor just as it learns that another one has. One that was killed stays known for long.
        known, until_s = self.probe.get_node_names(), time.monotonic() + GONE_WITHIN_S
        while self._apart and len(known) > 1 and time.monotonic() < until_s:
            time.sleep(0.01)
            if (names := self.probe.get_node_names()) != known:
                known, until_s = names, time.monotonic() + GONE_WITHIN_S
        self.probe.destroy_node()
        self.context.try_shutdown()


@contextlib.contextmanager
def private_graph(state: Path) -> Iterator[Graph]:
    """A graph with its own domain; nodes of other processes keep their state in the folder."""
    with free_domain() as domain:
        graph = Graph(domain, state)
        try:
            yield graph
        finally:
            graph.close()
            del graph
            gc.collect()  # what of DDS is held in a cycle ends now, when nobody discovers anything


@pytest.fixture
def graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    """A private graph, with its own domain and its own state folder (``ROBOCAL_STATE``)."""
    state = tmp_path / "state"
    monkeypatch.setenv("ROBOCAL_STATE", str(state))
    with private_graph(state) as made:
        yield made


@pytest.fixture(scope="module")
def next_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], Graph]]:
    """Makes a graph for several tests of a module; the one before it ends."""
    with contextlib.ExitStack() as last:

        def begin() -> Graph:
            last.close()
            return last.enter_context(private_graph(tmp_path_factory.mktemp("state")))

        yield begin
