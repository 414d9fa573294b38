"""Text, YAML with line numbers, and JSON: reading and writing, and phrases for messages."""

from __future__ import annotations

import codecs
import difflib
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pkmcal.errors import InputError, legible
from pkmcal.files.limits import (
    LARGEST_TEXT_FILE,
    LARGEST_WRITTEN_FILE,
    MOST_CHARACTERS,
    MOST_NESTED_LEVELS,
    MOST_VALUES,
    MOST_YAML_NODES,
)
from pkmcal.files.recordings import RECORDING_HEAD_BYTES, recording_error
from pkmcal.files.regular import check_regular
from pkmcal.files.replacing import check_replaced

BINARY_KINDS = {
    b"PK\x03\x04": "a spreadsheet",
    b"\xd0\xcf\x11\xe0": "a spreadsheet",
    b"\x89PNG": "an image",
    b"\xff\xd8\xff": "an image",
}
"""Kinds of files, by their first bytes, that are named by mistake for a text file."""
LONGEST_QUOTE = 60
"""Characters of a value that a message quotes: enough to recognise it, on one line."""
SHORTEST_PART = 4
"""Letters from which on a part of a name is recognised as the whole."""
LONGEST_CACHED_TEXT = 2**15
"""Characters up to which a text's node tree is cached: of the sixteen trees some 100 MB at most."""
TEXT_BLOCK_BYTES = 2**20
"""Bytes of a text in memory at a time, where it is read line by line."""


def read_text(path: Path, label: str | None = None, largest: int = LARGEST_TEXT_FILE) -> str:
    """Text of a UTF-8 file, without byte-order mark and with Unix line ends.

    label : the file's name in messages; by default the last part of the path.
    largest : largest size in bytes.
    """
    return "".join(text_blocks(path, label or path.name, largest))


def read_log(path: Path) -> str:
    """Text that a program printed, as a host or a shell saved it, with Unix line ends.

    UTF-8, or UTF-16 with its byte-order mark; bytes of other encodings, such as a degree sign in
    Latin-1, are replaced.
    """
    raw = b"".join(_raw_blocks(path, path.name, LARGEST_TEXT_FILE, TEXT_BLOCK_BYTES))
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raw = raw.decode("utf-16", "replace").encode()
    elif not raw.startswith(tuple(BINARY_KINDS)):
        raw = raw.decode("utf-8", "replace").encode()
    return _decoded(raw, path.name, 0).removeprefix("\ufeff")


def text_blocks(
    path: Path, label: str, largest: int = LARGEST_TEXT_FILE, block_bytes: int = TEXT_BLOCK_BYTES
) -> Iterator[str]:
    """Text of a UTF-8 file in blocks of whole lines of some ``block_bytes`` bytes each, so that a
    table of many megabytes does not have to fit into memory.
    """
    lines, mark = 0, "\ufeff"
    for raw in _raw_blocks(path, label, largest, block_bytes):
        yield _decoded(raw, label, lines).removeprefix(mark)
        lines, mark = lines + raw.count(b"\n"), ""


def _raw_blocks(path: Path, label: str, largest: int, block_bytes: int) -> Iterator[bytes]:
    """Bytes of a file, cut after line ends of any kind."""
    try:
        check_replaced(path.parent)
        check_regular(path, label)
        with path.open("rb") as stream:
            head = stream.read(RECORDING_HEAD_BYTES)
            stream.seek(0)
            if error := recording_error(head, label, "a text file"):
                raise error
            size = os.fstat(stream.fileno()).st_size
            if size > largest:
                raise InputError(
                    "the file is too large",
                    where=label,
                    found=f"{size} bytes",
                    expected=f"at most {largest}",
                    code="file.too_large",
                )
            rest: list[bytes] = []
            while block := stream.read(block_bytes):
                # a carriage return at the end may be half of a line end
                end = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1
                if end:
                    yield b"".join([*rest, block[:end]])
                    rest = []
                rest.append(block[end:])
            yield b"".join(rest)
    except FileNotFoundError:
        raise InputError(
            "the file does not exist",
            where=label,
            expected=wanted_file(path),
            code="file.missing",
        ) from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"the file cannot be read ({reason})", where=label, code="file.unreadable"
        ) from None


def _decoded(raw: bytes, label: str, before: int) -> str:
    """Text of a block with Unix line ends; before : number of lines before the block."""
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = before + raw.count(b"\n", 0, error.start) + 1
        for beginning, kind in BINARY_KINDS.items():
            if before == 0 and raw.startswith(beginning):
                spreadsheet = kind == "a spreadsheet"
                raise InputError(
                    "the file is not text",
                    where=label,
                    found=kind,
                    expected="a text file",
                    next_step="Save it as CSV (comma delimited)" if spreadsheet else None,
                    code="file.not_text",
                ) from None
        raise InputError(
            "the file is not UTF-8 text",
            where=f"{label}, line {line}",
            found=f"byte 0x{raw[error.start]:02x}",
            expected="UTF-8",
            next_step="Save it as UTF-8 in the editor",
            code="file.not_text",
        ) from None
    if "\0" in text:
        line = before + text.count("\n", 0, text.index("\0")) + 1
        raise InputError(
            "the file is not text",
            where=f"{label}, line {line}",
            found="a zero byte",
            expected="UTF-8, which has none",
            next_step="Save it as UTF-8 in the editor",
            code="file.not_text",
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def wanted_file(path: Path) -> str:
    """Phrase about the file that is missing, with a file of a similar name that exists."""
    folder = path.parent
    if not folder.is_dir():
        return f"a file {path} (its folder does not exist either)"
    # compared by stem, since all files of one kind share their suffix
    stems = {entry.stem: entry.name for entry in sorted(folder.iterdir(), reverse=True)}
    neighbour = stems.get(closest(path.stem, stems) or "")
    return f"a file {path}" + (f" (there is {neighbour})" if neighbour else "")


def closest(name: str, names: Iterable[str]) -> str | None:
    """The name that a misspelt one most likely means, or None."""
    by_lower = {candidate.lower(): candidate for candidate in names}
    if len(name) >= SHORTEST_PART:  # such as gough of gough-stewart
        whole = [candidate for candidate in by_lower if name.lower() in candidate]
        if len(whole) == 1:
            return by_lower[whole[0]]
    # 0.6 is difflib's own threshold: one or two wrong letters in a short key.
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.6)
    return by_lower[matches[0]] if matches else None


def quoted(value: object) -> str:
    """Quote a value for a message, shortened to LONGEST_QUOTE characters."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    return text if len(text) <= LONGEST_QUOTE else text[: LONGEST_QUOTE - 1] + "…"


Keys = tuple[str | int, ...]
"""Path of a value in a file: keys and zero-based list indices from the top."""

LARGEST_WRITTEN_NUMBER = 1e15
"""Largest number in a file, whatever its unit: the fourth power of a larger one, and higher powers,
would overflow."""
_NO_TEXT = re.compile("[\0\ud800-\udfff]")
"""Zero, which no file name may contain, and surrogates, which cannot be encoded."""

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
    """Content of a file with the line of each of its values.

    label : the file's name in messages.
    data : plain dicts, lists, str, int, float, bool and None; keys are str.
    lines : line (from 1) by keys; a mapping's value has its key's line.
    """

    path: Path
    label: str
    data: dict[str, Any]
    lines: Mapping[Keys, int]

    def where(self, *keys: str | int) -> str:
        """File, line and field for a message, as in "session.yaml, line 12, stations.front.camera".

        A missing field has the line of its nearest parent, and none at the top.
        """
        nearest = keys
        while nearest and nearest not in self.lines:
            nearest = nearest[:-1]
        line = f", line {self.lines[nearest]}" if nearest else ""
        return f"{self.label}{line}" + (f", {field_path(keys)}" if keys else "")


def field_path(keys: Keys) -> str:
    """Keys as a path; lists count from 1, as parameter names do: ``legs[1].base.center``."""
    text = "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key}" for key in keys)
    return text.removeprefix(".")


def read_yaml(path: Path | str, label: str | None = None) -> Document:
    """Read a YAML file whose top is a mapping; every fault raises an `InputError` with its line."""
    path = Path(path)
    return parse_yaml(read_text(path, label, LARGEST_WRITTEN_FILE), path, label)


def parse_yaml(text: str, path: Path, label: str | None = None) -> Document:
    """Parse YAML text as `read_yaml` does; `path` only names it."""
    label = label or path.name
    try:
        compose = _recently_composed if len(text) <= LONGEST_CACHED_TEXT else _composed
        node = compose(text)
        if node is None:
            raise InputError("the file is empty", where=label, expected="keys and values")
        builder = _Builder(label)
        data = builder.value(node, ())
    except _LimitError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(str(error.problem), where=label + line, code=error.note) from None
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
    except yaml.reader.ReaderError as error:
        raise InputError(
            "not a text file",
            where=label,
            found=f"character #x{error.character:04x}",
            code="file.not_text",
        ) from None
    if not isinstance(data, dict):
        raise InputError(
            "the top of the file is not a mapping",
            where=label,
            found=quoted(data),
            expected="lines of the form key: value",
        )
    return _checked(Document(path, label, data, builder.lines))


def _composed(text: str) -> yaml.Node | None:
    """Node tree of a text, None for an empty one; raises the errors of PyYAML."""
    return _Loader(text).get_single_node()


_recently_composed = lru_cache(maxsize=16)(_composed)
""":func:`_composed`, cached because a machine's file is read again by every step that needs it, and
PyYAML takes as long as a small estimate; nodes are not changed."""


def compose_yaml(text: str) -> yaml.Node:
    """Node tree of a text that `parse_yaml` has accepted, with the position of each node."""
    node = _composed(text)
    if node is None:
        raise InputError("the file is empty", expected="keys and values")
    return node


def _checked(document: Document) -> Document:
    """The document, if all its texts can be written and it is not nested too deeply; else raise
    `InputError`.
    """
    todo: list[tuple[Keys, Any]] = [((), document.data)]
    while todo:
        keys, value = todo.pop()
        if len(keys) > MOST_NESTED_LEVELS:
            raise InputError(
                f"nested too deeply, in more than {MOST_NESTED_LEVELS} levels",
                where=document.where(*keys),
                code="file.nested_too_deeply",
            )
        if isinstance(value, str):
            _check_characters(document, keys, value)
        elif isinstance(value, dict):
            for key, item in value.items():
                _check_characters(document, (*keys, key), key)
                todo.append(((*keys, key), item))
        elif isinstance(value, list):
            todo += [
                ((*keys, k), item)
                for k, item in enumerate(value)
                if isinstance(item, (str, dict, list))
            ]
    return document


def _check_characters(document: Document, keys: Keys, text: str) -> None:
    """Raise `InputError` for a character that cannot be written."""
    if bad := _NO_TEXT.search(text):
        raise InputError(
            "this text holds a character that cannot be written",
            where=_NO_TEXT.sub("?", document.where(*keys)),
            found=f"\\u{ord(bad[0]):04x} in {quoted(text)}",
            expected="letters, digits and signs",
        )


def yaml_text(data: Mapping[str, Any]) -> str:
    """Plain data as YAML text that `read_yaml` reads back unchanged; short lists stay on one line.

    Keys keep their order; floats are written in full (shortest text with the same value).
    """
    style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "width": 100}
    return yaml.dump(dict(data), Dumper=_Dumper, allow_unicode=True, **style)


class _LimitError(yaml.MarkedYAMLError):
    """A file exceeds one of the limits; note : the code of the error."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with YAML 1.2's scalars and limits on nesting and number of values."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012
    depth = 0
    nodes = 0
    top = ""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node; raises _LimitError for one too deep or too many."""
        if self.depth == 1:
            self.top = getattr(index, "value", "")
        if self.depth > MOST_NESTED_LEVELS:
            mark = self.peek_event().start_mark
            what = f"{self.top} is nested too deeply, in more than {MOST_NESTED_LEVELS} levels"
            raise _LimitError(problem=what, problem_mark=mark, note="file.nested_too_deeply")
        self.nodes += 1
        if self.nodes > MOST_YAML_NODES:
            raise _LimitError(
                problem=f"there are more than {MOST_YAML_NODES} keys and values up to here",
                problem_mark=self.peek_event().start_mark,
                note="file.too_many_values",
            )
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1


class _Dumper(yaml.SafeDumper):
    """Counterpart of `_Loader`: quotes text that it would not read as text, and writes no
    aliases.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        """Write every value in full."""
        return True

    def write_double_quoted(self, text: str, split: bool = True) -> None:
        """Escape all but ASCII if any character of the text is not legible."""
        allowed = self.allow_unicode
        self.allow_unicode = allowed and legible(text, keep="\n\t") == text
        super().write_double_quoted(text, split)
        self.allow_unicode = allowed


def _text_node(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    # PyYAML leaves odd line breaks bare between single quotes, and reads them back as blanks.
    """Scalar of a text; double-quoted where any character is not legible."""
    style = None if legible(text, keep="\n\t") == text else '"'
    return dumper.represent_scalar(_TAG + "str", text, style=style)


_Dumper.add_representer(str, _text_node)
for _name, _pattern, _first in _SCALARS:
    for _kind in (_Loader, _Dumper):
        _kind.add_implicit_resolver(
            _TAG + _name, re.compile(rf"(?:{_pattern})\Z"), [c.strip("\0") for c in _first]
        )


_Pairs = dict[str, tuple[yaml.Node, yaml.Node]]
"""Keys of a mapping, with the nodes of key and value."""


class _Builder:
    """Converts a YAML node tree to plain data; records lines, and refuses what would be misread."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.lines: dict[Keys, int] = {}
        self._open: set[int] = set()
        self._merged: dict[int, _Pairs] = {}
        self._count = 0
        self._characters = 0
        self._counted: set[int] = set()
        self._aliases = False

    def value(self, node: yaml.Node, keys: Keys) -> Any:
        """Plain data of a node at `keys`."""
        self.lines.setdefault(keys, node.start_mark.line + 1)
        self._count_up(node)
        if len(keys) > MOST_NESTED_LEVELS:
            raise self._error(
                node,
                f"nested too deeply, in more than {MOST_NESTED_LEVELS} levels",
                keys,
                "file.nested_too_deeply",
            )
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
        """Plain data of a mapping; a repeated key is an error."""
        names_so_far: dict[str, int] = {}
        for key_node, _ in node.value:
            key, line = self._key(key_node), key_node.start_mark.line + 1
            if key in names_so_far:
                raise InputError(
                    f"the key {key} occurs twice, on lines {names_so_far[key]} and {line}",
                    where=f"{self.label}, line {line}, {field_path((*keys, key))}",
                    next_step="Remove one of the two",
                    code="file.key_twice",
                )
            names_so_far[key] = line
        pairs = self._pairs(node)
        for key, (key_node, _) in pairs.items():
            self.lines[(*keys, key)] = key_node.start_mark.line + 1
        return {key: self.value(child, (*keys, key)) for key, (_, child) in pairs.items()}

    def _pairs(self, node: yaml.MappingNode) -> _Pairs:
        """Pairs of a mapping, merged ones (<<) first; its own override these, and earlier merges
        later ones.
        """
        if id(node) in self._merged:
            return self._merged[id(node)]
        pairs: _Pairs = {}
        own: _Pairs = {}
        self._open.add(id(node))
        for key_node, child in node.value:
            if key_node.tag != _TAG + "merge":
                own[self._key(key_node)] = key_node, child
                continue
            several = isinstance(child, yaml.SequenceNode)
            for merged in reversed(child.value) if several else [child]:
                if not isinstance(merged, yaml.MappingNode):
                    raise self._error(merged, "<< merges mappings, and this is none")
                self._count_up(merged)
                for key, pair in self._pairs(merged).items():
                    self._count_up(merged)
                    pairs[key] = pair
        self._open.discard(id(node))
        pairs.update(own)
        return self._merged.setdefault(id(node), pairs)

    def _count_up(self, node: yaml.Node) -> None:
        """Count a value and raise an error beyond the limit; an alias makes thousands of one
        value.
        """
        self._count += 1
        self._characters += len(node.value) if isinstance(node, yaml.ScalarNode) else 0
        self._aliases = self._aliases or id(node) in self._counted
        self._counted.add(id(node))
        if id(node) in self._open:
            raise self._error(node, "an alias (*) repeats without end")
        for number, most, what in (
            (self._count, MOST_VALUES, "values"),
            (self._characters, MOST_CHARACTERS, "characters"),
        ):
            if number > most:
                repeated = ", of which aliases (*) repeat many" if self._aliases else ""
                raise self._error(
                    node,
                    f"the file holds too many {what}, more than {most}{repeated}",
                    code="file.aliases" if self._aliases else "file.too_many_values",
                )

    def _scalar(self, node: yaml.Node) -> str | int | float | bool | None:
        """Plain value of a scalar. Raises `InputError` for tags that are not allowed."""
        kind = node.tag.removeprefix(_TAG)
        if not isinstance(node, yaml.ScalarNode) or kind not in _CONSTRUCT:
            raise self._error(node, f"the tag {node.tag} is not allowed here")
        try:
            return _CONSTRUCT[kind](node.value)
        except ValueError:
            raise self._error(node, f"{quoted(node.value)} is not a usable {kind}") from None

    def _key(self, node: yaml.Node) -> str:
        """Text of a key. Raises `InputError` for a list or a mapping."""
        if not isinstance(node, yaml.ScalarNode):
            raise self._error(node, "a key is a list or a mapping; it should be a word")
        return node.value

    def _error(
        self, node: yaml.Node, what: str, keys: Keys = (), code: str | None = None
    ) -> InputError:
        """Error at a node's line."""
        place = f", {field_path(keys)}" if keys else ""
        where = f"{self.label}, line {node.start_mark.line + 1}{place}"
        return InputError(what, where=where, code=code)


_WIDEST = 160
"""Characters up to which a list or an object stays on one line."""


def json_value(value: Any) -> Any:
    """Convert arrays, tuples and NumPy numbers to JSON's types; numbers that are not finite become
    null.
    """
    if value is None or isinstance(value, str | int):  # most values; of Python's own types
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        finite = value.dtype.kind != "f" or bool(np.isfinite(value).all())
        return (
            value.tolist() if finite and value.dtype.kind in "fiub" else json_value(value.tolist())
        )
    if isinstance(value, (list, tuple)):
        if set(map(type, value)) == {float} and all(map(math.isfinite, value)):
            return list(value)  # a row of a matrix, as most numbers are
        return [json_value(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def json_text(value: Any) -> str:
    """Plain data as JSON text; short parts and rows of numbers stay on one line each."""
    return _text(json_value(value), "") + "\n"


def _text(value: Any, indent: str) -> str:
    """JSON text of a value that starts at an indent."""
    if not isinstance(value, (dict, list)) or _is_row(value):
        return _line(value)
    if not any(isinstance(item, (dict, list)) for item in _items(value)):
        line = _line(value)
        if len(line) <= _WIDEST:
            return line
    inner = indent + " "
    parts = [_text(item, inner) for item in _items(value)]
    if isinstance(value, dict):
        parts = [f"{_line(key)}: {part}" for key, part in zip(value, parts, strict=True)]
    opened, closed = "{}" if isinstance(value, dict) else "[]"
    return f"{opened}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{closed}"


_encoded = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode


def _line(value: Any) -> str:
    """JSON on one line. Characters that are not legible are escaped; surrogates, which no program
    reads back, are spelt out.
    """
    text = _encoded(value)
    if text.isprintable():
        return text
    return "".join(c if legible(c) == c else _escape(c) for c in text)


def _escape(sign: str) -> str:
    """JSON escape of a character; a surrogate is spelt out."""
    return json.dumps(legible(sign) if "\ud800" <= sign <= "\udfff" else sign)[1:-1]


_NUMBERS = {int, float, bool, type(None)}


def _items(value: dict[str, Any] | list[Any]) -> list[Any]:
    """Values of an object or a list."""
    return list(value.values()) if isinstance(value, dict) else value


def _is_row(value: Any) -> bool:
    """Whether a value is a row of numbers, which is easier to read on one line however long."""
    return isinstance(value, list) and _NUMBERS.issuperset(map(type, value))


def read_json(path: Path | str, label: str | None = None) -> Document:
    """Read a JSON file whose top is an object; its values have no lines."""
    path = Path(path)
    label = label or path.name
    text = read_text(path, label)
    try:
        data = json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise InputError(
            "the file is nested too deeply to be read", where=label, code="file.nested_too_deeply"
        ) from None
    except json.JSONDecodeError as error:
        raise InputError(
            f"not valid JSON ({error.msg})", where=f"{label}, line {error.lineno}"
        ) from None
    except ValueError:  # a number that JSON has not, or one of thousands of digits
        odd = next(match for match in _ODD.finditer(text) if match["number"])
        raise InputError(
            "not a number in JSON",
            where=f"{label}, line {text.count(chr(10), 0, odd.start()) + 1}",
            found=quoted(odd["number"]),
            expected="digits with at most one point and exponent, or null",
        ) from None
    if not isinstance(data, dict):
        raise InputError("the top of the file is not an object", where=label, found=quoted(data))
    return _checked(Document(path, label, data, {}))


_ODD = re.compile(r'"(?:\\.|[^"\\])*"?|(?P<number>NaN|-?Infinity|-?\d{1000,})')
"""Numbers outside strings that Python's reader refuses without their position."""


def _refuse(constant: str) -> float:
    """Raise ValueError for NaN and Infinity, which are not JSON."""
    raise ValueError(constant)
