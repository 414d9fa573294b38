"""Edit one mapping of a hand-written YAML file; all else stays byte for byte.

Only the characters of the numbers are replaced, at the parser's marks. A round trip through a
writer keeps comments but not the layout: with ruamel.yaml 8 of the 9 edits of the tests come out
otherwise, and mechanism files are indented anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pkmcal.errors import InputError
from pkmcal.files.documents import Document, compose_yaml, parse_yaml

MAPPING_INDENT = 2
"""Columns by which a new mapping stands in its parent."""


_Entry = Mapping[str, "_Entry"] | Sequence[float]
"""List of numbers, or a mapping of these."""


class _Change(NamedTuple):
    """Replacement of the characters start to stop of a text."""

    start: int
    stop: int
    text: str


def with_numbers(
    text: str,
    label: str,
    keys: tuple[str, ...],
    entry: Mapping[str, Sequence[float]],
    *,
    with_parent: bool = False,
) -> str:
    """Set lists of numbers in the mapping at `keys` of a YAML file; returns the new text.

    text : with the file's own line ends. keys : path of the mapping, which may be absent while its
    parent is present. Lists that are present are changed number by number, absent ones are added.
    with_parent : the parent may be absent too, and is added.
    Raises InputError where this is not possible without a change of anything else.
    """
    before = parse_yaml(text, Path(label), label)
    edit = _Edit(text, before)
    after = edit.done(keys, entry, with_parent)
    wanted = _with(before.data, keys, entry)
    # whatever is odd about a file: no other value of it may change
    if parse_yaml(after, Path(label), label).data != wanted:
        raise edit.refused(keys, "it stands in a way that cannot be changed by itself")
    return after


def _with(data: Any, keys: tuple[str, ...], entry: Mapping[str, Sequence[float]]) -> Any:
    """Plain data with the entry inserted."""
    if not keys:
        return {**(data or {}), **{name: list(values) for name, values in entry.items()}}
    return {**(data or {}), keys[0]: _with((data or {}).get(keys[0]), keys[1:], entry)}


@dataclass(frozen=True)
class _Edit:
    """A text and its parsed document."""

    text: str
    document: Document

    def done(
        self, keys: tuple[str, ...], entry: Mapping[str, Sequence[float]], with_parent: bool
    ) -> str:
        """The text with the entry inserted."""
        root = compose_yaml(self.text)
        shared = _shared(root)
        parent = root
        for depth, key in enumerate(keys[:-1]):
            child = self._child(parent, key)
            last = depth == len(keys) - 2
            if child is None and last and with_parent and isinstance(parent, yaml.MappingNode):
                return self._changed_text(self._added(parent, shared, key, {keys[-1]: entry}))
            if child is None or id(child) in shared:
                raise self.refused(keys, "it is merged or repeated (<<, &, *) from elsewhere")
            parent = child
        if not isinstance(parent, yaml.MappingNode):
            raise self.refused(keys, "what should hold it is no mapping")
        name, node = keys[-1], self._child(parent, keys[-1])
        if node is None:
            changes = self._added(parent, shared, name, entry)
        elif any(id(part) in shared for part in _parts(node)):
            raise self.refused(keys, "it is merged or repeated (<<, &, *) from elsewhere")
        elif isinstance(node, yaml.MappingNode):
            changes = self._changed(node, shared, keys, entry)
        else:  # null, written or not
            start, stop = _span(node)
            changes = [_Change(start, stop, " " * (start == stop) + _flow(entry))]
        return self._changed_text(changes)

    def _changed_text(self, changes: Sequence[_Change]) -> str:
        """The text with changes made."""
        text = self.text
        for change in sorted(changes, reverse=True):
            text = text[: change.start] + change.text + text[change.stop :]
        return text

    def _changed(
        self,
        node: yaml.MappingNode,
        shared: set[int],
        keys: tuple[str, ...],
        entry: Mapping[str, Sequence[float]],
    ) -> list[_Change]:
        """Changes of the present lists, number by number, and additions of the absent ones."""
        changes: list[_Change] = []
        absent: dict[str, Sequence[float]] = {}
        for name, values in entry.items():
            child = self._child(node, name)
            if child is None:
                absent[name] = values
            elif isinstance(child, yaml.SequenceNode) and len(child.value) == len(values):
                pairs = zip(child.value, values, strict=True)
                changes += [_Change(*_span(item), _number(value)) for item, value in pairs]
            else:
                raise self.refused((*keys, name), f"it is no list of {len(values)} numbers")
        for name, values in absent.items():
            changes += self._added(node, shared, name, values)
        return changes

    def _added(
        self,
        parent: yaml.MappingNode,
        shared: set[int],
        name: str,
        value: _Entry,
    ) -> list[_Change]:
        """Addition of a last entry to a mapping, in the mapping's own style."""
        inner = _inline(value)
        if parent.flow_style:
            stop = parent.end_mark.index - 1
            start = _end(parent.value[-1][1]) if parent.value else stop
            return [_Change(start, start, f"{', ' if parent.value else ''}{name}: {inner}")]
        key, last = parent.value[-1]
        indent = " " * parent.value[0][0].start_mark.column
        lines = [f"{indent}{name}: {inner}"]
        if isinstance(value, Mapping):
            deeper = indent + " " * MAPPING_INDENT
            rows = [f"{deeper}{each}: {_inline(one)}" for each, one in value.items()]
            lines = [f"{indent}{name}:", *rows]
        eol = "\r\n" if "\r\n" in self.text else "\n"
        # an alias has the marks of what it stands for
        at = key.end_mark.index if id(last) in shared else _end(last)
        if self.text[at - 1] in "\r\n":  # behind a block of text
            return [_Change(at, at, "".join(line + eol for line in lines))]
        ends = [k for k in (self.text.find(mark, at) for mark in "\r\n") if k >= 0]
        end = min(ends, default=len(self.text))
        return [_Change(end, end, "".join(eol + line for line in lines))]

    def _child(self, node: yaml.Node, key: str) -> yaml.Node | None:
        """A mapping's value under a key of its own, not a merged one."""
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        return next((child for name, child in pairs if name.value == key), None)

    def refused(self, keys: tuple[str, ...], why: str) -> InputError:
        """The error for an entry that cannot be changed by itself."""
        return InputError(
            f"this cannot be written without changing something else: {why}",
            where=self.document.where(*keys),
            next_step="Write it out by itself, as docs/files.md shows it",
            code="file.not_editable",
        )


def _parts(node: yaml.Node) -> list[yaml.Node]:
    """A node and all nodes below it, each as often as it is reached."""
    if isinstance(node, yaml.MappingNode):
        below = [part for pair in node.value for part in pair]
    else:
        below = node.value if isinstance(node, yaml.SequenceNode) else []
    return [node, *(part for child in below for part in _parts(child))]


def _shared(root: yaml.Node) -> set[int]:
    """Ids of the nodes that an alias repeats, without the nodes inside them."""
    names_so_far: set[int] = set()
    twice: set[int] = set()
    todo = [root]
    while todo:
        node = todo.pop()
        if id(node) in names_so_far:
            twice.add(id(node))
            continue
        names_so_far.add(id(node))
        if isinstance(node, yaml.MappingNode):
            todo += [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            todo += node.value
    return twice


def _span(node: yaml.Node) -> tuple[int, int]:
    return node.start_mark.index, node.end_mark.index


def _end(node: yaml.Node) -> int:
    """End of a value's last character; the end mark of a block is behind its comments."""
    block = isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value
    if not block:
        return node.end_mark.index
    last = node.value[-1]
    return _end(last[1] if isinstance(node, yaml.MappingNode) else last)


def _number(value: float) -> str:
    return repr(float(value) + 0.0)  # never -0.0


def _row(values: Sequence[float]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _flow(entry: Mapping[str, _Entry]) -> str:
    return "{" + ", ".join(f"{name}: {_inline(one)}" for name, one in entry.items()) + "}"


def _inline(value: _Entry) -> str:
    return _flow(value) if isinstance(value, Mapping) else _row(value)
