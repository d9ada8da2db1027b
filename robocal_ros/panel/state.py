# SPDX-License-Identifier: Apache-2.0
"""What the page shows, from what the nodes say: knows neither ROS nor clock, and stays small.

Messages come as plain values (`show`), times are arguments, and every buffer has its bound: a page
that is open for a year holds as much as one of a day.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from robocal_ros.ground.errors import Code
from robocal_ros.panel.words import TOO_SHORT, instruction_key, step_of

Values = Mapping[str, Any]

ACCURACY, STATUS, CORRECTION = "accuracy_state", "maintenance_node/status", "correction_status"
FIXTURE = "fixture_node/quality"  # a verdict, said once
SILENT_S: Mapping[str, float] = {ACCURACY: 3.0, STATUS: 3.0, CORRECTION: 5.0, FIXTURE: math.inf}
"""A source that is silent for so long says nothing any more; the PLC's bridge has the same 3 s."""

SHIFT_S = 12 * 3600.0  # what the curve shows at the most
BUCKET_S = 60.0  # a point of the curve: the worst of a minute
POINTS = round(SHIFT_S / BUCKET_S)
STEPS, GAPS = 100, 200  # kept of one gap; gaps kept of a shift
LONGEST_TEXT = 1000

LEVELS = ("NONE", "OK", "DUE", "DEGRADED", "EXPIRED", "FAULT")  # of AccuracyState
MAINTENANCE = ("NONE", "IDLE", "RUNNING", "BREAKING_OFF", "FAULT")  # of MaintenanceStatus
CORRECTIONS = (
    "NONE", "OFF", "BLENDING", "ON", "WITHOUT_MODEL", "MISMATCH", "OTHER_COMMANDER", "LEASED",
)  # fmt: skip
PENDING = ("thermal_pending", "tool_pending", "fixture_pending")  # of MaintenanceStatus, too
MOVES = ("RUNNING", "BREAKING_OFF")
STOPS = ("MISMATCH", "OTHER_COMMANDER")  # the line stands, whatever is known of the accuracy
UNCORRECTED = ("OFF", "WITHOUT_MODEL")  # where the accuracy is not what it should be
WELL = (Code.NONE, Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN)
LASTING = (Code.WRONG_ROBOT, Code.STORAGE_FAILED)  # of a gap: another one ends so again
# Of `correction.interface.uncorrected`: a newer model comes of a gap, and in one the robot stands.
GAP_MENDS = ("corrects without the model", "waits until the robot stands")
SILENT, FAULT = "SILENT", "FAULT"


def known(value: float) -> float | None:
    """A figure of a message; None: not known (-1, or no number)."""
    return float(value) if math.isfinite(value) and value >= 0.0 else None


def code_of(number: int) -> Code:
    """Code of a number; one of a later version is a refusal: the engineer reads its words."""
    return Code(number) if number in Code._value2member_map_ else Code.BAD_INPUT


def named(names: tuple[str, ...], number: int) -> str:
    """Name of a constant; of one from a later version: the worst."""
    return names[number] if 0 < number < len(names) else FAULT


@dataclass
class Source:
    """What one node said last.

    A latched message says nothing of whether its node still lives: the first one counts only once
    another one has followed it.
    """

    values: Values = field(default_factory=dict)
    stamp_ns: int = 0
    alive_s: float = -math.inf

    def hear(self, values: Values, stamp_ns: int, now_s: float) -> None:
        """Take a message; ``now_s``: steady clock."""
        if self.values and stamp_ns != self.stamp_ns:
            self.alive_s = now_s
        self.values, self.stamp_ns = values, stamp_ns

    def age_s(self, now_s: float) -> float | None:
        """Since it was surely said; None: never."""
        age_s = now_s - self.alive_s
        return age_s if math.isfinite(age_s) else None


@dataclass(frozen=True)
class Instruction:
    """Something to do: ``key`` of the table of texts; the node's own words."""

    key: str
    code: str = ""
    detail: str = ""


class Curve:
    """Error and bound of the shift, a point a minute: its worst level, its largest bound."""

    def __init__(self) -> None:
        self.points: deque[list[Any]] = deque(maxlen=POINTS)
        self.version = 0

    def add(self, level: int, error_mm: float | None, bound_mm: float | None, at_s: float) -> None:
        """Add what is known at a time of the wall clock."""
        start_s = at_s - at_s % BUCKET_S
        if self.points and self.points[-1][0] > at_s:  # the clock was set back
            self.points.clear()
        while self.points and self.points[0][0] < at_s - SHIFT_S:
            self.points.popleft()
        if not self.points or self.points[-1][0] != start_s:
            self.points.append([start_s, error_mm, bound_mm, level])
        else:
            last = self.points[-1]
            new = [start_s, _larger(last[1], error_mm), _larger(last[2], bound_mm),
                   max(last[3], level)]  # fmt: skip
            if new == last:
                return
            self.points[-1] = new
        self.version += 1


def _larger(one: float | None, other: float | None) -> float | None:
    """None beats all: what was not known for a moment is not shown as known."""
    return None if one is None or other is None else max(one, other)


class PanelState:
    """All of one cell."""

    def __init__(self) -> None:
        self.sources = {name: Source() for name in SILENT_S}
        self.curve = Curve()
        self.cycle_id = ""
        self.steps: deque[dict[str, Any]] = deque(maxlen=STEPS)
        self.gaps: deque[Values] = deque(maxlen=GAPS)
        self.in_force: frozenset[int] = frozenset()  # calibrations, as the history says
        self.history_trouble = ""
        self._found: dict[str, Values] = {}  # of drift and tool: the last gap that measured it

    def show(self, name: str, values: Values, stamp_ns: int, now_s: float, wall_s: float) -> None:
        """Take a message of a source; ``now_s``: steady clock, ``wall_s``: since 1970."""
        source = self.sources[name]
        source.hear(values, stamp_ns, now_s)
        if name == ACCURACY and source.alive_s == now_s:
            self.curve.add(
                values["state"],
                known(values["predicted_error_mm"]),
                known(values["bound_mm"]),
                wall_s,
            )
        elif name == STATUS:
            self._follow(values, wall_s)

    def _follow(self, status: Values, wall_s: float) -> None:
        """Note each step of a gap, and how it ended."""
        moves = named(MAINTENANCE, status["state"]) in MOVES
        if moves and status["cycle_id"] != self.cycle_id:
            self.cycle_id = status["cycle_id"]
            self.steps.clear()
        doing = status["doing"].split("; ")[0]
        if (moves or status["state"] == MAINTENANCE.index(FAULT)) and doing:
            key, numbers = step_of(doing[:LONGEST_TEXT])
            new = {"key": key, "numbers": numbers}
            if not self.steps or {k: self.steps[-1][k] for k in new} != new:
                self.steps.append(new | {"at_s": wall_s})
        last = status["last"]
        if not last["cycle_id"] or last["code"] == Code.NONE:
            return
        if not self.gaps or (self.gaps[-1]["cycle_id"], self.gaps[-1]["stamp_ns"]) != (
            last["cycle_id"], last["stamp_ns"],
        ):  # fmt: skip
            self.gaps.append(last)
            if last["thermal_code"]:
                self._found["drift"] = last
            if last["tool_code"] or last["tool_found_code"]:
                self._found["tool"] = last
            if last["station_code"]:
                self._found["station"] = last

    def headline(self, now_s: float) -> str:
        """Key of the one sentence, which gives the colour too."""
        if not (self._fresh(ACCURACY, now_s) and self._fresh(STATUS, now_s)):
            return SILENT
        maintenance = named(MAINTENANCE, self.sources[STATUS].values["state"])
        if maintenance in (*MOVES, FAULT):
            return maintenance
        return named(LEVELS, self.sources[ACCURACY].values["state"])

    def tasks(self, now_s: float) -> list[Instruction]:
        """What to do now, what matters most first."""
        headline = self.headline(now_s)
        status, accuracy = self.sources[STATUS].values, self.sources[ACCURACY].values
        if headline == SILENT:
            return [Instruction("state/SILENT")]
        if headline in MOVES:
            return [Instruction(f"state/{headline}", detail=status["doing"])]
        found = []
        if status["fault_code"]:
            found.append(_task(code_of(status["fault_code"]), "fault", status["fault"]))
        else:
            found += self._measured()
            code, words = code_of(status["last"]["code"]), status["last"]["message"]
            if code in LASTING:
                found.append(_task(code, "gap", words))
            elif code not in WELL:
                found.append(Instruction("state/BROKEN_OFF", code.name, words))
        waiting = {status[name] for name in PENDING} - {0}
        if any(task.key == instruction_key(Code.ACCEPT, "fixture") for task in found):
            waiting.discard(self.sources[FIXTURE].values["candidate_id"])
        if waiting:
            found.append(Instruction("state/DECIDE"))
        found += self._corrected(now_s)
        if self.history_trouble:
            found.append(
                Instruction("state/HISTORY", Code.STORAGE_FAILED.name, self.history_trouble)
            )
        level = named(LEVELS, accuracy["state"])
        reason = accuracy["reason"]
        mends = any(words in reason for words in GAP_MENDS)
        if level == "DEGRADED" and reason.startswith("correction: ") and not mends:
            level = "UNCORRECTED"  # drift and tool are known well enough: no gap mends it
        if level != "OK" or not found:
            found.append(Instruction(f"state/{level}", detail=accuracy["reason"]))
        return list({task.key: task for task in reversed(found)}.values())[::-1]

    def _measured(self) -> list[Instruction]:
        """What was found of tool and drift, until another gap has measured them."""
        found = []
        if (gap := self._found.get("tool")) is not None:
            first, last = code_of(gap["tool_found_code"]), code_of(gap["tool_code"])
            if code_of(gap["code"]) is Code.LIMIT_EXCEEDED:  # the robot left its plan, not the tool
                pass
            elif first is Code.LIMIT_EXCEEDED:  # also where the same gap mended it
                mended = gap["tool_id"] and gap["tool_id"] in {*gap["accepted"], *self.in_force}
                found.append(_task(first, "tool mended" if mended else "tool", gap["message"]))
            elif last not in WELL:
                found.append(_task(last, "tool", gap["message"]))
            elif last is Code.NONE and first not in WELL:
                found.append(_task(first, "tool", gap["message"]))
        if (gap := self._found.get("drift")) is not None:
            code = code_of(gap["thermal_code"])
            if code not in WELL:
                found.append(_task(code, "drift", gap["message"]))
        if (gap := self._found.get("station")) is not None:
            code = code_of(gap["station_code"])
            if code not in WELL:
                found.append(_task(code, "gap", gap["message"]))
        if self.gaps and TOO_SHORT.search(self.gaps[-1]["message"]):
            found.append(_task(Code.LIMIT_EXCEEDED, "gap", self.gaps[-1]["message"]))
        if fixture := self.sources[FIXTURE].values:
            code, number = code_of(fixture["code"]), fixture["candidate_id"]
            waits = number == self.sources[STATUS].values["fixture_pending"] != 0
            if code not in WELL or (code is Code.ACCEPT and waits):
                found.append(_task(code, "fixture", fixture["reason"]))
        return found

    def _corrected(self, now_s: float) -> list[Instruction]:
        source = self.sources[CORRECTION]
        inaccurate = self.sources[ACCURACY].values["state"] >= LEVELS.index("DEGRADED")
        if not source.values:  # a cell whose controller takes model and tool itself has none
            return []
        if not self._fresh(CORRECTION, now_s):
            return [Instruction("correction/SILENT")] if inaccurate else []
        state = named(CORRECTIONS, source.values["state"])
        if state in STOPS or (state in UNCORRECTED and inaccurate):
            return [Instruction(f"correction/{state}", detail=source.values["reason"])]
        return []

    def _fresh(self, name: str, now_s: float) -> bool:
        age_s = self.sources[name].age_s(now_s)
        return age_s is not None and age_s <= SILENT_S[name]

    def document(self, now_s: float, wall_s: float) -> dict[str, Any]:
        """All that is shown but curve and history, for JSON: finite numbers or null."""
        accuracy, status = self.sources[ACCURACY].values, self.sources[STATUS].values
        headline = self.headline(now_s)
        fresh = headline != SILENT
        ages = [self.sources[name].age_s(now_s) for name in (ACCURACY, STATUS)]
        last = self.gaps[-1] if self.gaps else None
        shown: dict[str, Any] = {
            "headline": headline,
            "age_s": None if None in ages else max(age for age in ages if age is not None),
            "wall_s": wall_s,
            "robot": accuracy.get("robot", ""),
            "serial": accuracy.get("serial", ""),
            "tasks": [asdict(task) for task in self.tasks(now_s)],
            "cycle_id": self.cycle_id or (last["cycle_id"] if last else ""),
            "steps": [*self.steps] if last is None or self._steps_of(last) else [],
            "last": None if last is None else _gap(last),
            "shift": self._shift(wall_s),
        }
        figures = ("error_mm", "bound_mm", "tolerance_mm", "due_in_s", "left_s")
        shown |= dict.fromkeys((*figures, "maintenance", "doing", "waiting", "at_home"))
        if fresh:
            due = accuracy["due_in_s"]
            shown |= {
                "error_mm": known(accuracy["predicted_error_mm"]),
                "bound_mm": known(accuracy["bound_mm"]),
                "tolerance_mm": known(accuracy["tolerance_mm"]),
                "due_in_s": due if math.isfinite(due) else None,
                "left_s": known(status["left_s"]),
                "maintenance": named(MAINTENANCE, status["state"]),
                "doing": status["doing"],
                "at_home": bool(status["at_home"]),
                "waiting": [n for n in (status[name] for name in PENDING) if n],
            }
        return shown

    def _steps_of(self, last: Values) -> bool:
        """Whether the steps are of the gap that ended last, or of one that goes on."""
        status = self.sources[STATUS].values
        running = named(MAINTENANCE, status["state"]) in MOVES
        return running or self.cycle_id == last["cycle_id"]

    def _shift(self, wall_s: float) -> dict[str, Any]:
        """What was done in the shift, and what is open."""
        since_s = wall_s - SHIFT_S
        gaps = [gap for gap in self.gaps if gap["stamp_ns"] * 1e-9 >= since_s]
        return {
            "gaps": len(gaps),
            "complete": sum(bool(gap["complete"]) for gap in gaps),
            "accepted": sorted({number for gap in gaps for number in gap["accepted"]}),
            "open": list(gaps[-1]["left"]) if gaps else [],
        }


def _task(code: Code, source: str, words: str) -> Instruction:
    return Instruction(instruction_key(code, source), code.name, words)


def _gap(last: Values) -> dict[str, Any]:
    codes = ("code", "thermal_code", "tool_found_code", "tool_code", "station_code")
    return {
        **{name: code_of(last[name]).name for name in codes},
        "message": last["message"],
        "complete": bool(last["complete"]),
        "left": list(last["left"]),
        "at_s": last["stamp_ns"] * 1e-9,
    }


def plain(message: Any, read: Mapping[str, Callable[[Any], Any]]) -> dict[str, Any]:
    """Values of a message; texts are cut to `LONGEST_TEXT`."""
    values = {name: of(message) for name, of in read.items()}
    return {k: v[:LONGEST_TEXT] if isinstance(v, str) else v for k, v in values.items()}
