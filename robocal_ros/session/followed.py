"""What a history has in force for one kind of calibration, while other processes decide too."""

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.proposals import Decision, Head
from robocal_ros.session.history import History


class HistoryFollower:
    """Heads of a history as of the last look; a subclass reads those that it is about.

    Parameters
    ----------
    kind : whose decisions are told.

    Attributes
    ----------
    head : of that kind.
    fault : why the history could not be read at the last look; empty when it could.
    """

    def __init__(self, history: History, kind: str) -> None:
        self._history, self._kind = history, kind
        self._version = history.data_version()
        decided = history.decisions(newest=1)
        self._seen = decided[-1].seq if decided else 0
        self.fault = ""
        self._read()

    def _read(self) -> None:
        self.head: Head = self._history.head(self._kind)

    def look(self, own_wall_ns: int | None = None) -> list[Decision]:
        """Take over what was decided since the last look.

        Returns others' decisions about the kind, oldest first; those stamped ``own_wall_ns`` are
        the caller's own. Never raises for the history's sake: see ``fault``.
        """
        try:
            version = self._history.data_version()
            self.fault = ""
            if version == self._version:
                return []
            decided = self._history.decisions(self._seen)
            self._read()
        except RobocalError as error:
            self.fault = str(error)
            return []
        self._version = version
        self._seen = decided[-1].seq if decided else self._seen
        return [d for d in decided if d.kind == self._kind and d.wall_ns != own_wall_ns]
