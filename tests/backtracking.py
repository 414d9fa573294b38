"""Ambiguity of regular expressions: whether a backtracking search through one takes linear time.

A backtracking engine tries every path of the pattern's automaton over the text until one is
accepted. The number of paths grows exponentially where a state has two different cycles over one
word (EDA), and as a polynomial where one word leads around a state p, from p to another state q and
around q (IDA); else it is bounded by a constant. Both are decided on products of the automaton with
itself (Weber and Seidl, On the degree of ambiguity of finite automata, 1991).

Bounds taken here err on the safe side: look-around and \\b are ignored, a repeat of more than
LARGEST_COUNTED times is one without end.
"""

from __future__ import annotations

import re
from collections import defaultdict
from re import _constants as op
from re import _parser as parser

LARGEST_COUNTED = 30
COPIES = 3
"""Copies of a counted repeat's body in the automaton; more copies have the same cycles."""
SAMPLES = [chr(code) for code in range(128)] + list("éß٣½\u00a0\u2028€")


class Automaton:
    """Thompson's, of a pattern as a method of `re` uses it: match, fullmatch, or one that searches.

    A state from which success is certain whatever follows is none from which the search comes back.
    """

    def __init__(self, pattern: str | bytes, flags: int, method: str) -> None:
        tree = parser.parse(pattern, flags)
        self.flags = tree.state.flags
        self.empty: list[list[int]] = []
        self.signs: list[list[tuple[frozenset[str], int]]] = []
        self.anchors = set()
        start, self.end = self._sequence(list(tree))
        if method == "fullmatch":
            self._anchored(self.end)
        self.start = start
        if method not in ("match", "fullmatch"):
            self._searched(start, tree)

    def _state(self) -> int:
        self.empty.append([])
        self.signs.append([])
        return len(self.empty) - 1

    def _anchored(self, state: int) -> None:
        """An end that needs the text's end."""
        self.end = self._state()
        self.empty[state].append(self.end)
        self.anchors.add(state)

    def _searched(self, start: int, tree) -> None:
        """Any signs before; at the beginning of a line, those of the lines before."""
        first = tree[0] if len(tree) else None
        line = first is not None and first == (op.AT, op.AT_BEGINNING)
        if line and not self.flags & re.MULTILINE:
            return
        self.start = self._state()
        self.signs[self.start].append((self._set([(op.NEGATE, None)]), self.start))
        if line:
            self.signs[self.start].append((self._set([(op.LITERAL, ord("\n"))]), start))
            return  # the text's own beginning adds no cycle
        self.empty[self.start].append(start)

    def _set(self, items) -> frozenset[str]:
        negated = bool(items) and items[0][0] is op.NEGATE
        inside = {c for c in SAMPLES if any(self._holds(c, *item) for item in items)}
        return frozenset(set(SAMPLES) - inside if negated else inside)

    def _holds(self, sign: str, kind, value) -> bool:
        both = {sign, sign.lower(), sign.upper()} if self.flags & re.IGNORECASE else {sign}
        if kind is op.LITERAL:
            return any(len(c) == 1 and ord(c) == value for c in both)
        if kind is op.RANGE:
            return any(len(c) == 1 and value[0] <= ord(c) <= value[1] for c in both)
        if kind is op.CATEGORY:
            text, wide = str(value).rpartition("_")[2], not self.flags & re.ASCII
            name = {"DIGIT": r"\d", "SPACE": r"\s", "WORD": r"\w"}[text]
            match = re.match(name, sign, 0 if wide else re.ASCII)
            return bool(match) != ("NOT" in str(value))
        return False

    def _sequence(self, items) -> tuple[int, int]:
        first = last = self._state()
        for kind, value in items:
            begin, end = self._part(kind, value)
            self.empty[last].append(begin)
            last = end
        return first, last

    def _part(self, kind, value) -> tuple[int, int]:
        if kind in (op.MAX_REPEAT, op.MIN_REPEAT, op.POSSESSIVE_REPEAT):
            return self._repeat(*value)
        if kind is op.SUBPATTERN:
            return self._sequence(list(value[-1]))
        if kind is op.BRANCH:
            begin, end = self._state(), self._state()
            for one in value[1]:
                first, last = self._sequence(list(one))
                self.empty[begin].append(first)
                self.empty[last].append(end)
            return begin, end
        begin, end = self._state(), self._state()
        if kind in (op.ASSERT, op.ASSERT_NOT, op.AT):
            self.empty[begin].append(end)
            if kind is op.ASSERT or value in (op.AT_END, op.AT_END_STRING):
                self.anchors.add(begin)
            return begin, end
        if kind is op.ANY:
            items = [] if self.flags & re.DOTALL else [(op.LITERAL, ord("\n"))]
            items = [(op.NEGATE, None), *items]
        elif kind is op.NOT_LITERAL:
            items = [(op.NEGATE, None), (op.LITERAL, value)]
        elif kind is op.LITERAL:
            items = [(op.LITERAL, value)]
        elif kind is op.IN:
            items = value
        else:
            raise NotImplementedError(f"{kind} of a regular expression")
        self.signs[begin].append((self._set(items), end))
        return begin, end

    def _repeat(self, low, high, body) -> tuple[int, int]:
        endless = high is op.MAXREPEAT or high > LARGEST_COUNTED
        first = last = self._state()
        for _ in range(min(low, COPIES)):
            begin, end = self._sequence(list(body))
            self.empty[last].append(begin)
            last = end
        final = self._state()
        if endless:
            begin, end = self._sequence(list(body))
            turn = self._state()
            self.empty[last].append(turn)
            self.empty[turn] += [begin, final]
            self.empty[end].append(turn)
            return first, final
        for _ in range(min(high - low, COPIES)):
            self.empty[last].append(final)
            begin, end = self._sequence(list(body))
            self.empty[last].append(begin)
            last = end
        self.empty[last].append(final)
        return first, final

    def steps(self) -> dict[int, list[tuple[int, int]]]:
        """Steps over one sign between states that have such: (signs, state), as often as there are
        ways without a sign from the step's end to that state. None into certain success.

        Signs are bits, one for all signs that the pattern does not distinguish.
        """
        spelling = [s for s, steps in enumerate(self.signs) if steps]
        sets = list({signs for steps in self.signs for signs, _ in steps})
        kinds = list({tuple(sign in signs for signs in sets) for sign in SAMPLES})
        masks = {
            signs: sum(1 << n for n, kind in enumerate(kinds) if kind[k])
            for k, signs in enumerate(sets)
        }
        certain = {s for s in range(len(self.empty)) if self._succeeds(s)}
        out = {}
        for state in spelling:
            out[state] = [
                (masks[signs], after)
                for signs, end in self.signs[state]
                if end not in certain
                for after in self._spelling(end, ())
            ]
        return out

    def _succeeds(self, state: int) -> bool:
        todo, met = [state], set()
        while todo:
            s = todo.pop()
            if s in met:
                continue
            met.add(s)
            if s == self.end:
                return True
            if s not in self.anchors:
                todo += self.empty[s]
        return False

    def _spelling(self, state: int, sense) -> list[int]:
        """States with signs, once for each path there that uses no arrow twice."""
        out = [state] if self.signs[state] else []
        for after in self.empty[state]:
            if (state, after) not in sense:
                out += self._spelling(after, (*sense, (state, after)))
        return out


def ambiguity(pattern: str | bytes, flags: int, method: str) -> str | None:
    """ "exponential", "polynomial", or None where the search takes linear time."""
    steps = Automaton(pattern, flags, method).steps()
    graph = {s: {after for signs, after in each if signs} for s, each in steps.items()}
    part = _components(graph)
    for s, each in steps.items():
        inside = [(signs, after) for signs, after in each if signs and part[after] == part[s]]
        for k, (signs, after) in enumerate(inside):
            if any(signs & other and after == there for other, there in inside[:k]):
                return "exponential"
    cyclic = [
        s for s in graph if any(part[t] == part[s] and s in _reach(graph, t) for t in graph[s])
    ]
    if any(_twice_around(steps, part, s) for s in cyclic):
        return "exponential"
    for p in cyclic:
        for q in cyclic:
            if p != q and _leads(steps, part, p, q):
                return "polynomial"
    return None


def _reach(graph, start):
    todo, met = [start], set()
    while todo:
        s = todo.pop()
        if s not in met:
            met.add(s)
            todo += graph.get(s, ())
    return met


def _components(graph) -> dict[int, frozenset]:
    reach = {s: _reach(graph, s) for s in graph}
    return {s: frozenset({t for t in reach[s] if s in reach[t]} | {s}) for s in graph}


def _twice_around(steps, part, s) -> bool:
    """Two different ways from s to s over one word, within its component."""
    todo, met = [(s, s)], set()
    forward = defaultdict(set)
    while todo:
        pair = todo.pop()
        if pair in met:
            continue
        met.add(pair)
        for a, remainder in steps[pair[0]]:
            for b, right in steps[pair[1]]:
                if a & b and part[remainder] == part[s] == part[right]:
                    forward[pair].add((remainder, right))
                    todo.append((remainder, right))
    return any(a != b and (s, s) in _reach(forward, (a, b)) for a, b in met)


def _leads(steps, part, p, q) -> bool:
    """A word that leads from p to p, from p to q and from q to q."""
    todo, met = [(p, p, q)], set()
    while todo:
        place = todo.pop()
        if place in met:
            continue
        met.add(place)
        for a, first in steps[place[0]]:
            if part[first] != part[p]:
                continue
            for c, third in steps[place[2]]:
                both = a & c
                if not both or part[third] != part[q]:
                    continue
                todo += [(first, second, third) for b, second in steps[place[1]] if both & b]
        if (p, q, q) in met:
            return True
    return (p, q, q) in met
