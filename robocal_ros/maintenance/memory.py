"""What the maintenance remembers over a restart: its gaps, its tool, what was asked of it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, StateLostError, StorageError

REMEMBERED = 200  # ended cycles
VERSION = 2  # of the document; one without a version is the first, which knew no runs and stamps


class DocumentStore(Protocol):
    """Keeps one document; whole or not at all.

    ``path``: where, for whoever must mend it.
    """

    path: Path

    def load(self) -> Mapping[str, Any] | None:
        """What was kept last; None before anything; raises `StateLostError` where it is gone."""

    def save(self, document: Mapping[str, Any]) -> None:
        """Keep it; raises a `RobocalError` when that fails."""


@dataclass(frozen=True)
class CycleResult:
    """How a maintenance cycle ended, or how far it has come."""

    cycle_id: str
    # ACCEPT when it ran as planned, with the robot at home; NONE while it runs
    code: Code = Code.NONE
    message: str = ""
    complete: bool = False  # nothing that was due is left for the next gap; ``left`` names what is
    left: tuple[str, ...] = ()
    # thermal_code, thermal_id: of the end of the thermal cycle; NONE where it did not end
    thermal_code: Code = Code.NONE
    thermal_id: int = 0
    # tool_code, tool_id: of the last tool measurement, and its candidate
    tool_code: Code = Code.NONE
    tool_id: int = 0
    tool_answer: str = ""  # of the last quick check
    accepted: tuple[int, ...] = ()  # calibrations that were accepted without a person
    # what was found of the tool as the gap began, also where that was mended
    tool_found_code: Code = Code.NONE
    # when it ended, by the wall clock; began, while it runs, and of one that was killed
    stamp_ns: int = 0
    # the how many-th since the state folder was made; 0: of a version that did not count
    run: int = 0

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "CycleResult":
        """Read what `document` gave, also after JSON."""
        values = dict(document)
        for name in ("code", "thermal_code", "tool_code", "tool_found_code"):
            values[name] = Code(values.get(name, Code.NONE))
        for name in ("left", "accepted"):
            values[name] = tuple(values[name])
        return cls(**values)


@dataclass(frozen=True)
class ToolRecord:
    """What is known of the tool in force from its last measurement."""

    # "pass", "recalibrate" or "cannot tell"; "failed": the last run found something wrong and has
    # no result for the tool in force; empty: never measured
    answer: str = ""
    words: str = "the tool was never checked"
    deviation_mm: float = 0.0
    sigma_mm: float = 0.0
    revision: int = 0  # of the tool that was in force in the last run
    thermal_id: int = 0  # thermal model that was in force in it; 0: the nominal one
    candidate: int = 0  # calibration that a full measurement proposes in its place; 0: none
    postponed: bool = False  # only the time for its check was missing to accept it without a person
    # wall_ns, full_ns: of its last result, and of the last full one; 0: none
    wall_ns: int = 0
    full_ns: int = 0
    # drift_rms_m, drift_bound_m: error of the thermal model through which a tool was last measured
    drift_rms_m: float = 0.0
    drift_bound_m: float = 0.0


@dataclass
class Memory:
    """The kept state."""

    keeper: DocumentStore
    cycles: dict[str, CycleResult] = field(default_factory=dict)
    tool: ToolRecord = field(default_factory=ToolRecord)
    # fault_code, fault: what stopped the maintenance until it is acknowledged; empty: nothing
    fault_code: Code = Code.NONE
    fault: str = ""
    # running, began_ns: the cycle that is open
    running: str = ""
    began_ns: int = 0
    runs: int = 0  # cycles that have begun, ever
    earlier: frozenset[str] = frozenset()  # ids of the cycles that had ended before this start

    @classmethod
    def load(cls, keeper: DocumentStore) -> "Memory":
        """Read what is kept; a fault where a cycle was open, or where what was kept is gone.

        Raises
        ------
        RobocalError
            When it cannot be read, or is of another version.
        """
        try:
            document = keeper.load()
        except StateLostError as error:
            memory = cls(keeper)
            known = "ended cycles, whose ids would run again, the last check, an open fault"
            memory.set_fault(error.code, f"{error} ({known}): see where the robot is")
            memory.save()
            return memory
        if document is None:
            return cls(keeper)
        memory = cls._of_document(keeper, document)
        if memory.running:
            words = f"the node ended while cycle '{memory.running}' ran: see where the robot is"
            result = CycleResult(
                memory.running,
                Code.CONFLICT,
                words,
                stamp_ns=memory.began_ns,
                run=memory.runs,
            )
            memory.end(result, Code.CONFLICT, words)
            memory.save()
        memory.earlier = frozenset(memory.cycles)
        return memory

    @classmethod
    def _of_document(cls, keeper: DocumentStore, document: Mapping[str, Any]) -> "Memory":
        try:
            if not 1 <= (version := int(document.get("version", 1))) <= VERSION:
                raise ValueError(f"version {version}")
            results = [CycleResult.of_document(each) for each in document["cycles"]]
            return cls(
                keeper,
                {result.cycle_id: result for result in results},
                ToolRecord(**document["tool"]),
                Code(document["fault_code"]),
                str(document["fault"]),
                str(document["running"]),
                int(document.get("began_ns", 0)),
                int(document.get("runs", 0)),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise StorageError(
                f"{keeper.path} is not of this version ({type(error).__name__}: {error}): go back "
                "to the version that wrote it, or see where the robot is and move it away"
            ) from error

    def begin(self, cycle_id: str, wall_ns: int) -> CycleResult:
        """A cycle runs from now on; its result, as yet."""
        self.running, self.began_ns, self.runs = cycle_id, wall_ns, self.runs + 1
        try:
            self.save()
        except Exception:
            self.running, self.runs = "", self.runs - 1
            raise
        return CycleResult(cycle_id, stamp_ns=wall_ns, run=self.runs)

    def end(self, result: CycleResult, fault_code: Code = Code.NONE, fault: str = "") -> None:
        """It has ended, for good; `save` keeps that."""
        self.running = ""
        self.cycles[result.cycle_id] = result
        self.earlier -= {result.cycle_id}
        while len(self.cycles) > REMEMBERED:
            del self.cycles[next(iter(self.cycles))]
        if fault:
            self.fault_code, self.fault = fault_code, fault

    def words_of(self, result: CycleResult) -> str:
        """How a cycle ended; of one from before this start it is said that it is old."""
        if result.cycle_id not in self.earlier:
            return result.message
        ended = str(np.datetime64(result.stamp_ns, "ns").astype("datetime64[s]")) + "Z"
        when = f", run {result.run}, {ended}" if result.run else ""
        return (
            f"cycle '{result.cycle_id}' is one of before this start of the node{when}; nothing "
            f"runs now; it ended so: {result.message}"
        )

    def note_tool(self, **known: Any) -> None:
        """The tool was measured; `save` keeps it."""
        self.tool = replace(self.tool, **known)

    def set_fault(self, code: Code, words: str) -> None:
        """A fault; `save` keeps it."""
        self.fault_code, self.fault = code, words

    def clear_fault(self) -> None:
        """Its end; it stays where that cannot be kept."""
        before = self.fault_code, self.fault
        self.fault_code, self.fault = Code.NONE, ""
        try:
            self.save()
        except Exception:
            self.fault_code, self.fault = before
            raise

    def save(self) -> None:
        """Keep all of it."""
        self.keeper.save(
            {
                "version": VERSION,
                "cycles": [result.document() for result in self.cycles.values()],
                "tool": asdict(self.tool),
                "fault_code": int(self.fault_code),
                "fault": self.fault,
                "running": self.running,
                "began_ns": self.began_ns,
                "runs": self.runs,
            }
        )


Array = NDArray[np.float64]


NS = 1_000_000_000
MM = 1e-3
