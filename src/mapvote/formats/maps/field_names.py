"""How programs spell the fields of a point, and which of them a map keeps.

PCL writes ``intensity``, PDAL ``Intensity`` or ``gpstime``, CloudCompare ``scalar_Intensity`` and ``scalar_GpsTime``,
Open3D ``red``, MeshLab ``diffuse_red``. Letters' case, underscores and blanks make no difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from mapvote.core.points import point_fields

KEPT = (
    "intensity",
    "red",
    "green",
    "blue",
    "classification",
    "gps_time",
    "return_number",
    "number_of_returns",
    "las_flags",
)
"""Fields of points that a map keeps, by LAS's names; :func:`kept_fields` has the attributes of other distributions too.
``las_flags`` holds the bits of ``laz_subprocess.FLAGS``."""
COLOURS = ("red", "green", "blue")

_SPELLINGS: Mapping[str, tuple[str, ...]] = {
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "intensity": ("intensity", "reflectivity", "reflectance", "remission"),
    "red": ("red", "diffusered"),
    "green": ("green", "diffusegreen"),
    "blue": ("blue", "diffuseblue"),
    "classification": ("classification",),
    "gps_time": ("gpstime",),
    "return_number": ("returnnumber",),
    "number_of_returns": ("numberofreturns",),
    "las_flags": ("lasflags",),
}
"""Plain spellings of each field, the best first."""


def kept_fields() -> tuple[str, ...]:
    """Fields of points that a map keeps: ``KEPT``, then the attributes that other distributions bring."""
    return (*KEPT, *(name for name in point_fields() if name not in KEPT))


def plain(name: str) -> str:
    """A name without case, underscores, blanks and CloudCompare's prefix."""
    return name.lower().removeprefix("scalar_").replace("_", "").replace(" ", "")


def known_fields(names: Sequence[str]) -> dict[str, str]:
    """For x, y, z and each of :func:`kept_fields` that ``names`` hold: which of them holds it."""
    brought = {name: (plain(name), *row.spellings) for name, row in point_fields().items()}
    return dict(_known_fields(tuple(names), tuple({**brought, **_SPELLINGS}.items())))


@lru_cache(maxsize=64)
def _known_fields(names: tuple[str, ...], spelled: tuple[tuple[str, tuple[str, ...]], ...]) -> dict[str, str]:
    """:func:`known_fields` by how each field is ``spelled``: asked three times a scan."""
    by_spelling: dict[str, str] = {}
    for name in names:
        by_spelling.setdefault(plain(name), name)
    columns: dict[str, str] = {}
    for ours, spellings in spelled:
        there = [by_spelling[spelling] for spelling in spellings if spelling in by_spelling]
        if ours in names:
            columns[ours] = ours
        elif there:
            columns[ours] = there[0]
    if not any(colour in columns for colour in COLOURS) and {"r", "g", "b"} <= by_spelling.keys():
        columns |= {colour: by_spelling[colour[0]] for colour in COLOURS}
    return columns


def other_fields(names: Sequence[str]) -> tuple[str, ...]:
    """The fields that a map does not keep; padding (names that start with an underscore or a hash) is none."""
    kept = {*known_fields(names).values(), "rgb", "rgba"}
    return tuple(name for name in names if name not in kept and not name.startswith(("_", "#")))
