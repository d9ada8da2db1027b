"""What the commands are corrected with, written into the robot's history beside the node's work.

A thread of its own writes: a disk that is slow, full or locked holds no command up. What cannot be
written is told and tried again.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from robocal_ros.core.correction_record import CorrectionRecord
from robocal_ros.core.errors import RobocalError
from robocal_ros.storage.calibrations import CalibrationHistory

RETRY_S = 5.0
CLOSE_S = 5.0  # the end of the node waits so long for what is not yet written
MOST_WAITING = 1000  # then the oldest are lost


class CorrectionLog:
    """Keeps each change of what is corrected with, from the first record on.

    Parameters
    ----------
    open_history : raises `RobocalError`. It is opened anew for what has changed.

    Attributes
    ----------
    fault : why something waits to be written; empty when nothing does.
    """

    def __init__(self, open_history: Callable[[], CalibrationHistory]) -> None:
        self._open = open_history
        self._last: CorrectionRecord | None = None
        self._noted: queue.SimpleQueue[CorrectionRecord | None] = queue.SimpleQueue()
        self._waiting: deque[CorrectionRecord] = deque(maxlen=MOST_WAITING)
        self.fault = ""
        self._thread = threading.Thread(target=self._write, name="correction_log", daemon=True)
        self._thread.start()

    def note(self, record: CorrectionRecord) -> None:
        """Keep it, if more than its time has changed."""
        if self._last is None or replace(record, wall_ns=self._last.wall_ns) != self._last:
            self._last = record
            self._noted.put(record)

    def close(self) -> None:
        """Write what waits, if that is possible soon."""
        self._noted.put(None)
        self._thread.join(CLOSE_S)

    def _write(self) -> None:
        ends = False
        while not ends:
            try:
                record = self._noted.get(timeout=RETRY_S if self._waiting else None)
            except queue.Empty:
                pass
            else:
                ends = record is None
                if record is not None:
                    self._waiting.append(record)
            self._try()

    def _try(self) -> None:
        if not self._waiting:
            return
        try:
            with self._open() as history:
                while self._waiting:
                    history.note_correction(self._waiting[0])
                    self._waiting.popleft()
            self.fault = ""
        except RobocalError as error:
            self.fault = (
                f"{len(self._waiting)} changes wait to be written into the history: {error}"
            )
