"""Which of the rules hold: all of them, but in an ablation (docs/columns-v1.md tells each, by its letter)."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class Rules:
    """In the order of their letters, A to I."""

    empty_by_ray: bool = True
    """A: a mapped voxel is seen through only by a ray that crossed it, else wherever its cell was visible."""
    hits_veto: bool = True
    """B: a hit next to a mapped voxel strikes it, else only a hit in it."""
    pose_explains: bool = True
    """C: new hits that all lie next to mapped voxels may be an error of pose."""
    new_where_free: bool = True
    """D: new is only what stands where the map knew free space."""
    rays_count_less: bool = True
    """E: a ray through a mapped voxel is worth a fraction of a hit."""
    rays_at_height: bool = True
    """F: against a new thing speak only rays at its height."""
    brief_is_passing: bool = True
    """G: what was struck in few scans has passed by, what is low or small is no change."""
    roofs_fall: bool = True
    """H: what stood on a demolished thing falls with it."""
    remnants_go: bool = True
    """I: what is left of demolished things beside what stands goes too."""


ALL_RULES = Rules()
LETTERS = "ABCDEFGHI"
"""The names that docs/columns-v1.md gives to the fields of :class:`Rules`, in their order."""


def by_letters(letters: str) -> Rules:
    """Only the rules of these letters hold: "AB" is the first two."""
    return Rules(**{rule.name: letter in letters for letter, rule in zip(LETTERS, fields(Rules), strict=True)})
