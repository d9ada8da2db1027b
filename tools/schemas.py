# SPDX-License-Identifier: Apache-2.0
"""Make the JSON schemas of docs/schemas from what the rooms declare in documents.py.

    tools/with_ros python tools/schemas.py

A document that several fields show stands once in a file, below ``$defs``; what all rooms share in
``common.json``. See `robocal_ros.ground.documents` for how a declaration is read.
"""

import importlib
import json
import re
import sys
import types
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "schemas"
sys.path.insert(0, str(ROOT))

from robocal_ros.ground import documents as shared  # noqa: E402

DIALECT = "https://json-schema.org/draft/2020-12/schema"
PLAIN = {float: "number", int: "integer", str: "string", bool: "boolean", type(None): "null"}
ALONE = ("error", "information")  # failures and help have no failure beside them


def fields(document: Any) -> dict[str, Any]:
    """Type of each field; whether it is required is asked of the class."""
    hints = get_type_hints(document, include_extras=True)
    return {
        name: get_args(t)[0] if get_origin(t) is NotRequired else t for name, t in hints.items()
    }


def parts(told: Any) -> Iterator[Any]:
    """Every document that a type names, each time it does, but what lies within it once."""
    if is_typeddict(told):
        yield told
    for inner in get_args(told) if get_origin(told) is not Literal else ():
        yield from parts(inner)


def uses(documents: list[Any]) -> Counter[Any]:
    """How often each document is named by these and by one another."""
    found: Counter[Any] = Counter()
    waiting = [*documents]
    while waiting:
        for told in fields(waiting.pop()).values():
            for part in parts(told):
                waiting += [part] if part not in found else []
                found[part] += 1
    return found


class Schemas:
    """Of one file: a document that has a place is named by it, another stands where it is used."""

    def __init__(self, places: Mapping[Any, str]) -> None:
        self.places = places

    def of(self, told: Any) -> dict[str, Any]:
        """Schema of a type."""
        origin, inner = get_origin(told), get_args(told)
        if origin is Annotated:
            schema = self.of(inner[0])
            for more in inner[1:]:
                words = {"description": more} if isinstance(more, str) else {}
                schema = words | schema | (words or dict(more))
            return schema
        if told is Any:
            return {}
        if told in PLAIN:
            return {"type": PLAIN[told]}
        if is_typeddict(told):
            return {"$ref": self.places[told]} if told in self.places else self.of_object(told)
        if origin is Literal:
            return {"const": inner[0]} if len(inner) == 1 else {"enum": [*inner]}
        if origin is list:
            return {"type": "array", "items": self.of(inner[0])}
        if origin is dict:
            return self._of_names(*inner)
        if origin in (Union, types.UnionType):
            return self._of_any(inner)
        raise TypeError(f"{told}: no JSON schema is known for this type")

    def of_object(self, document: Any) -> dict[str, Any]:
        """Schema of a document itself."""
        words = " ".join((document.__doc__ or "").split()) if "__doc__" in vars(document) else ""
        told = fields(document)
        return {
            **({"description": words} if words and not words.startswith("dict(") else {}),
            "type": "object",
            "required": [name for name in told if name in document.__required_keys__],
            "additionalProperties": False,
            "properties": {name: self.of(of) for name, of in told.items()},
        } | shared.RULES.get(document, {})

    def _of_names(self, name: Any, value: Any) -> dict[str, Any]:
        names = {"propertyNames": {k: v for k, v in self.of(name).items() if k != "type"}}
        schema = {"type": "object", **(names if name is not str else {})}
        return schema if value is Any else schema | {"additionalProperties": self.of(value)}

    def _of_any(self, choices: tuple[Any, ...]) -> dict[str, Any]:
        schemas = [self.of(choice) for choice in choices if choice is not type(None)]
        if type(None) not in choices:
            return {"anyOf": schemas}
        if len(schemas) == 1 and not {"$ref", "enum", "const"} & {*schemas[0]}:
            return schemas[0] | {"type": [schemas[0]["type"], "null"]}
        return {"anyOf": [*schemas, {"type": "null"}]}


def place(document: Any, file: str = "") -> str:
    """Where a document's schema is found."""
    name = re.sub(
        r"(?<=[a-z0-9])(?=[A-Z])", "_", document.__name__.removesuffix("Document")
    ).lower()
    return f"{file}#/$defs/{name}"


def definitions(schemas: Schemas, documents: list[Any]) -> dict[str, Any]:
    """What stands below ``$defs``."""
    return {place(one).rpartition("/")[2]: schemas.of_object(one) for one in documents}


def schema_file(name: str, common: Mapping[Any, str]) -> dict[str, Any]:
    """The schema of what a command prints."""
    title, failing, documents = shared.PRINTED[name]
    found = uses(documents)
    local = [one for one, times in found.items() if times > 1 and one not in common]
    local += [one for one in documents if len(documents) > 1 and one not in local]
    schemas = Schemas({**common, **{one: place(one) for one in local}})
    made = [schemas.of(one) for one in documents]
    whole = made[0] if len(made) == 1 else {"anyOf": made}
    told = {"$schema": DIALECT, "$id": f"{name}.json", "title": title}
    failed = {"if": {"required": ["error"]}, "then": {"$ref": common[shared.FailureDocument]}}
    if name in ALONE:
        told |= whole
    elif failing == "alone":
        told |= failed | {"else": whole}
    elif failing == "beside":
        told |= failed | {"else": {"required": whole.pop("required")}} | whole
    else:
        told |= failed | whole
    more = definitions(schemas, local)
    return told | ({"$defs": more} if more else {})


def all_schemas() -> dict[str, str]:
    """Text of each file of docs/schemas, by its name."""
    for path in sorted((ROOT / "robocal_ros").glob("*/documents.py")):
        importlib.import_module(f"robocal_ros.{path.parent.name}.documents")
    own = [
        one
        for one in vars(shared).values()
        if is_typeddict(one) and one.__module__ == shared.__name__
    ]
    own.remove(shared.InformationDocument)
    inside = Schemas({one: place(one) for one in own})
    title = "Parts that the documents of several commands share"
    files: dict[str, Any] = {
        "common.json": {
            "$schema": DIALECT, "$id": "common.json", "title": title,
            "$defs": definitions(inside, own),
        }
    }  # fmt: skip
    common = {one: place(one, "common.json") for one in own}
    files |= {f"{name}.json": schema_file(name, common) for name in sorted(shared.PRINTED)}
    return {name: written(schema) + "\n" for name, schema in files.items()}


def written(schema: dict[str, Any], indent: int = 0) -> str:
    """As JSON with each field of a document in a line of its own."""
    inner = " " * (indent + 2)
    rows = []
    for name, value in schema.items():
        if name == "else":
            text = written(value, indent + 2)
        elif name in ("properties", "$defs"):
            told = {
                key: written(one, indent + 4)
                if name == "$defs"
                else json.dumps(one, ensure_ascii=False)
                for key, one in value.items()
            }
            text = ",\n".join(f"{inner}  {json.dumps(key)}: {one}" for key, one in told.items())
            text = f"{{\n{text}\n{inner}}}"
        else:
            text = json.dumps(value, ensure_ascii=False)
        rows.append(f"{inner}{json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(rows) + "\n" + " " * indent + "}"


def main() -> None:
    """Write them, and remove those that nothing declares."""
    made = all_schemas()
    for path in FOLDER.glob("*.json"):
        if path.name not in made:
            path.unlink()
    for name, text in made.items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    print(f"{len(made)} schemas in {FOLDER}")


if __name__ == "__main__":
    main()
