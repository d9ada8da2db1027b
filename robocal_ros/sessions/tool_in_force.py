"""The tool in force and the thermal model that its flange poses come from."""

from robocal_ros.core.documents import arm_of
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import HEALTHY_TOOL, THERMAL, TOOL, Decision, Head
from robocal_ros.core.tool.judging import KnownTool
from robocal_ros.sessions.history import History
from robocal_ros.sessions.tool_config import ToolConfig, made_with


class ToolInForce:
    """What the history has in force for a tool, as of the last look.

    Attributes
    ----------
    head, thermal, healthy : heads of the tools, of the thermal models and of the measurements of
        the healthy tool.
    fault : why the history could not be read at the last look; empty when it could.
    """

    def __init__(self, history: History, nominal: SerialArm, config: ToolConfig) -> None:
        self._history, self._nominal = history, nominal
        self._taught, self._made_with = KnownTool(config.T_flange_taught), made_with(config)
        self._version = history.data_version()
        decided = history.decisions()
        self._seen = decided[-1].seq if decided else 0
        self.fault = ""
        self._read()

    def _read(self) -> None:
        self.head: Head = self._history.head(TOOL)
        self.thermal: Head = self._history.head(THERMAL)
        self.healthy: Head = self._history.head(HEALTHY_TOOL)

    @property
    def arm(self) -> SerialArm:
        """The arm with the thermal model in force."""
        model = self.thermal.model
        return self._nominal if model is None else arm_of(model, self._nominal)

    @property
    def tool(self) -> KnownTool:
        """The tool in force; without one the taught one."""
        model = self.head.model
        return self._taught if model is None else KnownTool.of_document(model)

    @property
    def measured_healthy(self) -> KnownTool | None:
        """How the healthy tool was measured; None without, or with another tool or station."""
        model = self.healthy.model
        if model is None or model["made_with"] != self._made_with:
            return None
        return KnownTool.of_document(model)

    def look(self, own_wall_ns: int | None = None) -> list[Decision]:
        """Take over what was decided since the last look.

        Returns others' decisions about the tool, oldest first; those stamped ``own_wall_ns`` are
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
        return [d for d in decided if d.kind == TOOL and d.wall_ns != own_wall_ns]
