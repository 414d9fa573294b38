"""Validation of a document against a pydantic schema; all faults become one message."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from pkmcal.errors import InputError
from pkmcal.files.documents import LARGEST_WRITTEN_NUMBER, Document, Keys, closest, quoted
from pkmcal.files.limits import MOST_FAULTS_NAMED
from pkmcal.wording import listed

JsonSchema = Mapping[str, Any]
LONGEST_REPR = 200
SchemaModel = TypeVar("SchemaModel", bound=BaseModel)


class Schema(BaseModel):
    """Base of every file's schema: unknown keys refused, types exact, numbers finite.

    The ``description`` of a field completes "expected …" in the message about its absence: a noun
    phrase, such as "the camera's file, for example cameras/front.yaml".
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def __repr__(self) -> str:
        text = super().__repr__()
        return text if len(text) <= LONGEST_REPR else f"{text[: LONGEST_REPR - 1]}…"


class FieldError(ValueError):
    """Fault of a value, raised by a validator of a schema; what, found, expected : as in
    :class:`~pkmcal.errors.PkmcalError`. The validated document has its place.
    """

    def __init__(self, what: str, *, found: object = None, expected: str | None = None) -> None:
        super().__init__(what)
        self.error = InputError(what, found=found, expected=expected)

    def __str__(self) -> str:
        return str(self.error)


def validated_document(document: Document, model: type[SchemaModel]) -> SchemaModel:
    """The document as a `model`; raises one `InputError` about all of its faults.

    The first fault in the file's order makes the sentence; the places of the others follow, so that
    all can be corrected at once.
    """
    try:
        # By way of JSON, because there a list may become a tuple while types stay exact.
        value = model.model_validate_json(json.dumps(document.data))
        _check_numbers(document, value.model_dump(by_alias=True))
        return value
    except ValidationError as error:
        value = error.errors()
        # entries of a list that have faults of their own are not counted: it is not too short
        entries = {details["loc"][:-k] for details in value for k in range(1, len(details["loc"]))}
        value = [d for d in value if d["type"] != "too_short" or d["loc"] not in entries]
        value.sort(key=lambda details: _line(document, details))
        schema = model.model_json_schema()
        faults = [_fault(document, schema, details) for details in value[:MOST_FAULTS_NAMED]]
    # A required key that is misspelt is one mistake, not one unknown and one missing key.
    meant = {(*fault.keys[:-1], fault.guess) for fault in faults if fault.guess}
    faults = [fault for fault in faults if not (fault.missing and fault.keys in meant)]
    faults.sort(key=lambda fault: fault.line)
    first = faults[0].error
    others = dict.fromkeys(str(fault.error.where) for fault in faults[1:])
    others.pop(str(first.where), None)
    if not others:
        raise first
    places = listed([place.removeprefix(f"{document.label}, ") for place in others])
    step = f"{first.next_step.rstrip('.')}, then" if first.next_step else "Then"
    raise first.with_fields(next_step=f"{step} look at {places}")


def _check_numbers(document: Document, fields: dict[str, Any]) -> None:
    """Raise `InputError` for a number that is too large, in any field that is used."""
    todo: list[tuple[Keys, Any]] = [((), fields)]
    while todo:
        keys, value = todo.pop()
        if isinstance(value, Mapping):
            todo += [((*keys, str(key)), item) for key, item in value.items()]
        elif isinstance(value, (list, tuple)):
            todo += [((*keys, k), item) for k, item in enumerate(value)]
        elif isinstance(value, int | float) and abs(value) > LARGEST_WRITTEN_NUMBER:
            raise InputError(
                "this number is too large for any quantity",
                where=document.where(*keys),
                found=quoted(value),
                expected=f"at most {LARGEST_WRITTEN_NUMBER:g}",
            )


@dataclass(frozen=True)
class _Fault:
    """One of pydantic's errors: its place in the file, the key that was probably meant, and our
    error.
    """

    line: int
    keys: Keys
    missing: bool
    guess: str | None
    error: InputError


def _line(document: Document, details: ErrorDetails) -> int:
    """Line of a fault's key, or of the mapping that lacks it."""
    keys = _keys_in(document.data, details["loc"], missing=details["type"] == "missing")
    return document.lines.get(keys, document.lines.get(keys[:-1], 0))


def _fault(document: Document, root: JsonSchema, details: ErrorDetails) -> _Fault:
    """Convert one of pydantic's errors."""
    missing = details["type"] == "missing"
    keys = _keys_in(document.data, details["loc"], missing=missing)
    # a missing entry of a list is reported as a list that is too short
    short = missing and isinstance(keys[-1], int)
    keys = keys[:-1] if short else keys
    location = details["loc"][:-1] if short else details["loc"]
    schemas = _schemas_at(root, location)
    what, value, expected = _phrases(details, keys, schemas, short=short)
    unknown = details["type"] == "extra_forbidden"
    return _Fault(
        line=document.lines.get(keys, document.lines.get(keys[:-1], 0)),
        keys=keys,
        missing=missing,
        guess=closest(str(keys[-1]), _schema_keys(schemas)) if unknown else None,
        error=InputError(what, where=document.where(*keys), found=value, expected=expected),
    )


def _phrases(
    details: ErrorDetails, keys: Keys, schemas: list[JsonSchema], *, short: bool
) -> tuple[str, str | None, str | None]:
    """What, found and expected of a fault."""
    kind, context, value = details["type"], details.get("ctx", {}), details["input"]
    if short:
        wanted = max(len(schema.get("prefixItems", ())) for schema in schemas)
        return _WHAT["too_short"], quoted(value), _description(schemas) or f"{wanted} entries"
    if kind == "missing":
        return "this is missing", None, _description(schemas) or "a value"
    if kind == "extra_forbidden":
        allowed = _schema_keys(schemas)
        guess = closest(str(keys[-1]), allowed)
        expected = f"{guess} (known here: {', '.join(allowed)})" if guess else listed(allowed, 12)
        return "this key is not known", str(keys[-1]), expected or None
    # unions by a tag
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tags = context.get("expected_tags") or _tags(schemas)
        return (
            f"no valid {context['discriminator']}".replace("'", ""),
            str(context["tag"]) if "tag" in context else None,
            f"one of {tags}".replace("'", ""),
        )
    if kind == "value_error":
        # by a schema's own validator
        error = context["error"]
        if isinstance(error, FieldError):
            return error.error.what, error.error.found, error.error.expected
        return str(error), quoted(value), None
    if kind == "too_long" and isinstance(value, (list, dict)):
        entries = f"{len(value)} entries"
        return _WHAT[kind], entries, _EXPECTED[kind].format_map(context)
    # types and ranges
    limits = {name: f"{x:g}" if isinstance(x, float) else str(x) for name, x in context.items()}
    expected = (
        _EXPECTED[kind].format_map(limits)
        if kind in _EXPECTED
        else details["msg"].removeprefix("Input should be ")
    )
    return _WHAT.get(kind, "this value cannot be used"), quoted(value), expected


_WHAT = {
    "finite_number": "this is not a finite number",
    "too_long": "this has too many entries",
    "too_short": "this has too few entries",
}

_EXPECTED = {
    "finite_number": "a number",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list, such as [1, 2, 3]",
    "tuple_type": "a list, such as [1, 2, 3]",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of {ge} or more",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of {le} or less",
    "literal_error": "{expected}",
    "too_long": "at most {max_length}",
    "too_short": "at least {min_length}",
    "string_too_long": "text of {max_length} characters at most",
    "string_too_short": "text of {min_length} characters at least",
}
"""Phrase for each of pydantic's error types; other types keep pydantic's message."""


def _keys_in(data: Any, location: tuple[int | str, ...], *, missing: bool) -> Keys:
    """Keys of a pydantic location without those that the file does not contain (names of union
    members).
    """
    keys: list[int | str] = []
    for position, key in enumerate(location):
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            if not (missing and position == len(location) - 1):
                continue
        keys.append(key)
    return tuple(keys)


def _schemas_at(root: JsonSchema, location: tuple[int | str, ...]) -> list[JsonSchema]:
    """JSON schemas of a location, one for each member of a union; its parent's if it has none."""
    value = _members(root, root)
    for key in location:
        children = [child for schema in value for child in _children(schema, key)]
        if children:
            value = [member for child in children for member in _members(root, child)]
    return value


def _members(root: JsonSchema, schema: JsonSchema) -> list[JsonSchema]:
    """A schema with its references followed and its unions expanded."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        target = _members(root, root["$defs"][name])
        # keys beside a reference (a field's description) belong to the field: they come first
        beside = {key: value for key, value in schema.items() if key != "$ref"}
        return [beside, *target] if beside else target
    nested = [member for word in ("anyOf", "oneOf", "allOf") for member in schema.get(word, ())]
    return [schema, *(deep for member in nested for deep in _members(root, member))]


def _children(schema: JsonSchema, key: int | str) -> list[JsonSchema]:
    """Schemas that one step down from `schema` may have: a property, a tag, an entry."""
    if isinstance(key, int):
        entries = schema.get("prefixItems", ())
        candidate = entries[key] if key < len(entries) else schema.get("items")
        return [candidate] if isinstance(candidate, dict) else []
    if key in schema.get("properties", {}):
        return [schema["properties"][key]]
    tagged = schema.get("discriminator", {}).get("mapping", {})
    if key in tagged:
        return [{"$ref": tagged[key]}]
    patterns = list(schema.get("patternProperties", {}).values())
    return [
        child for child in (*patterns, schema.get("additionalProperties"))
        if isinstance(child, dict)
    ]  # fmt: skip


def _schema_keys(schemas: list[JsonSchema]) -> list[str]:
    """Names of all properties."""
    return sorted({name for schema in schemas for name in schema.get("properties", {})})


def _description(schemas: list[JsonSchema]) -> str | None:
    # A schema with properties is a model, whose description is its docstring, not the field's.
    """Description of a field, without its full stop."""
    texts = [
        schema["description"]
        for schema in schemas
        if "description" in schema and "properties" not in schema
    ]
    return texts[0].rstrip(".") if texts else None


def _tags(schemas: list[JsonSchema]) -> str:
    """Names of all members of a tagged union."""
    mappings = [schema.get("discriminator", {}).get("mapping", {}) for schema in schemas]
    return ", ".join(tag for mapping in mappings for tag in mapping)
