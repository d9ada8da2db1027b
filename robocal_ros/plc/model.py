# SPDX-License-Identifier: Apache-2.0
"""The cell in OPC UA: what is shown, what may be called, what may be written, and its types.

All nodes have names as identifiers (``ns=2;s=Cell.Accuracy.State``), which stay. Of a message that
is shown only its attributes are read: nothing here knows ROS.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import attrgetter
from typing import Any

from asyncua import Node, Server, ua

from robocal_ros.ground.errors import Code
from robocal_ros.plc.access import Role

NAMESPACE = "urn:robocal_ros:cell"
CELL, METHODS_NODE, GAP, BEAMS = "Cell", "Cell.Methods", "Cell.Gap", "Cell.Beams"
HEARTBEAT, BLOCKED, TIME = f"{GAP}.Heartbeat", "Blocked", "Time"
ACTIVE = f"{CELL}.Active"
CODE = "Code"
MM = 1e3
LONGEST_SHOWN = 254  # bytes of UTF-8, so that a STRING(254) takes them
LONGEST_TEXT = 1000
# Silent for so long a variable is Uncertain: its last value, which nobody stands by any more.
SILENT = ua.StatusCodes.UncertainNoCommunicationLastUsableValue
AWAITED = ua.StatusCodes.BadWaitingForInitialData
# How a kind is sent, and what stands there before there is any.
TYPES: Mapping[str, tuple[ua.VariantType, object]] = {
    "Boolean": (ua.VariantType.Boolean, False),
    "UInt32": (ua.VariantType.UInt32, 0),
    "Double": (ua.VariantType.Double, 0.0),
    "String": (ua.VariantType.String, ""),
    "DateTime": (ua.VariantType.DateTime, datetime(1970, 1, 1, tzinfo=UTC)),
}
ENUMERATION = ua.VariantType.Int32, 0  # (OPC 10000-3, 8.14)


def time_of(stamp: Any) -> datetime:
    """A message's stamp."""
    return datetime.fromtimestamp(stamp.sec + 1e-9 * stamp.nanosec, UTC)


def _cut(text: str) -> str:
    """A text as long as a PLC's STRING can take it."""
    sent = text.encode()
    if len(sent) <= LONGEST_SHOWN:
        return text
    return sent[: LONGEST_SHOWN - 3].decode(errors="ignore") + "..."


@dataclass(frozen=True)
class Item:
    """A variable, or an argument of a method.

    ``kind``: of `TYPES`, or the name of an enumeration; ``[]`` at its end: a list. ``read``: its
    value in a message, or the name of an attribute; of an input the request's field.
    """

    name: str
    kind: str
    read: str | Callable[[Any], Any]
    description: str

    @property
    def is_array(self) -> bool:
        """Whether it is a list."""
        return self.kind.endswith("[]")

    @property
    def scalar(self) -> str:
        """The kind of one."""
        return self.kind.removesuffix("[]")

    @property
    def variant_type(self) -> ua.VariantType:
        """How it is sent."""
        return TYPES.get(self.scalar, ENUMERATION)[0]

    def value(self, message: Any) -> Any:
        """Its value in a message."""
        found = (attrgetter(self.read) if isinstance(self.read, str) else self.read)(message)
        if self.scalar == "String":
            return [_cut(text) for text in found] if self.is_array else _cut(found)
        return list(found) if self.is_array else found

    def variant(self, value: Any) -> ua.Variant:
        """As it is sent."""
        return ua.Variant(value, self.variant_type, is_array=self.is_array)

    def empty(self) -> ua.Variant:
        """Before there is any."""
        return self.variant([] if self.is_array else TYPES.get(self.scalar, ENUMERATION)[1])


@dataclass(frozen=True)
class Shown:
    """An object of variables that one message fills; ``silent_s``: it comes so often; 0: once."""

    name: str
    source: str
    description: str
    items: tuple[Item, ...]
    silent_s: float = 0.0


STATUS, ACCURACY, TOOL = "maintenance_node/status", "accuracy_state", "tcf_node/tool"
FIXTURE = "fixture_node/quality"
SILENT_S = 3.0  # maintenance_node says its status at 5 Hz, the accuracy at 1 Hz

SHOWN = (
    Shown(
        "Accuracy",
        ACCURACY,
        "How accurate the robot is believed to be now",
        (
            Item("State", "AccuracyLevel", "state", "OK, DUE, DEGRADED, EXPIRED, FAULT"),
            Item("PredictedErrorMm", "Double", "predicted_error_mm", "rms, mm; -1: not known"),
            Item("BoundMm", "Double", "bound_mm", "95 % are below, mm; -1: not known"),
            Item("ToleranceMm", "Double", "tolerance_mm", "The process allows, mm"),
            Item("DueInS", "Double", "due_in_s", "Until the next gap is due, s; < 0: overdue"),
            Item("Reason", "String", "reason", "The state in words"),
            Item("Robot", "String", "robot", "Type of the robot"),
            Item("Serial", "String", "serial", "Its serial number"),
        ),
        SILENT_S,
    ),
    Shown(
        "Maintenance",
        STATUS,
        "What maintenance does",
        (
            Item("State", "MaintenanceState", "state", "IDLE, RUNNING, BREAKING_OFF, FAULT"),
            Item("CycleId", "String", "cycle_id", "Cycle that runs, or ran last"),
            Item("Doing", "String", "doing", "What goes on, in words"),
            Item("LeftS", "Double", "left_s", "Until the gap's end, s"),
            Item("AtHome", "Boolean", "at_home", "The robot stands at home"),
            Item("Disarmed", "Boolean", "disarmed", "tcf_node is known to be disarmed"),
            Item("FaultCode", CODE, "fault_code", "What stopped it"),
            Item("Fault", "String", "fault", "In words"),
        ),
        SILENT_S,
    ),
    Shown(
        "LastCycle",
        STATUS,
        "How the cycle that ended last did; while one runs it is the one before: look at CycleId",
        (
            Item("CycleId", "String", "last.cycle_id", "Its id"),
            Item("Ended", "DateTime", lambda m: time_of(m.last.stamp), "When; node killed: begun"),
            Item("Run", "UInt32", "last.run", "The how many-th since the state folder was made"),
            Item("Code", CODE, "last.code", "ACCEPT: as planned; NONE: none has ended yet"),
            Item("Message", "String", "last.message", "In words"),
            Item("Complete", "Boolean", "last.complete", "Nothing is left for the next gap"),
            Item("Left", "String[]", "last.left", "What is left"),
            Item("ThermalCode", CODE, "last.thermal_code", "Verdict of the thermal cycle"),
            Item("ThermalId", "UInt32", "last.thermal_id", "Its candidate; 0: none"),
            Item("ToolFoundCode", CODE, "last.tool_found_code", "The tool as the gap began"),
            Item("ToolCode", CODE, "last.tool_code", "Verdict of the last tool measurement"),
            Item("ToolId", "UInt32", "last.tool_id", "Its candidate; 0: none"),
            Item("ToolAnswer", "ToolAnswer", "last.tool_answer", "Of the last quick check"),
            Item("FixtureCode", CODE, "last.fixture_code", "Verdict of the fixture"),
            Item("FixtureId", "UInt32", "last.fixture_id", "Its candidate; 0: none"),
            Item("StationCode", CODE, "last.station_code", "Of the beams that were found again"),
            Item("StationId", "UInt32", "last.station_id", "Their candidate; 0: none"),
            Item("Accepted", "UInt32[]", "last.accepted", "In force without a person"),
        ),
        SILENT_S,
    ),
    Shown(
        "Candidates",
        STATUS,
        "What waits for a decision, as last known; 0: nothing",
        (
            Item("ThermalId", "UInt32", "thermal_pending", "Newest thermal candidate"),
            Item("ToolId", "UInt32", "tool_pending", "Newest tool candidate"),
            Item("FixtureId", "UInt32", "fixture_pending", "Newest fixture candidate"),
        ),
        SILENT_S,
    ),
    Shown(
        "Gap",
        STATUS,
        "The handshake: the program copies Beat to Heartbeat while the robot may be moved",
        (Item("Beat", "UInt32", "beat", "Counts up five times a second; 0 is none"),),
        SILENT_S,
    ),
    Shown(
        "Tool",
        TOOL,
        "The tool's frame in force",
        (
            Item("Name", "String", "child_frame_id", "Its frame"),
            Item("State", "ToolState", "state", "CANDIDATE or ACCEPTED"),
            Item("Revision", "UInt32", "revision", "In the history; 0: taught"),
            Item("XMm", "Double", lambda m: MM * m.tool.translation.x, "In the flange, mm"),
            Item("YMm", "Double", lambda m: MM * m.tool.translation.y, "In the flange, mm"),
            Item("ZMm", "Double", lambda m: MM * m.tool.translation.z, "In the flange, mm"),
            Item("QuaternionXyzw", "Double[]", lambda m: _xyzw(m.tool.rotation), "x, y, z, w"),
        ),
    ),
    Shown(
        "Fixture",
        FIXTURE,
        "What its last measurement said",
        (
            Item("Code", CODE, "code", "ACCEPT: it has moved, or was taught"),
            Item("Id", "UInt32", "candidate_id", "Its candidate, decided or not; 0: none"),
            Item("Reason", "String", "reason", "In words, with what moved by how much"),
        ),
    ),
)


def _xyzw(q: Any) -> list[float]:
    return [q.x, q.y, q.z, q.w]


@dataclass(frozen=True)
class Method:
    """A call of maintenance_node's service of the same meaning; answered as that answers."""

    name: str
    service: str
    role: Role
    description: str
    inputs: tuple[Item, ...] = ()
    outputs: tuple[Item, ...] = ()


def _trigger_code(response: Any) -> int:
    return int(Code[response.message.split(" ", 2)[1]])


DONE = (
    Item("Success", "Boolean", "success", "Done"),
    Item("Status", CODE, "status", "ACCEPT when done, else why not"),
    Item("Message", "String", "message", "In words"),
)
DECIDED = (*DONE, Item("Revision", "UInt32", "revision", "In force afterwards; 0: nominal"))
DECISION = (
    Item("Id", "UInt32", "id", "The calibration"),
    Item("Reason", "String", "reason", "Kept in the history with the user's name"),
)
CYCLE = Item("CycleId", "String", "cycle_id", "Id of the cycle, 1 to 100 signs")
ENDED = (
    Item("ResultCode", CODE, "result.code", "NONE: it runs; how it ended"),
    Item("Complete", "Boolean", "result.complete", "Nothing is left for the next gap"),
)
METHODS = (
    Method(
        "Run",
        "run",
        Role.OPERATOR,
        "Begin a cycle; the same id again tells how it goes, and runs nothing twice",
        (CYCLE, Item("GapS", "Double", "gap_s", "Length of the gap, s: an upper bound")),
        (*DONE, Item("BeforeStart", "Boolean", "before_start", "An old result: nothing ran now"),
         *ENDED),
    ),
    Method(
        "Status",
        "status",
        Role.OPERATOR,
        "How a cycle ended; the last one where the id is empty",
        (CYCLE,),
        (
            *DONE,
            Item("State", "MaintenanceState", "state.state", "Of maintenance"),
            *ENDED,
            Item("ThermalId", "UInt32", "result.thermal_id", "Its candidate; 0: none"),
            Item("ToolId", "UInt32", "result.tool_id", "Its candidate; 0: none"),
        ),
    ),
    Method(
        "Cancel",
        "cancel_trigger",
        Role.OPERATOR,
        "Break the cycle off: the robot stops and is brought home",
        (),
        (DONE[0], Item("Status", CODE, _trigger_code, DONE[1].description), DONE[2]),
    ),
    Method("Accept", "accept", Role.ENGINEER, "Bring a candidate into force", DECISION, DECIDED),
    Method("Reject", "reject", Role.ENGINEER, "Rule a candidate out", DECISION, DECIDED),
    Method("Rollback", "rollback", Role.ENGINEER, "Return to an earlier one", DECISION, DECIDED),
    Method("Acknowledge", "acknowledge", Role.ENGINEER, "End a fault", (), DONE),
)  # fmt: skip


class InformationModel:
    """The nodes of one server, and their values.

    ``enumerations``: numbers by name, of each type; made from the messages' own constants.
    """

    def __init__(
        self, server: Server, enumerations: Mapping[str, Mapping[str, int]], beams: Sequence[str]
    ) -> None:
        self._server = server
        self._enumerations = enumerations
        self._beams = beams
        self._types: dict[str, ua.NodeId] = {}
        self._values: dict[str, ua.DataValue] = {}
        self._heard_s: dict[str, float] = {}
        self._index = 0
        self.methods: dict[ua.NodeId, Method] = {}
        self.writable: dict[ua.NodeId, str] = {}
        self.input_types: dict[str, ua.VariantType] = {}

    def node_id(self, path: str) -> ua.NodeId:
        """Of a name."""
        return ua.NodeId(path, self._index)

    def knows(self, node_id: ua.NodeId) -> bool:
        """Whether there is such a node."""
        return node_id in self._server.iserver.aspace

    async def build(self) -> None:
        """Make all nodes."""
        self._index = await self._server.register_namespace(NAMESPACE)
        for name, numbers in self._enumerations.items():
            await self._add_enumeration(name, numbers)
        cell = await self._add_object(self._server.nodes.objects, CELL)
        active = Item("Active", "Boolean", "", "The bridge acts: methods and the gap work")
        await self._add_variable(cell, ACTIVE, active)
        await self.set(ACTIVE, active.variant(False))
        for shown in SHOWN:
            parent = await self._add_object(cell, f"{CELL}.{shown.name}", shown.description)
            for item in shown.items:
                await self._add_variable(parent, f"{CELL}.{shown.name}.{item.name}", item)
        heartbeat = Item("Heartbeat", "UInt32", "", "Beat while the robot may be moved, else 0")
        await self._add_input(self._server.get_node(self.node_id(GAP)), HEARTBEAT, heartbeat)
        if self._beams:
            beams = await self._add_object(cell, BEAMS)
            for beam in self._beams:
                path = f"{BEAMS}.{beam}"
                one = await self._add_object(beams, path)
                blocked = Item(BLOCKED, "Boolean", "", "The beam is interrupted")
                when = Item(TIME, "DateTime", "", "When Blocked changed, for clients without times")
                await self._add_input(one, f"{path}.{BLOCKED}", blocked)
                await self._add_input(one, f"{path}.{TIME}", when)
        parent = await self._add_object(cell, METHODS_NODE, "Calls to maintenance_node")
        for method in METHODS:
            await self._add_method(parent, method)

    async def _add_enumeration(self, name: str, numbers: Mapping[str, int]) -> None:
        """An enumeration type, with ``EnumStrings`` for clients from before DataTypeDefinition."""
        names = sorted(numbers, key=numbers.__getitem__)
        if [numbers[each] for each in names] != list(range(len(names))):
            raise ValueError(f"{name}: {dict(numbers)} do not count from 0")
        parent = self._server.nodes.enum_data_type
        kind = await parent.add_data_type(self.node_id(name), f"{self._index}:{name}")
        texts = [ua.LocalizedText(each) for each in names]
        fields = [
            ua.EnumField(Value=value, DisplayName=text, Name=each)
            for value, (each, text) in enumerate(zip(names, texts, strict=True))
        ]
        await kind.write_data_type_definition(ua.EnumDefinition(fields))
        await kind.add_property(
            self.node_id(f"{name}.EnumStrings"), ua.QualifiedName("EnumStrings"), texts
        )
        self._types[name] = kind.nodeid

    def _data_type(self, item: Item) -> ua.NodeId:
        return self._types.get(item.scalar) or ua.NodeId(item.variant_type.value)

    async def _add_object(self, parent: Node, path: str, words: str = "") -> Node:
        name = f"{self._index}:{path.rpartition('.')[2]}"
        made = await parent.add_object(self.node_id(path), name)
        await self._describe(made, words or path)
        return made

    async def _describe(self, node: Node, words: str) -> None:
        text = ua.DataValue(ua.Variant(ua.LocalizedText(words)))
        await node.write_attribute(ua.AttributeIds.Description, text)

    async def _add_variable(self, parent: Node, path: str, item: Item) -> Node:
        name, data_type = f"{self._index}:{item.name}", self._data_type(item)
        made = await parent.add_variable(
            self.node_id(path), name, item.empty(), item.variant_type, data_type
        )
        if item.is_array:
            await made.write_value_rank(ua.ValueRank.OneDimension)
        await self._describe(made, item.description)
        waits = ua.DataValue(item.empty(), ua.StatusCode(AWAITED))
        self._values[path] = waits
        await self._server.write_attribute_value(made.nodeid, waits)
        return made

    async def _add_input(self, parent: Node, path: str, item: Item) -> None:
        made = await self._add_variable(parent, path, item)
        await made.set_writable()
        await self.set(path, item.empty())
        self.writable[made.nodeid], self.input_types[path] = path, item.variant_type

    async def _add_method(self, parent: Node, method: Method) -> None:
        inputs, outputs = (
            [
                ua.Argument(
                    Name=item.name,
                    DataType=self._data_type(item),
                    ValueRank=ua.ValueRank.Scalar,
                    Description=ua.LocalizedText(item.description),
                )
                for item in items
            ]
            for items in (method.inputs, method.outputs)
        )
        made = await parent.add_method(
            self.node_id(f"{METHODS_NODE}.{method.name}"),
            f"{self._index}:{method.name}",
            _never_called,
            inputs,
            outputs,
        )
        await self._describe(made, method.description)
        self.methods[made.nodeid] = method

    async def set(self, path: str, value: ua.Variant, at: datetime | None = None) -> None:
        """Show a value, as of a time; one that has not changed is left."""
        before = self._values.get(path)
        if before is not None and before.Value == value and before.StatusCode == ua.StatusCode():
            return
        now = datetime.now(UTC)
        shown = ua.DataValue(value, SourceTimestamp=at or now, ServerTimestamp=now)
        numbers = value.Value if value.is_array else [value.Value]
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            shown = ua.DataValue(Value=value, StatusCode=ua.StatusCode(ua.StatusCodes.BadNoData))
        self._values[path] = shown
        await self._server.write_attribute_value(self.node_id(path), shown)

    async def show(
        self, source: str, values: Iterable[tuple[str, ua.Variant]], at: datetime, now_s: float
    ) -> None:
        """Show what a source has said; older news than it had is none."""
        if now_s < self._heard_s.get(source, now_s):
            return
        self._heard_s[source] = now_s
        for path, value in values:
            await self.set(path, value, at)

    def good_values(self) -> dict[str, Any]:
        """What is shown and stood by, by its path below the cell."""
        return {
            path.removeprefix(f"{CELL}."): shown.Value.Value
            for path, shown in self._values.items()
            if shown.StatusCode == ua.StatusCode() and shown.Value is not None
        }

    async def look(self, now_s: float) -> None:
        """What has fallen silent is marked: nobody stands by its last value."""
        for shown in SHOWN:
            silent_s = now_s - self._heard_s.get(shown.source, now_s)
            if not shown.silent_s or silent_s <= shown.silent_s:
                continue
            for item in shown.items:
                path = f"{CELL}.{shown.name}.{item.name}"
                before = self._values[path]
                if before.StatusCode == ua.StatusCode():
                    stale = ua.DataValue(
                        Value=before.Value,
                        StatusCode=ua.StatusCode(SILENT),
                        SourceTimestamp=before.SourceTimestamp,
                        ServerTimestamp=datetime.now(UTC),
                    )
                    self._values[path] = stale
                    await self._server.write_attribute_value(self.node_id(path), stale)


async def _never_called(parent: ua.NodeId, *arguments: Any) -> ua.StatusCode:
    """Calls are carried out by their session, which knows the user."""
    return ua.StatusCode(ua.StatusCodes.BadInvalidState)


def values_of(source: str, message: Any) -> list[tuple[str, ua.Variant]]:
    """What is shown of a source's message, by path."""
    return [
        (f"{CELL}.{shown.name}.{item.name}", item.variant(item.value(message)))
        for shown in SHOWN
        if shown.source == source
        for item in shown.items
    ]


def arguments_of(
    method: Method, sent: Sequence[ua.Variant]
) -> tuple[dict[str, Any], str, list[str]]:
    """Fields of the request, else why not: a status, and the arguments' own."""
    wanted = method.inputs
    if len(sent) != len(wanted):
        few = len(sent) < len(wanted)
        return {}, "BadArgumentsMissing" if few else "BadTooManyArguments", []
    each = [_argument_fault(i, v) for i, v in zip(wanted, sent, strict=True)]
    if any(status != "Good" for status in each):
        return {}, "BadInvalidArgument", each
    return {str(i.read): v.Value for i, v in zip(wanted, sent, strict=True)}, "", each


def _argument_fault(item: Item, sent: ua.Variant) -> str:
    value = sent.Value
    if sent.VariantType is not item.variant_type or sent.is_array or value is None:
        return "BadTypeMismatch"
    long = isinstance(value, str) and len(value) > LONGEST_TEXT
    wrong = isinstance(value, float) and not math.isfinite(value)
    return "BadOutOfRange" if long or wrong else "Good"
