"""Models of bodies in XML spoilt as trees of elements, and as documents that do harm."""

from __future__ import annotations

from copy import deepcopy
from random import Random
from xml.etree import ElementTree

from fuzz.trees import NUMBERS, TEXTS

SUFFIXES = (".xml", ".sdf", ".urdf")
FILES = ("../joints.csv", "/etc/passwd", "/dev/zero", ".", "", "robot.xml", "part.xml", "x" * 300,
         "part.xml/../../a", "http://example.org/a.xml", "\\\\host\\a", "\u202e")  # fmt: skip
BOMB = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 20}">' for k in range(1, 9))
DOCUMENTS = (
    f'<!DOCTYPE m [<!ENTITY e0 "a">{BOMB}]><mujoco>&e8;</mujoco>',
    '<!DOCTYPE m SYSTEM "file:///etc/passwd"><mujoco/>',
    '<?xml version="1.0" encoding="utf-16"?><mujoco/>',
    '<?xml version="1.1"?><mujoco/>',
    "<mujoco>" + "<body>" * 100_000,
    "<mujoco>" + "<frame>" * 90 + "</frame>" * 90 + "</mujoco>",
    f'<mujoco a="{"x" * 1_000_000}"/>',
    "<mujoco " + " ".join(f'a{k}=""' for k in range(30_000)) + "/>",
    '<a:mujoco xmlns:a="urn:x"/>',
    "<mujoco><![CDATA[<body/>]]></mujoco>",
    "<mujoco/><mujoco/>",
)


def spoil_xml(text: str, rng: Random) -> tuple[str, str]:
    """(kind, the file's text as it is then)."""
    kind = rng.choice(KINDS)
    if kind == "document":
        return kind, rng.choice(DOCUMENTS)
    root = ElementTree.fromstring(text)
    KINDS_OF_TREES[kind](root, rng)
    return kind, ElementTree.tostring(root, encoding="unicode")


def _element(root, rng):
    return rng.choice(list(root.iter()))


def _parent(root, rng):
    parents = [node for node in root.iter() if len(node)]
    return rng.choice(parents) if parents else root


def _value(root, rng):
    """Another number or word in an attribute, or in one of its numbers."""
    node = rng.choice([one for one in root.iter() if one.attrib] or [root])
    if node.attrib:
        key = rng.choice(list(node.attrib))
        words = node.attrib[key].split() or [""]
        words[rng.randrange(len(words))] = str(rng.choice((*NUMBERS, *TEXTS, "nan", "1e999")))
        node.set(key, _storable(" ".join(words)))


def _text(root, rng):
    _element(root, rng).text = _storable(str(rng.choice((*NUMBERS, *TEXTS))))


def _storable(text):
    """Text without characters that no XML can hold."""
    return "".join(c for c in text if c in "\t\n\r" or (c >= " " and not "\ud800" <= c <= "\udfff"))


def _lost(root, rng):
    node = _parent(root, rng)
    if len(node):
        del node[rng.randrange(len(node))]


def _twice(root, rng):
    node = _parent(root, rng)
    if len(node):
        node.append(deepcopy(rng.choice(list(node))))


def _moved(root, rng):
    node = _parent(root, rng)
    if len(node):
        child = rng.choice(list(node))
        node.remove(child)
        _element(root, rng).append(child)


def _renamed(root, rng):
    _element(root, rng).tag = rng.choice(["body", "joint", "frame", "a", "include", "replicate"])


def _name(root, rng):
    """The name of another element in its place."""
    named = [node for node in root.iter() if "name" in node.attrib]
    if named:
        rng.choice(named).set("name", rng.choice(named).attrib["name"])


def _attribute_lost(root, rng):
    node = rng.choice([one for one in root.iter() if one.attrib] or [root])
    if node.attrib:
        del node.attrib[rng.choice(list(node.attrib))]


def _included(root, rng):
    child = ElementTree.SubElement(_element(root, rng), "include")
    child.set("file", rng.choice(FILES))


def _copied(root, rng):
    """Everything in an element in many copies."""
    node = _parent(root, rng)
    children = list(node)
    for child in children:
        node.remove(child)
    count = rng.choice(["0", "1", "2", "600", "1e9", "-1", "2.5", "nan", ""])
    copies = ElementTree.SubElement(node, "replicate", count=count, euler="0 0 1e308")
    copies.extend(children)


def _deep(root, rng):
    node = _parent(root, rng)
    children = list(node)
    for child in children:
        node.remove(child)
    for _ in range(rng.choice([3, 80, 300])):
        node = ElementTree.SubElement(node, rng.choice(["body", "frame", "default", "link"]))
    node.extend(children)


KINDS_OF_TREES = {
    "value": _value, "text": _text, "lost": _lost, "element twice": _twice, "moved": _moved,
    "tag": _renamed, "name": _name, "attribute lost": _attribute_lost, "included": _included,
    "copies": _copied, "deep": _deep,
}  # fmt: skip
KINDS = ("value", "value", "value", *KINDS_OF_TREES, "document")
