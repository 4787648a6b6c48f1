"""The order, the numbers and the times that the names of scan files tell.

Names are read as a whole: text, and numbers that count. ``scan_10_hdl32`` follows ``scan_2_hdl32``, whatever the
padding. Digits after a dot are a decimal fraction (``899.05``), or nanoseconds that somebody wrote without padding
(``899.11149430``); hexadecimal counters are told by their letters.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import F64, I64, MapvoteError


@record()
@dataclass(frozen=True, slots=True)
class NameRule:
    """Numbers by which a number in a name is recognised as a time."""

    since_1970_s: float = 1e8
    """Least number that is a time since 1970, seconds: a day of 1973."""
    latest_s: float = 1e11
    """Numbers larger than this count milli-, micro- or nanoseconds, seconds."""
    fraction_digits: int = 9
    """Digits of nanoseconds, the most that a time is written to."""
    fastest_step_s: float = 0.005
    """Least step from scan to scan of a time that is not since 1970, seconds."""
    slowest_step_s: float = 5.0
    """Greatest median step of such a time, seconds."""


NAME_RULE = NameRule()


@dataclass(frozen=True, slots=True)
class _Number:
    """One number of a name."""

    sign: int
    whole: str
    fraction: str
    """Digits after the dot; "" without one."""

    def value(self, nanoseconds: bool) -> Fraction:
        """Its value, its fraction read as decimals or as nanoseconds without padding."""
        digits = self.fraction.rjust(NAME_RULE.fraction_digits, "0") if nanoseconds else self.fraction
        return self.sign * (int(self.whole) + (Fraction(int(digits), 10 ** len(digits)) if digits else Fraction(0)))


Token = str | _Number


def in_natural_order(files: Sequence[Path]) -> list[Path]:
    """The files by their whole names, numbers by value; equal ones by name."""
    counters = _hexadecimal(files)
    if counters is not None:
        return [file for _, _, file in sorted(zip(counters, [f.name for f in files], files, strict=True))]
    names = [_tokens(file) for file in files]
    nanoseconds = _counts_nanoseconds(names)
    keys = [[_key(token, nanoseconds) for token in name] for name in names]
    order = sorted(range(len(files)), key=lambda i: (keys[i], files[i].name))
    return [files[i] for i in order]


def numbers_of(files: Sequence[Path]) -> I64:
    """(n,) the whole number by which each name differs from all others, 12 of ``000012.bin``; the first such number of
    a name. (n,) of -1 if there is none."""
    counters = _hexadecimal(files)
    if counters is not None:
        return np.array(counters, dtype=np.int64)
    for column in _columns(files):
        values = [number.sign * int(number.whole) for number in column]
        whole = not any(number.fraction for number in column) and max(map(abs, values)) < 2**62
        if whole and len(set(values)) == len(files):
            return np.array(values, dtype=np.int64)
    return np.full(len(files), -1, dtype=np.int64)


def stamps_of_names_ns(files: Sequence[Path]) -> I64 | None:
    """(n,) times in the names of files, in their order; None if these hold none.

    A number since 1970 in any unit, ``1317042145.964``; whole seconds and a second number of their fraction,
    ``1599048323_10115000``; or seconds of any clock with decimals, ``899.11149430``. Exact to the nanosecond.
    """
    columns = _columns(files)
    if _are_dates(columns):
        return _dates_ns(columns)
    for i, column in enumerate(columns):
        largest = max(int(number.whole) for number in column)
        if largest < NAME_RULE.since_1970_s or any(number.sign < 0 for number in column):
            continue
        split = largest < NAME_RULE.latest_s and not any(number.fraction for number in column)
        if split and i + 1 < len(columns) and not any(number.fraction for number in columns[i + 1]):
            return _in_ns(column, 9) + _parts_ns(columns[i + 1])
        return _in_ns(column, _power(largest))
    varying = [column for column in columns if len(set(column)) > 1]
    if len(varying) == 1 and any(number.fraction for number in varying[0]):
        stamps_ns = _in_ns(varying[0], 9)
        return stamps_ns if _are_steps(np.abs(np.diff(stamps_ns)) * 1e-9) else None
    return None


def stamp_in_name_ns(file: Path) -> int:
    """A file named by its time since 1970, the last number of the name: seconds, or a whole number of milli-, micro- or
    nanoseconds. MapvoteError if there is no number in its name."""
    numbers = [token for token in _tokens(file) if isinstance(token, _Number)]
    if not numbers:
        raise MapvoteError(f"{file}: its name holds no time; a scan is named by its stamp")
    return round(numbers[-1].value(False) * 10 ** _power(int(numbers[-1].whole)))


def _power(largest: int) -> int:
    """Such that numbers up to ``largest`` count 10 ** -(9 - power) seconds since 1970."""
    return next((power for power in (9, 6, 3) if largest < 10 ** (20 - power)), 0)


def _are_steps(steps_s: F64) -> bool:
    """Whether scans of one sensor may come so far apart."""
    if not len(steps_s):
        return False
    return bool(steps_s.min() >= NAME_RULE.fastest_step_s and np.median(steps_s) <= NAME_RULE.slowest_step_s)


def _in_ns(column: Sequence[_Number], power: int) -> I64:
    """(n,) nanoseconds of numbers that count 10 ** power of them."""
    nanoseconds = _counts_nanoseconds([[number] for number in column])
    return np.array([round(number.value(nanoseconds) * 10**power) for number in column], dtype=np.int64)


def _parts_ns(column: Sequence[_Number]) -> I64:
    """(n,) nanoseconds of the number that follows whole seconds: padded to its decimals, else the unit by its size."""
    widths = {len(number.whole) for number in column}
    values = np.array([int(number.whole) for number in column], dtype=np.int64)
    if len(widths) == 1 and max(widths) <= NAME_RULE.fraction_digits:
        return np.asarray(values * 10 ** (NAME_RULE.fraction_digits - max(widths)))
    power = next((p for p in (6, 3) if values.max() < 10 ** (NAME_RULE.fraction_digits - p)), 0)
    return np.asarray(values * 10**power)


def _are_dates(columns: Sequence[Sequence[_Number]]) -> bool:
    """Whether names begin with year, month, day, hour, minute and second."""
    ranges = ((1990, 2100), (1, 12), (1, 31), (0, 23), (0, 59), (0, 59))
    return len(columns) >= len(ranges) and all(
        low <= int(number.whole) <= high and abs(number.sign) == 1
        for column, (low, high) in zip(columns, ranges, strict=False)
        for number in column
    )


def _dates_ns(columns: Sequence[Sequence[_Number]]) -> I64 | None:
    """(n,) nanoseconds since 1970 of names that begin with a date and a time, UTC; None where there is no such day."""
    fraction = _parts_ns(columns[6]) if len(columns) > 6 else np.zeros(len(columns[0]), dtype=np.int64)
    seconds = [_Number(1, "0", number.fraction) for number in columns[5]]
    out = _in_ns(seconds, 9) + fraction
    for i, row in enumerate(zip(*columns[:6], strict=True)):
        try:
            moment = datetime(*(int(number.whole) for number in row), tzinfo=UTC)  # type: ignore[arg-type, misc]
        except ValueError:
            return None
        out[i] += int(moment.timestamp()) * 10**9
    return out


def _tokens(file: Path) -> list[Token]:
    """Text and numbers of a name without its suffix, in turn. Three or more numbers with dots between them count one by
    one, as in a date or a version."""
    tokens: list[Token] = []
    # A number with its decimals, or one letter. A minus is a sign at the start of a name and after _, = or a blank.
    for match in re.findall(r"(?:(?:^|(?<=[_=\s]))-)?\d+(?:\.\d+)*|\D", file.stem.lower()):
        if not match[-1].isdigit():
            if tokens and isinstance(tokens[-1], str):
                tokens[-1] += match
            else:
                tokens.append(match)
            continue
        sign = -1 if match.startswith("-") else 1
        parts = match.lstrip("-").split(".")
        if len(parts) <= 2:
            tokens.append(_Number(sign, parts[0], parts[1] if len(parts) == 2 else ""))
            continue
        for k, part in enumerate(parts):
            tokens += ["."] if k else []
            tokens.append(_Number(sign if k == 0 else 1, part, ""))
    return tokens


def _key(token: Token, nanoseconds: bool) -> tuple[int, Fraction, str]:
    """Numbers come before text, as digits come before letters."""
    return (1, Fraction(0), token) if isinstance(token, str) else (0, token.value(nanoseconds), "")


def _columns(files: Sequence[Path]) -> list[list[_Number]]:
    """The numbers of the names, the first of each, the second, ..; none if the names differ in their text."""
    names = [_tokens(file) for file in files]
    texts = {tuple(token if isinstance(token, str) else None for token in name) for name in names}
    if len(texts) != 1:
        return []
    rows = [[token for token in name if isinstance(token, _Number)] for name in names]
    return [list(column) for column in zip(*rows, strict=True)]


def _counts_nanoseconds(names: Sequence[Sequence[Token]]) -> bool:
    """Whether the digits after a dot are nanoseconds without padding rather than decimals.

    If all have one length, both readings give the same order. A leading zero is padding, so the digits are decimals.
    Else the reading under which the scans come more evenly is right.
    """
    numbers = [[token for token in name if isinstance(token, _Number) and token.fraction] for name in names]
    first = [row[0] for row in numbers if row]
    if len({len(number.fraction) for number in first}) < 2:
        return False
    padded = any(number.fraction[0] == "0" and len(number.fraction) > 1 for number in first)
    if padded or max(len(number.fraction) for number in first) > NAME_RULE.fraction_digits:
        return False
    unevenness = []
    for nanoseconds in (False, True):
        times = np.sort(np.array([float(number.value(nanoseconds) - int(first[0].whole)) for number in first]))
        steps = np.diff(times)
        unevenness.append(float(steps.std() / max(steps.mean(), 1e-12)) if len(steps) else 0.0)
    return unevenness[1] < unevenness[0]


def _hexadecimal(files: Sequence[Path]) -> list[int] | None:
    """Counters in base 16, where the names differ in one alphanumeric piece of hexadecimal digits and letters occur in
    some; None otherwise."""
    rows = [re.split(r"[^0-9a-z]+", file.stem.lower()) for file in files]
    if len({len(row) for row in rows}) != 1:
        return None
    varying = [column for column in zip(*rows, strict=True) if len(set(column)) > 1]
    if len(varying) != 1 or not all(re.fullmatch(r"(?:0x)?[0-9a-f]+", piece) for piece in varying[0]):
        return None
    digits = [piece.removeprefix("0x") for piece in varying[0]]
    letters = any(re.search("[a-f]", one) for one in digits)
    counts = any(one[0].isdigit() for one in digits) or len({len(one) for one in digits}) == 1
    short = max(map(len, digits)) < 16  # longer ones are digests
    return [int(one, 16) for one in digits] if letters and counts and short else None
