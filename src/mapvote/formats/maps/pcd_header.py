"""The header of a PCD file, read with the tolerance of PCL's own reader, and written.

PCL splits the lines at tabs and blanks, skips comments, ignores VERSION, takes letters of TYPE in both cases, and drops
a field with COUNT 0, which old drivers write between the fields of a point. Lines that older versions of the format
lack have defaults. A file that is no PCD is refused with its line, the cause and the mend.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO, Literal

import numpy as np

from mapvote.core.types import MapvoteError
from mapvote.formats.reading import FILE_LIMITS

Encoding = Literal["ascii", "binary", "binary_compressed"]
ENCODINGS: tuple[Encoding, ...] = ("ascii", "binary", "binary_compressed")
_KEYWORDS = (
    "VERSION",
    "FIELDS",
    "COLUMNS",
    "SIZE",
    "TYPE",
    "COUNT",
    "WIDTH",
    "HEIGHT",
    "VIEWPOINT",
    "POINTS",
    "DATA",
)
_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PcdField:
    """One entry of FIELDS."""

    name: str
    kind: np.dtype[np.generic]
    count: int

    @property
    def is_padding(self) -> bool:
        """Whether the field only fills space, as PCL names it: an underscore."""
        return self.name.startswith("_")


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """Content of the lines up to DATA."""

    fields: tuple[PcdField, ...]
    width: int
    height: int
    encoding: Encoding
    viewpoint: tuple[float, ...] = _IDENTITY
    """tx ty tz qw qx qy qz."""
    lines: int = 0
    """Lines of the file up to DATA."""

    @property
    def points(self) -> int:
        """Points that the header promises."""
        return self.width * self.height

    @property
    def is_organised(self) -> bool:
        """Whether the points are an image of HEIGHT rows, where a ray without return keeps its place."""
        return self.height > 1

    def layouts(self) -> list[np.dtype[np.void]]:
        """The layouts of a point that this header can mean, PCL's reading first: a field with COUNT 0 takes no bytes.
        Old converters wrote COUNT 0 for one element. binary_compressed data hold no padding if PCL wrote them."""
        readings = [[field for field in self.fields if field.count > 0]]
        if any(field.count == 0 for field in self.fields):
            readings.append([PcdField(f.name, f.kind, max(f.count, 1)) for f in self.fields])
        if self.encoding == "binary_compressed":
            readings += [[field for field in fields if not field.is_padding] for fields in readings]
        return [_layout(fields) for fields in readings]


def _layout(fields: Sequence[PcdField]) -> np.dtype[np.void]:
    """The structured type of one point; names that are there already become padding."""
    table: list[tuple[str, np.dtype[np.generic], tuple[int, ...]]] = []
    used: set[str] = set()
    for number, field in enumerate(fields):
        name = f"_{field.name}_{number}" if field.is_padding or field.name in used else field.name
        used.add(name)
        table.append((name, field.kind, () if field.count == 1 else (field.count,)))
    return np.dtype(table)


def read_header(source: str, stream: BinaryIO) -> PcdHeader:
    """The header of an opened PCD file; ``stream`` is left where the points begin.

    MapvoteError with line, cause and mend if it is none.
    """
    lines = _Lines(source)
    for words in lines.read(stream):
        if words[0].upper() == "DATA":
            break
    return lines.header()


class _Lines:
    """The lines of one header by keyword: (number, words after the keyword)."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.entries: dict[str, tuple[int, list[str]]] = {}
        self.number = 0

    def read(self, stream: BinaryIO) -> Iterator[list[str]]:
        """The words of each line that says something."""
        while raw := stream.readline(FILE_LIMITS.pcd_line_bytes):
            self.number += 1
            words = raw.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace").split()
            if not words or words[0].startswith("#"):
                continue
            keyword = words[0].upper()
            if keyword not in _KEYWORDS and "FIELDS" in self.entries and not (keyword.isascii() and keyword.isalpha()):
                return  # points already: the line DATA is missing
            if keyword not in _KEYWORDS:
                raise MapvoteError(
                    f"{self.where}:{self.number}: {words[0][:40]!r} is no line of a PCD header "
                    f"({', '.join(_KEYWORDS)}); is this a PCD file, and is its header whole?"
                )
            self.entries["FIELDS" if keyword == "COLUMNS" else keyword] = self.number, words[1:]
            yield words

    def header(self) -> PcdHeader:
        """All of it; MapvoteError for lines that are missing or contradict each other."""
        if "DATA" not in self.entries or "FIELDS" not in self.entries:
            missing = "FIELDS" if "FIELDS" not in self.entries else "DATA"
            raise MapvoteError(f"{self.where}: its PCD header has no line {missing}; export the file again")
        number, words = self.entries["DATA"]
        encoding = words[0].lower() if words else ""
        if encoding not in ENCODINGS:
            raise self._refused("DATA", f"{encoding!r} is no encoding", f"write {', '.join(ENCODINGS)}")
        width, height = self._shape()
        return PcdHeader(
            self._fields(),
            width,
            height,
            encoding,
            tuple(self._floats("VIEWPOINT", 7)) if "VIEWPOINT" in self.entries else _IDENTITY,
            number,
        )

    def _fields(self) -> tuple[PcdField, ...]:
        names = self.entries["FIELDS"][1]
        sizes = self._numbers("SIZE", len(names)) if "SIZE" in self.entries else [4] * len(names)
        counts = self._numbers("COUNT", len(names)) if "COUNT" in self.entries else [1] * len(names)
        letters = [letter[:1].upper() for letter in self._words("TYPE", len(names))]
        if not letters:
            letters = ["F" if size >= 4 else "U" for size in sizes]
        if any(count > FILE_LIMITS.pcd_elements for count in counts):
            raise self._refused("COUNT", f"{max(counts)} elements of one field", "is the header damaged?")
        kinds = [self._kind(letter, size) for letter, size in zip(letters, sizes, strict=True)]
        return tuple(PcdField(*one) for one in zip(names, kinds, counts, strict=True))

    def _kind(self, letter: str, size: int) -> np.dtype[np.generic]:
        codes = {"F": "f", "I": "i", "U": "u", "B": "u"}
        sizes = {"F": (2, 4, 8), "B": (1,)}.get(letter, (1, 2, 4, 8))
        if letter not in codes or size not in sizes:
            cause = f"no number has TYPE {letter} and SIZE {size}"
            raise self._refused("TYPE" if "TYPE" in self.entries else "SIZE", cause, "F has 4 or 8, I and U 1 to 8")
        return np.dtype(f"<{codes[letter]}{size}")

    def _shape(self) -> tuple[int, int]:
        """(WIDTH, HEIGHT), of older files from POINTS."""
        width, height, points = (
            self._numbers(name, 1)[0] if name in self.entries else None for name in ("WIDTH", "HEIGHT", "POINTS")
        )
        if width is None and points is None:
            raise MapvoteError(f"{self.where}: its PCD header has neither WIDTH nor POINTS; export the file again")
        height = 1 if height is None else height
        if width is None:
            width = (points or 0) // max(height, 1)
        if points is not None and width * height != points:
            raise self._refused(
                "POINTS", f"WIDTH {width} times HEIGHT {height} is not POINTS {points}", "correct the one that is wrong"
            )
        return width, height

    def _words(self, keyword: str, n: int) -> list[str]:
        """The words of a line that must have ``n``; none if there is no such line."""
        if keyword not in self.entries:
            return []
        words = self.entries[keyword][1]
        if len(words) != n:
            expected = f"one for each of the {n} FIELDS" if keyword in ("SIZE", "TYPE", "COUNT") else f"{n} needed"
            raise self._refused(keyword, f"{len(words)} values", expected)
        return words

    def _numbers(self, keyword: str, n: int) -> list[int]:
        values = [int(word) if word.isdecimal() else -1 for word in self._words(keyword, n)]
        if min(values, default=0) < 0:
            raise self._refused(keyword, f"{' '.join(self.entries[keyword][1])[:60]!r}", "whole numbers are needed")
        return values

    def _floats(self, keyword: str, n: int) -> list[float]:
        try:
            return [float(word) for word in self._words(keyword, n)]
        except ValueError:
            words = " ".join(self.entries[keyword][1])
            raise self._refused(keyword, f"{words[:60]!r}", f"{n} numbers are needed") from None

    def _refused(self, keyword: str, cause: str, mend: str) -> MapvoteError:
        return MapvoteError(f"{self.where}:{self.entries[keyword][0]}: {keyword} in a PCD header: {cause}; {mend}")


def compose_header(dtype: np.dtype[np.void], points: int) -> bytes:
    """The lines of an unorganised binary cloud of ``points`` of ``dtype``, as PCL 1.7 and later read them."""
    names = dtype.names or ()
    kinds = [dtype[name] for name in names]
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}",
        "DATA binary",
    )
    return "\n".join(lines).encode() + b"\n"
