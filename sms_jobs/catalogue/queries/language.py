"""The language of `sms data find` and `states`: text in, a tree of conditions out, whatever names mean.

`docs/query.md` describes it for people. The grammar, with words in any case:

    query      = [ kind ] [ "where" any ]
    any        = all { "or" all }
    all        = condition { "and" condition }
    condition  = "not" condition | "(" any ")" | name test
    test       = ( "=" | "!=" | "<" | "<=" | ">" | ">=" | "~" ) value
               | [ "not" ] "in" ( time | "(" value { "," value } ")" )
               | [ "not" ] "between" value "and" value
    value      = number [ unit ] | time | text
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from math import isfinite
from typing import NoReturn, TypeAlias

from sms_jobs.errors import InvalidInput

LONGEST_TEXT = 4000
DEEPEST = 50
"""How many parentheses and negations may lie in each other."""
UNWRITTEN = -1
"""The place of what stands in no text, but was asked for by an option."""
A_COLUMN = -2
"""The place of a name that is no part of a query: what is to be shown."""


class Operator(Enum):
    """How a value is compared."""

    EQUAL = "="
    UNEQUAL = "!="
    LESS = "<"
    AT_MOST = "<="
    GREATER = ">"
    AT_LEAST = ">="
    CONTAINS = "~"


@dataclass(frozen=True)
class Name:
    """What is asked about, and where in the text it stands."""

    text: str
    at: int


@dataclass(frozen=True)
class Value:
    """What it is compared with: a number, a time or a text; `text` as it was written, without quotes.

    Of a month, `value` is its begin. A number may have a unit, as it was written.
    """

    value: float | datetime | str
    text: str
    at: int
    unit: str = ""


@dataclass(frozen=True)
class Comparison:
    """A name against a value."""

    name: Name
    operator: Operator
    value: Value


@dataclass(frozen=True)
class Membership:
    """A name that has one of some values."""

    name: Name
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Between:
    """A name whose value lies between two, which belong to the range."""

    name: Name
    low: Value
    high: Value


@dataclass(frozen=True)
class Not:
    """What does not meet a condition."""

    condition: Condition


@dataclass(frozen=True)
class AllOf:
    """What meets every condition."""

    conditions: tuple[Condition, ...]


@dataclass(frozen=True)
class AnyOf:
    """What meets at least one condition."""

    conditions: tuple[Condition, ...]


Test: TypeAlias = Comparison | Membership | Between
Condition: TypeAlias = Test | Not | AllOf | AnyOf


@dataclass(frozen=True)
class Query:
    """A kind of file, or all, and what its files have to meet."""

    text: str
    kind: Name | None
    condition: Condition | None


def refuse(text: str, at: int, why: str) -> NoReturn:
    """Raise `InvalidInput` that quotes the text around a place, and points at it."""
    if at == UNWRITTEN:
        raise InvalidInput(why)
    if at == A_COLUMN:
        raise InvalidInput(f"in `columns`, {why}")
    first, last = max(0, at - 40), at + 40
    before = ("..." if first else "") + text[first:at]
    after = text[at:last] + ("..." if last < len(text) else "")
    raise InvalidInput(f"{why}, at character {at + 1} of the query: {before}>>>{after or ' (its end)'}")


class _Token(Enum):
    TIME = r"\d{4}-\d{2}(?:-\d{2}(?:T\d{2}:\d{2}(?::\d{2}(?:\.\d+)?)?(?:Z|[+-]\d{2}:?\d{2})?)?)?(?![\w.-])"
    NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])"
    TEXT = r"'(?:[^']|'')*'|\"(?:[^\"]|\"\")*\""
    WORD = r"[^\W\d][\w-]*(?:\.\w[\w-]*)*"
    SIGN = r"!=|<=|>=|[=<>~(),]"
    SPACE = r"\s+"


YEAR = re.compile(r"[12]\d{3}")
"""A number that is a year where it is compared with a time."""
_TOKEN = re.compile("|".join(f"(?P<{t.name}>{t.value})" for t in _Token))
_KEYWORDS = frozenset({"where", "and", "or", "not", "in", "between"})


@dataclass(frozen=True)
class _Piece:
    token: _Token | None
    text: str
    at: int

    def is_word(self, *words: str) -> bool:
        return self.token is _Token.WORD and self.text.lower() in words


def _pieces(text: str) -> Iterator[_Piece]:
    at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            if text[at] in "'\"":
                refuse(text, at, "this quotation mark is not closed")
            if text[at].isdigit():
                refuse(
                    text,
                    at,
                    "this is neither a number nor a time; put a space before a unit, and other values in "
                    "quotation marks",
                )
            refuse(text, at, f"the character '{text[at]}' has no meaning here; put texts in quotation marks")
        token = _Token[str(found.lastgroup)]
        if token is not _Token.SPACE:
            yield _Piece(token, found.group(), at)
        at = found.end()
    yield _Piece(None, "", len(text))


class _Parser:
    def __init__(self, text: str) -> None:
        self.text = text
        self.pieces = list(_pieces(text))
        self.place = 0
        self.depth = 0

    @property
    def here(self) -> _Piece:
        return self.pieces[self.place]

    def step(self) -> _Piece:
        piece = self.here
        self.place += 1
        return piece

    def takes(self, *words: str) -> bool:
        """Step over one of some keywords if it is next."""
        found = self.here.is_word(*words)
        self.place += found
        return found

    def sign(self, sign: str) -> bool:
        found = self.here.token is _Token.SIGN and self.here.text == sign
        self.place += found
        return found

    def fail(self, why: str) -> NoReturn:
        refuse(self.text, self.here.at, why)

    def query(self) -> Query:
        kind = None
        after = self.pieces[min(self.place + 1, len(self.pieces) - 1)]
        if self._names_next() and (after.token is None or after.is_word("where")):
            piece = self.step()
            kind = Name(piece.text, piece.at)
        begun = self.takes("where")
        if self.here.token is None and not begun:
            return Query(self.text, kind, None)
        condition = self.any_of()
        if self.here.token is not None:
            self.fail("here 'and', 'or' or the end was expected")
        return Query(self.text, kind, condition)

    def any_of(self) -> Condition:
        found = [self.all_of()]
        while self.takes("or"):
            found.append(self.all_of())
        return found[0] if len(found) == 1 else AnyOf(tuple(found))

    def all_of(self) -> Condition:
        found = [self.condition()]
        while self.takes("and"):
            found.append(self.condition())
        return found[0] if len(found) == 1 else AllOf(tuple(found))

    def condition(self) -> Condition:
        self.depth += 1
        if self.depth > DEEPEST:
            self.fail(f"conditions lie more than {DEEPEST} deep in each other; write them side by side")
        if self.takes("not"):
            found: Condition = Not(self.condition())
        elif self.sign("("):
            found = self.any_of()
            if not self.sign(")"):
                self.fail("here a closing parenthesis, 'and' or 'or' was expected")
        else:
            found = self.test()
        self.depth -= 1
        return found

    def test(self) -> Condition:
        if not self._names_next():
            self.fail("here the name of something to ask about was expected")
        piece = self.step()
        name = Name(piece.text, piece.at)
        if self.takes("not"):
            if not self.here.is_word("in", "between"):
                self.fail("here 'in' or 'between' was expected")
            return Not(self.test_of(name))
        return self.test_of(name)

    def test_of(self, name: Name) -> Test:
        if self.takes("in"):
            return Membership(name, self.values())
        if self.takes("between"):
            low = self.value()
            if not self.takes("and"):
                self.fail("here 'and' and the upper end of the range were expected")
            return Between(name, low, self.value())
        operator = next((o for o in Operator if self.sign(o.value)), None)
        if operator is None:
            self.fail(f"after '{name.text}' one of = != < <= > >= ~ in between was expected")
        return Comparison(name, operator, self.value())

    def values(self) -> tuple[Value, ...]:
        if not self.sign("("):
            if self.here.token is not _Token.TIME and not YEAR.fullmatch(self.here.text):
                self.fail(
                    "after 'in' a list in parentheses was expected, like (S01, S02), or a time like 2026-05"
                )
            return (self.value(),)
        found = [self.value()]
        while self.sign(","):
            found.append(self.value())
        if not self.sign(")"):
            self.fail("here a comma or the closing parenthesis of the list was expected")
        return tuple(found)

    def value(self) -> Value:
        piece = self.here
        if piece.token is _Token.NUMBER:
            value: float | datetime | str = float(piece.text)
            if not isfinite(float(piece.text)):
                self.fail("this number is too large")
            self.step()
            return Value(value, piece.text, piece.at, self.unit())
        if piece.token is _Token.TIME:
            value = self._time(piece.text)
        elif piece.token is _Token.TEXT:
            mark = piece.text[0]
            text = piece.text[1:-1].replace(2 * mark, mark)
            self.step()
            return Value(text, text, piece.at)
        elif self._names_next():
            value = piece.text
        else:
            self.fail("here a number, a time or a text was expected")
        self.step()
        return Value(value, piece.text, piece.at)

    def unit(self) -> str:
        """Step over the unit of a number and return it, empty where none stands there."""
        after = self.pieces[min(self.place + 1, len(self.pieces) - 1)]
        ends = after.token is None or after.is_word("and", "or") or after.text in (",", ")")
        return self.step().text if self._names_next() and ends else ""

    def _names_next(self) -> bool:
        return self.here.token is _Token.WORD and self.here.text.lower() not in _KEYWORDS

    def _time(self, text: str) -> datetime:
        try:
            # Without a zone it is the time of the place where the question is asked.
            return datetime.fromisoformat(f"{text}-01" if len(text) == len("2026-05") else text).astimezone()
        except (ValueError, OverflowError):
            self.fail("this day or time does not exist")


def parse(text: str) -> Query:
    """Return the tree of a query.

    Raises
    ------
    InvalidInput
        It is not a query; the message points at the place.
    """
    if len(text) > LONGEST_TEXT:
        raise InvalidInput(f"the query has {len(text)} characters; {LONGEST_TEXT} are the most")
    if "\0" in text:
        refuse(text, text.index("\0"), "a query has no null characters")
    return _Parser(text).query()


def comparisons(condition: Condition | None) -> Iterator[Test]:
    """Yield every comparison of a condition, in the order of the text."""
    if isinstance(condition, Not):
        yield from comparisons(condition.condition)
    elif isinstance(condition, AllOf | AnyOf):
        for part in condition.conditions:
            yield from comparisons(part)
    elif condition is not None:
        yield condition


def values_of(test: Test) -> tuple[Value, ...]:
    """Return what a name is compared with."""
    if isinstance(test, Membership):
        return test.values
    return (test.low, test.high) if isinstance(test, Between) else (test.value,)


def conjuncts(condition: Condition | None) -> tuple[Condition, ...]:
    """Return the conditions of which every one has to be met."""
    if condition is None:
        return ()
    if isinstance(condition, AllOf):
        return tuple(part for one in condition.conditions for part in conjuncts(one))
    return (condition,)
