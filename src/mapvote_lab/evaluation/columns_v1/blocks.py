"""Tiles that are judged together: all of a short drive, those of a long one block by block, so that none is too long.

No rule looks farther than a tile: so a block is judged as in the whole if the tiles around it are judged along.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from mapvote.core.grid import TileIndex

_AT_ONCE = 24
"""Tiles that are judged together; of more, blocks of _BLOCK by _BLOCK with the tiles around them, 15 MB each."""
_BLOCK = 3


def blocks_and_around(tiles: Iterable[TileIndex]) -> Iterator[tuple[list[TileIndex], list[TileIndex]]]:
    """Pairs (the tiles whose votes are wanted, those and the ones around them), each tile in one block."""
    every = sorted(tiles)
    if len(every) <= _AT_ONCE:
        yield every, every
        return
    for row, col in sorted({(r // _BLOCK, c // _BLOCK) for r, c in every}):
        inner = [t for t in every if (t[0] // _BLOCK, t[1] // _BLOCK) == (row, col)]
        around = {(r + i, c + j) for r, c in inner for i in (-1, 0, 1) for j in (-1, 0, 1)}
        yield inner, [t for t in every if t in around]
