"""YAML files whose every value remembers its line.

Scalars follow YAML 1.2, as JSON does: ``1e-5`` is a number, ``on`` and ``no`` are words, ``010``
is ten, and a date is text. PyYAML's own YAML 1.1 turns these into text, booleans, eight and
a date, each of them a silent error in a measurement's description.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pkmcal.errors import InputError
from pkmcal.files.text import read_text, shown

Keys = tuple[str | int, ...]
"""Where a value stands in a file: keys and zero-based list indices from the top."""

MOST_VALUES = 200_000
"""Values a file may expand to. A large machine has a thousand; aliases of aliases reach billions
from one short line, and would fill the memory."""

_TAG = "tag:yaml.org,2002:"
_SCALARS = (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", r"<<", "<"),
)
_CONSTRUCT: dict[str, Callable[[str], str | int | float | bool | None]] = {
    "str": str,
    "null": lambda _: None,
    "bool": lambda text: text.lower() == "true",
    # Decimal whatever the leading zeros; YAML 1.1 reads 010 as eight.
    "int": int,
    "float": lambda text: float(text.lower().replace(".inf", "inf").replace(".nan", "nan")),
}


@dataclass(frozen=True)
class Document:
    """A file's content and the line of each of its values.

    label : the file's name in messages.
    data : plain dicts, lists, str, int, float, bool and None; keys are str.
    lines : line (from 1) by keys; a mapping's value has its key's line.
    """

    path: Path
    label: str
    data: dict[str, Any]
    lines: Mapping[Keys, int]

    def where(self, *keys: str | int) -> str:
        """Name file, line and field, as in "session.yaml, line 12, stations.front.camera".

        A field that is missing has its nearest parent's line, and none at the top.
        """
        known = keys
        while known and known not in self.lines:
            known = known[:-1]
        line = f", line {self.lines[known]}" if known else ""
        return f"{self.label}{line}" + (f", {field_path(keys)}" if keys else "")


def field_path(keys: Keys) -> str:
    """Write keys as a path; lists count from 1, as parameter names do: ``legs[1].base.center``."""
    text = "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key}" for key in keys)
    return text.removeprefix(".")


def read_yaml(path: Path | str, label: str | None = None) -> Document:
    """Read a YAML file whose top is a mapping; every fault is an `InputError` with its line."""
    path = Path(path)
    return parse_yaml(read_text(path, label), path, label)


def parse_yaml(text: str, path: Path, label: str | None = None) -> Document:
    """As `read_yaml`, on text that is already in hand; `path` only names it."""
    label = label or path.name
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            raise InputError("the file is empty", where=label, expected="keys and values")
        builder = _Builder(loader, label)
        data = builder.value(node, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        # PyYAML's own words for a list after a mapping and the like are good enough to act on.
        problem = error.problem or error.context or "cannot be understood"
        raise InputError(
            f"not valid YAML ({problem})",
            where=label + line,
            next_step="Check indentation, quotes and brackets on this line and the one above",
        ) from None
    except RecursionError:
        raise InputError("the file is nested too deeply to be read", where=label) from None
    except yaml.reader.ReaderError as error:
        raise InputError(
            "not a text file", where=label, found=f"character #x{error.character:04x}"
        ) from None
    if not isinstance(data, dict):
        raise InputError(
            "the top of the file is not a mapping",
            where=label,
            found=shown(data),
            expected="lines of the form key: value",
        )
    return Document(path, label, data, builder.lines)


def yaml_text(data: Mapping[str, Any]) -> str:
    """Write plain data as YAML that `read_yaml` reads back the same; short lists stay on one line.

    Keys keep their order; floats are written in full (shortest text with the same value).
    """
    style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "width": 100}
    return yaml.dump(dict(data), Dumper=_Dumper, allow_unicode=True, **style)


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with YAML 1.2's scalars."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    """Its counterpart: quotes what `_Loader` would not read as text; never writes aliases."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        return True


def _text_node(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    # PyYAML leaves these line breaks bare between single quotes, and reads them back as blanks.
    style = '"' if any(mark in text for mark in "\x85\u2028\u2029") else None
    return dumper.represent_scalar(_TAG + "str", text, style=style)


_Dumper.add_representer(str, _text_node)
for _name, _pattern, _first in _SCALARS:
    for _kind in (_Loader, _Dumper):
        _kind.add_implicit_resolver(
            _TAG + _name, re.compile(rf"(?:{_pattern})\Z"), [c.strip("\0") for c in _first]
        )


class _Builder:
    """Turns a YAML node tree into plain data, noting lines and refusing what would be misread."""

    def __init__(self, loader: _Loader, label: str) -> None:
        self.loader = loader
        self.label = label
        self.lines: dict[Keys, int] = {}
        self._open: set[int] = set()
        self._count = 0

    def value(self, node: yaml.Node, keys: Keys) -> Any:
        """Plain data of a node that stands at `keys`."""
        self.lines.setdefault(keys, node.start_mark.line + 1)
        self._count += 1
        if id(node) in self._open or self._count > MOST_VALUES:
            raise self._error(node, "an alias (*) repeats without end, or far too often")
        self._open.add(id(node))
        try:
            if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
                return self._mapping(node, keys)
            if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
                return [self.value(child, (*keys, i)) for i, child in enumerate(node.value)]
            return self._scalar(node)
        finally:
            self._open.discard(id(node))

    def _mapping(self, node: yaml.MappingNode, keys: Keys) -> dict[str, Any]:
        seen: dict[str, int] = {}
        for key_node, _ in node.value:
            key, line = self._key(key_node), key_node.start_mark.line + 1
            if key in seen:
                raise InputError(
                    f"the key {key} stands twice, on lines {seen[key]} and {line}",
                    where=f"{self.label}, line {line}, {field_path((*keys, key))}",
                    next_step="Remove one of the two",
                )
            seen[key] = line
        # Merges (<<) put their pairs first, so that a mapping's own keys win; writing the pairs
        # back keeps an alias to this node from meeting them as duplicates.
        self.loader.flatten_mapping(node)
        pairs = {self._key(pair[0]): pair for pair in node.value}
        node.value = list(pairs.values())
        for key, (key_node, _) in pairs.items():
            self.lines[(*keys, key)] = key_node.start_mark.line + 1
        return {key: self.value(child, (*keys, key)) for key, (_, child) in pairs.items()}

    def _scalar(self, node: yaml.Node) -> str | int | float | bool | None:
        kind = node.tag.removeprefix(_TAG)
        if not isinstance(node, yaml.ScalarNode) or kind not in _CONSTRUCT:
            raise self._error(node, f"the tag {node.tag} is not allowed here")
        try:
            return _CONSTRUCT[kind](node.value)
        except ValueError:
            raise self._error(node, f"{shown(node.value)} is not a usable {kind}") from None

    def _key(self, node: yaml.Node) -> str:
        if not isinstance(node, yaml.ScalarNode):
            raise self._error(node, "a key is a list or a mapping; it should be a word")
        return node.value

    def _error(self, node: yaml.Node, what: str) -> InputError:
        return InputError(what, where=f"{self.label}, line {node.start_mark.line + 1}")
