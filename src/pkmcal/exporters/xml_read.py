"""XML of multibody models, which other people's files may be: without entities, with messages."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import quoted

MOST_ELEMENTS, MOST_LEVELS = 20_000, 100
"""Most elements of a file, and most elements inside each other: a robot has a few hundred, and some
twenty."""
MOST_PARTS, PART_TAGS = 600, frozenset({"body", "link", "joint", "connect", "weld"})
"""Most bodies and joints of a machine, and the elements that are one."""
LARGEST_MODEL_FILE = 2**22
"""Largest file of a model, bytes."""
LARGEST_NUMBER = 1e30
"""Largest number of a model but limits, in any unit; squares of larger ones overflow."""
LARGEST_LIMIT = 1e3
"""Joint limit, m or rad, above which it stands for none: no machine slides by a kilometre or turns
a joint by 160 revolutions, and formats write 1e16 or the largest double."""


def xml_root(text: str) -> Element:
    """Root element. Raises InputError for text that is no XML, has entities, or is too large."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            "an XML file with a document type is not read, since its entities may expand without"
            " bounds",
            found="<!DOCTYPE" if "<!DOCTYPE" in text else "<!ENTITY",
            expected="elements alone",
        )
    try:
        root = fromstring(text)
    except (ParseError, ValueError) as error:
        template = "<%" in text
        raise InputError(
            "the file is not XML",
            found="a template with <% … %>" if template else str(error),
            expected="the XML that it expands to" if template else None,
            next_step="Expand it first: erb FILE.erb > FILE" if template else None,
        ) from None
    check_size(root)
    return root


def check_size(root: Element) -> None:
    """Raise InputError for a tree that is too large for a machine."""
    elements, level, layer = 0, 0, [root]
    while layer:
        elements, level = elements + len(layer), level + 1
        if elements > MOST_ELEMENTS or level > MOST_LEVELS:
            raise InputError(
                "the file has too many elements for a machine",
                found=f"{elements} elements, {level} levels",
                expected=f"at most {MOST_ELEMENTS} elements and {MOST_LEVELS} levels",
            )
        layer = [child for node in layer for child in node]
    parts = sum(node.tag in PART_TAGS for node in root.iter())
    if parts > MOST_PARTS:
        raise InputError(
            "the file has too many bodies and joints for a machine",
            found=parts,
            expected=f"at most {MOST_PARTS}",
        )


def label_of(node: Element) -> str:
    """Element with its name, for messages."""
    name = node.get("name")
    return f"<{node.tag}>" if name is None else f'<{node.tag} name="{name}">'


def refused(node: Element, what: str, found: object = None, expected: object = None) -> InputError:
    """Error about an element that cannot be represented."""
    return InputError(what, where=label_of(node), found=found, expected=expected)


def attribute(node: Element, key: str) -> str:
    """Attribute that an element must have."""
    if key not in node.attrib:
        raise refused(node, f"the element has no {key}", expected=f'{key}="…"')
    return node.attrib[key]


def by_name(nodes: Iterable[Element]) -> dict[str, Element]:
    """Elements by their names. Raises InputError for one without a name, and for two of one."""
    out: dict[str, Element] = {}
    for node in nodes:
        if attribute(node, "name") in out:
            raise refused(node, "two elements have one name", node.attrib["name"])
        out[node.attrib["name"]] = node
    return out


def numbers(
    node: Element,
    text: str,
    counts: tuple[int, ...],
    what: str,
    largest: float = LARGEST_NUMBER,
) -> Array:
    """Finite numbers of a text, as many as one of ``counts``; ``what`` is its name in messages."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.size not in counts or not np.all(np.abs(values) <= largest):
        raise refused(
            node,
            f"{what} is not as many numbers as it takes",
            quoted(text),
            " or ".join(map(str, counts)),
        )
    return values


def vector(node: Element, key: str, default: str, *counts: int) -> Array:
    """Numbers of an attribute; three unless ``counts`` are given."""
    return numbers(node, node.get(key, default), counts or (3,), key)


def unit_axis(node: Element, axis: Array) -> Array:
    """Direction (3,) of length one."""
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise refused(node, "an axis of length zero is no direction", axis.tolist())
    # keep written unit axes to the last digit
    return axis if abs(length - 1) < 1e-12 else axis / length


def limits_of(node: Element, low: str | None, high: str | None) -> Array:
    """Limits (2,) of a joint; infinite ones, such as 1e16, are NaN."""
    texts = (low, high)
    values = np.array([
        numbers(node, text, (1,), "limit", np.finfo(float).max)[0] if text else np.nan
        for text in texts
    ])  # fmt: skip
    return np.where(np.abs(values) < LARGEST_LIMIT, values, np.nan)
