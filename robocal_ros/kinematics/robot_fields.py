"""Values of a YAML file by key, checked; errors name file, place and key."""

import math
from collections.abc import Sequence
from typing import Any, NoReturn

import yaml

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, quoted


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a key that is given twice is an error, not the last one's victory."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if str(key_node.value) in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {quoted(key_node.value)} appears twice",
                    problem_mark=key_node.start_mark,
                )
            seen.add(str(key_node.value))
        return super().construct_mapping(node, deep)


def load_yaml(text: str, file: str) -> Any:
    """Parse YAML.

    Raises
    ------
    InputError
        With file and row, when it is not YAML or gives a key twice.
    """
    try:
        # _StrictLoader is a SafeLoader
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as error:
        row = error.problem_mark.line + 1 if error.problem_mark else None
        raise InputError(f"not valid YAML: {error.problem}", file=file, row=row) from error
    except yaml.YAMLError as error:
        raise InputError(f"not valid YAML: {error}", file=file) from error


class Fields:
    """A mapping of the file; ``place`` says where it is ("" is the top)."""

    def __init__(self, values: Any, file: str, place: str) -> None:
        self.file = file
        self.place = place
        if not isinstance(values, dict):
            self.fail(f"must be keys and values, not {_kind(values)}")
        self.values: dict[Any, Any] = values

    def fail(self, message: str, key: str = "") -> NoReturn:
        """Refuse the file; ``message`` continues the place and the key."""
        place = ", ".join(part for part in (self.place, key) if part) or "the file"
        raise InputError(f"{place} {message}", file=self.file)

    def only(self, *known: str) -> None:
        """Refuse keys beside the known ones."""
        for key in self.values:
            if key not in known:
                self.fail(f"is not a known key{nearest(str(key), known)}", quoted(key))

    def _get(self, key: str) -> Any:
        if self.values.get(key) is None:
            self.fail("is missing" if key not in self.values else "has no value", key)
        return self.values[key]

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self._get(key)
        if not isinstance(value, str) or not value.strip():
            self.fail(f"must be a text, not {_kind(value)}", key)
        return value

    def choice(self, key: str, known: Sequence[str], default: str | None = None) -> str:
        """One of the known words."""
        if key not in self.values and default is not None:
            return default
        value = self._get(key)
        if value not in known:
            words = " or ".join(known)
            self.fail(f"is {quoted(value)}; it must be {words}{nearest(str(value), known)}", key)
        return str(value)

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        if key not in self.values and default is not None:
            return default
        return self._number(self._get(key), key)

    def positive(self, key: str, default: float | None = None) -> float:
        """A number above zero."""
        value = self.number(key, default)
        if value <= 0.0:
            self.fail(f"is {value:g}; it must be above 0", key)
        return value

    def whole(self, key: str, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        value = self.number(key)
        if value != int(value) or not low <= value <= high:
            self.fail(f"is {value:g}; it must be a whole number from {low} to {high}", key)
        return int(value)

    def numbers(
        self, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> list[float]:
        """A list of ``count`` finite numbers."""
        if key not in self.values and default is not None:
            return list(default)
        value = self._get(key)
        if not isinstance(value, list) or len(value) != count:
            self.fail(f"must be a list of {count} numbers", key)
        return [self._number(item, key) for item in value]

    def _number(self, value: Any, key: str) -> float:
        if isinstance(value, str):  # YAML 1.1 takes 1e-3 for a text
            try:
                value = float(value)
            except ValueError:
                self.fail(f"is {quoted(value)}, not a number", key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(f"must be a number, not {_kind(value)}", key)
        if not math.isfinite(value):
            self.fail(f"is {value}, not a finite number", key)
        return float(value)

    def below(self, key: str) -> "Fields":
        """The mapping at ``key``."""
        return Fields(self._get(key), self.file, key)

    def items(self, key: str, name: str) -> list["Fields"]:
        """The mappings of the list at ``key``, which must not be empty."""
        value = self._get(key)
        if not isinstance(value, list) or not value:
            self.fail(f"must be a list with at least one {name}", key)
        return [Fields(item, self.file, f"{name} {i}") for i, item in enumerate(value, start=1)]


def _kind(value: Any) -> str:
    kinds = {dict: "keys and values", list: "a list", str: quoted(value), type(None): "nothing"}
    return kinds.get(type(value), str(value))
