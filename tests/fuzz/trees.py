"""YAML and JSON as trees that can be spoilt: keys that stand twice, and values written as they are.

A tree is a `Pairs` (a mapping, whose keys may repeat), a list, a plain value, or `Raw` text.
"""

from __future__ import annotations

import json
import string
from copy import deepcopy
from dataclasses import dataclass
from random import Random

import yaml


class Raw(str):
    """Text that is written as it stands."""

    __slots__ = ()


class Pairs(list):
    """A mapping: [key, value] lists in the file's order."""


def tree_of(data):
    if isinstance(data, dict):
        return Pairs([key, tree_of(value)] for key, value in data.items())
    return [tree_of(item) for item in data] if isinstance(data, list) else data


def read_tree(path):
    text = path.read_text()
    return tree_of(json.loads(text) if path.suffix == ".json" else yaml.safe_load(text))


def written(tree, suffix):
    """Text of a tree; a YAML file's top levels stand on lines of their own, as people write."""
    if suffix == ".json":
        return _flow(tree, json_keys=True) + "\n"
    if not isinstance(tree, Pairs) or not tree:
        return _flow(tree) + "\n"
    return "".join(f"{line}\n" for line in _block(tree, 0))


def _block(tree, level):
    for key, value in tree:
        blank = "  " * level
        if level < 2 and isinstance(value, Pairs) and value:
            yield f"{blank}{_key(key)}:"
            yield from _block(value, level + 1)
        else:
            yield f"{blank}{_key(key)}: {_flow(value)}"


def _flow(value, json_keys=False):
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, Pairs):
        named = json.dumps if json_keys else _key
        parts = (
            f"{key if isinstance(key, Raw) else named(key)}: {_flow(item, json_keys)}"
            for key, item in value
        )
        return "{" + ", ".join(parts) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_flow(item, json_keys) for item in value) + "]"
    return json.dumps(value)


def _key(key):
    return key if isinstance(key, Raw) or str(key).isidentifier() else json.dumps(key)


NUMBERS = (
    "nan", ".nan", "NaN", ".inf", "-.inf", "Infinity", "1e999", "-1e999", "1e308", "1e-320", "0",
    "-0.0", "-1", "1e6", "-1e-6", "0x1F", "0o17", "010", "1_000", "1,5", "'1.5'", '"0.2693"',
    "12:30", "٣.٥", "１２", "½", "1e", "1.2.3", "--1", "+", ".", "1 000", "1e5.5", "9" * 400,
    "0." + "0" * 400 + "1", "1" * 5000, "true", "null", "~", "1e400000000", "2147483648",
    "9223372036854775808", "-9223372036854775809", "1+2j", "5 mm", "3px", "1/2", "1e-5m", "²",
    "30 deg", "0.1 %", "-3 km", "1e15 km", "1e-300 nm", "5 kg", "5 dB", "5 °", "5 mm mm", "mm",
)  # fmt: skip
"""Written in the place of a number."""
TEXTS = (
    "", " ", "\t", "a\nb", "a\u0000b", "\ud800", "../session.yaml", "/etc/passwd", "/dev/zero",
    "..", ".", "/", "~", "C:\\x", "n" * 300, "n" * 5000, "ü/ß", "名前", "\u202eabc", "%s%n{0}",
    "{}",
    "{configuration", "{configuration}{configuration}", "{configuration!r}", "{configuration:9999}",
    "{repeat}", "*", "[a-", "**/*", "a{configuration}\n.png", "exif", "legs", "platform", "[bold]x",
    "[/]", "\x1b[31mred", "<script>alert(1)</script>", "None", "nan", "-", "--help", "images",
    "cameras", "joints.csv", "session.yaml", "\u0085", "\u2028", "e\u0301", "\ufeff", "'", '"', "#",
    "legs[1].base.center.z", "legs[0]", "legs[999].x", "legs[*].base.center",
    "-legs[1].base.center", "gough-stewart", "gough-stewrat", "h4", "file:///etc/passwd", "CON",
    "http://localhost/x.yaml", "a\u200bb", "a\u009b2Jb", "a\u2066b", "a\nM502", "a */ b --> c",
    "a\r\n# b",
)  # fmt: skip
"""Written in the place of a text."""
DEEP = 60
NODES = (
    "[" * DEEP + "]" * DEEP,
    "[" * 5000,
    "{a: " * DEEP + "1" + "}" * DEEP,
    "!!python/object:os.system {}",
    "!!binary aGFsbG8=",
    "!!set {a, b}",
    "!!timestamp 2001-01-01",
    "!!omap [a: 1]",
    "!!float 'x'",
    "!!int '٣'",
    "!mine 3",
    "&a [*a]",
    "*nobody",
    "{<<: 3}",
    "{<<: [1, 2]}",
    "{<<: {focal: 3}, <<: {focal: 4}}",
    "{? [a, b] : 1}",
    "{? {a: 1} : 1}",
    "{[]: 1}",
    "&x {y: &y [*x]}",
    "[&a {b: 1}, {<<: *a, <<: *a}]",
    "| \n  block",
    "@x",
    "`x`",
    "%TAG",
    "- x",
    "a: b: c",
    "[1, 2",
    "}",
    "'unclosed",
    '"\\x"',
    '"\\ud800"',
    "--- 1",
    "2001-01-01",
    "",
)
"""Written in the place of anything, in YAML."""
BOMB = "[&a0 [x, x], " + ", ".join(f"&a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12))
MERGES = "[&m0 {k: 1}, " + ", ".join(
    f"&m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}], k{k}: 1}}" for k in range(1, 12)
)


def spots(tree, above=()):
    """(holder, index, keys) of every value: holder[index] or holder[index][1] is it."""
    for k, item in enumerate(tree):
        key, value = item if isinstance(tree, Pairs) else (k, item)
        keys = (*above, key)
        yield tree, k, keys
        if isinstance(value, list):
            yield from spots(value, keys)


@dataclass
class Place:
    """A value in a tree, with the data needed to damage it.

    holder, at : it is holder[at] or, for a mapping, holder[at][1]. spots : all places as `spots`
    gives them. words : one of them is expected in a message.
    """

    tree: list
    holder: list
    at: int
    words: list[str]
    spots: list
    suffix: str

    @property
    def mapping(self):
        return isinstance(self.holder, Pairs)

    @property
    def value(self):
        return self.holder[self.at][1] if self.mapping else self.holder[self.at]

    def put(self, new):
        self.holder[self.at] = [self.holder[self.at][0], new] if self.mapping else new

    def name(self, new):
        self.words.append(str(new))
        self.holder[self.at] = [new, self.value]


def spoil_tree(tree, rng: Random, suffix):
    """Change one place of a tree; returns (its kind, words of which a message should hold one)."""
    value = list(spots(tree))
    if not value:
        return "nothing to spoil", ()
    # Tables of numbers fill a result file; every key is to have its turn.
    by_key = {}
    for spot in value:
        by_key.setdefault(tuple(k for k in spot[2] if not isinstance(k, int)), []).append(spot)
    holder, at, keys = rng.choice(by_key[rng.choice(sorted(by_key))])
    words = [str(key) for key in keys if not isinstance(key, int)]
    place = Place(tree, holder, at, words, value, suffix)
    kind = rng.choice([how for how in KINDS if _suits(how, place)])
    KINDS[kind](place, rng)
    return kind, tuple(place.words)


def _remove(place, rng):
    del place.holder[place.at]


def _double(place, rng):
    again = [place.holder[place.at][0], place.value]
    place.holder.insert(rng.randrange(len(place.holder) + 1), again)


def _rename(place, rng):
    place.name(misspelt(str(place.holder[place.at][0]), rng))


def _odd_key(place, rng):
    odd = [Raw("? [a]\n"), "", "__class__", "null", "1", "k" * 5000, "ü", "a b", "<<"]
    new = rng.choice(odd)
    place.name("x" if isinstance(new, Raw) and place.suffix == ".json" else new)


def _new_key(place, rng):
    new = [rng.choice(WORDS), rng.choice([1, "x", [], Pairs()])]
    place.holder.insert(place.at, new)
    place.words.append(new[0])


def _type(place, rng):
    others = [None, True, "text", 3, 1.5, [], Pairs(), [1, 2], Pairs([["a", 1]]), "", [[]]]
    place.put(rng.choice(others))


def _level(place, rng):
    mapping = place.mapping
    shifted = place.holder.pop(place.at)
    mappings = [spot[0] for spot in place.spots if isinstance(spot[0], Pairs)]
    other = rng.choice(mappings or [place.tree])
    if mapping and isinstance(other, Pairs):
        other.append(shifted)
    else:
        place.tree.append(["moved", shifted])


def _wrap(place, rng):
    value = place.value
    place.put(rng.choice([[value], [value, value], Pairs([["value", value]])]))


def _number(place, rng):
    raw = rng.choice(NUMBERS)
    place.put(Raw(_json_number(raw) if place.suffix == ".json" else raw))


def _scale(place, rng):
    factor = rng.choice([1e3, 1e-3, -1, 0, 1.5, 2, 1e9, 1e-9, 57.29577951308232, 0.999])
    value = place.value
    place.put(type(value)(value * factor) if abs(value) < 1e200 else 0)


def _off_by_one(place, rng):
    place.put(place.value + rng.choice([-1, 1]))


def _text(place, rng):
    place.put(rng.choice(TEXTS))


def _misspelt(place, rng):
    place.put(misspelt(place.value, rng))


def _shorter(place, rng):
    del place.value[rng.randrange(len(place.value)) :]


def _longer(place, rng):
    place.value.extend([place.value[-1]] * rng.choice([1, 2, 7, 1000]))


def _ragged(place, rng):
    place.value[rng.randrange(len(place.value))] = [place.value[0], 1]


def _exchange(place, rng):
    other, there, _ = rng.choice(place.spots)
    if not isinstance(other, Pairs):
        place.put(deepcopy(other[there]))
        return
    mine, its = deepcopy(place.value), deepcopy(other[there][1])  # one may hold the other
    place.put(its)
    other[there] = [other[there][0], mine]


def _node(place, rng):
    place.put(Raw(rng.choice([*NODES, BOMB + "]", MERGES + "]"])))


WORDS = (
    "pose", "camera", "tracker", "file", "noise", "board", "fixed_to", "workspace", "handheld",
    "xi", "paths", "legs", "tied", "fixed", "models", "home", "range", "axis",
    "tubes", "covariance",
    "x",
)  # fmt: skip
KINDS = {
    "remove": _remove,
    "double": _double,
    "rename": _rename,
    "odd key": _odd_key,
    "new key": _new_key,
    "type": _type,
    "level": _level,
    "wrap": _wrap,
    "number": _number,
    "scale": _scale,
    "off by one": _off_by_one,
    "text": _text,
    "misspelt": _misspelt,
    "shorter": _shorter,
    "longer": _longer,
    "ragged": _ragged,
    "exchange": _exchange,
    "node": _node,
}


def _suits(kind, place):
    value = place.value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_list = isinstance(value, list) and not isinstance(value, Pairs) and len(value) > 0
    return {
        "double": place.mapping,
        "rename": place.mapping,
        "odd key": place.mapping,
        "new key": place.mapping,
        "number": is_number,
        "scale": is_number,
        "off by one": is_number,
        "text": isinstance(value, str),
        "misspelt": isinstance(value, str) and value != "",
        "shorter": is_list,
        "longer": is_list,
        "ragged": is_list,
        "node": place.suffix != ".json",
    }.get(kind, True)


def _json_number(raw):
    """As JSON can hold it, so that the text stays whole."""
    allowed = ("NaN", "Infinity", "1e999", "-1e999", "1e308", "1e-320", "0", "-0.0", "-1", "1e6")
    return raw if raw in allowed or raw in ("true", "null") else json.dumps(raw)


def misspelt(word, rng):
    """The word with one letter lost, doubled, changed, exchanged or in capitals."""
    at = rng.randrange(max(len(word), 1))
    letter = rng.choice(string.ascii_lowercase)
    return rng.choice([
        word[:at] + word[at + 1 :],
        word[:at] + letter + word[at:],
        word[:at] + letter + word[at + 1 :],
        word[:at] + word[at : at + 2][::-1] + word[at + 2 :],
        word.upper(),
        word + " ",
    ])  # fmt: skip
