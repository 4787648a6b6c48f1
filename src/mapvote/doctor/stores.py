"""A store by itself: is every byte what it was, can anybody use it, and is the map in it sound?"""

from __future__ import annotations

from collections import Counter

from mapvote.core.types import MapvoteError
from mapvote.doctor.finding import Finding, in_order
from mapvote.doctor.maps import check_whole
from mapvote.server.store.integrity import check
from mapvote.server.store.keys import listed
from mapvote.server.store.store import Store
from mapvote.server.views.overview import overview

_MEND = "mapvote check STORE --mend --from BACKUP"
_TOLD = 5
"""Damaged things of one kind that are told one by one."""


def check_store(store: Store) -> list[Finding]:
    """Everything that the doctor finds in an open store, errors first. Every byte is read."""
    found = _damage(store)
    at_a_glance = overview(store)
    told = ", ".join(
        f"{at_a_glance[key]:,} {key.replace('_', ' ')}" for key in ("tiles", "ballots", "vehicles", "plane_bytes")
    )
    found.append(Finding("note", f"version {at_a_glance['version']}: {told}"))
    if at_a_glance["quarantined"]:
        what = f"{at_a_glance['quarantined']} damaged things were set aside: their votes and tiles do not count"
        found.append(Finding("warning", what, f"{_MEND} brings back what a backup has"))
    found += _keys(store)
    try:
        return in_order(found + check_whole(store.point_map()))
    except MapvoteError as error:
        return in_order([*found, Finding("error", f"its newest map cannot be read: {error}", _MEND)])


def _damage(store: Store) -> list[Finding]:
    damaged = check(store)
    kinds = Counter(damage.kind for damage in damaged)
    found = []
    for kind, count in kinds.items():
        some = [damage for damage in damaged if damage.kind == kind][:_TOLD]
        found += [Finding("error", f"damaged: {damage}", _MEND) for damage in some]
        if count > _TOLD:
            found.append(Finding("error", f"damaged: {count - _TOLD} more of the kind {kind}", _MEND))
    return found


def _keys(store: Store) -> list[Finding]:
    valid = Counter(key.role for key in listed(store) if key.valid_at(store.clock()))
    if not valid["operator"]:
        what = "no operator has a valid key: nobody can run it from afar"
        return [Finding("warning", what, "mapvote keys STORE issue NAME operator")]
    return [Finding("note", "keys: " + ", ".join(f"{count} {role}" for role, count in sorted(valid.items())))]
