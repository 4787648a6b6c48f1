"""Who may be called a liar: only a vehicle that the others contradict from both sides of time, and often enough."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.tile_vote import DAY_NS, Vote
from mapvote.shapes.packed_cloud import SIDE_M
from mapvote_server.questions.contradictions import CONTRADICTIONS, Objects, compare
from mapvote_server.questions.vehicles import VehicleStanding, _tail, standings_of

UO, UE, CO, CE, UN = CellState


def plane(fill: int = CellState.UNCHANGED_EMPTY) -> U8:
    return np.full((TILE_CELLS, TILE_CELLS), fill, dtype=np.uint8)


def ghosts(n: int, fill: int = CellState.UNCHANGED_EMPTY) -> U8:
    """A vehicle that says n false buildings of 4 x 4 cells."""
    states = plane(fill)
    for i in range(n):
        row, col = 8 * (i // 32), 8 * (i % 32)
        states[row : row + 4, col : col + 4] = CellState.CHANGED_OCCUPIED
    return states


def said(name: str, day: int, states: U8) -> Vote:
    return Vote(name, day * DAY_NS, "", states=states)


def standings(*votes: tuple[str, int, U8]) -> dict[str, VehicleStanding]:
    compared = compare((0, 0), [said(*vote) for vote in votes])
    return {s.vehicle: s for s in standings_of(compared, Lattice())}


def test_a_vehicle_that_sees_ghosts_among_eight_that_do_not_is_named_with_the_evidence() -> None:
    honest = [(f"v{i}", i, plane()) for i in range(8)]
    found = standings(*honest[:4], ("liar", 3, ghosts(12)), *honest[4:])
    assert {name for name, s in found.items() if s.verdict == "contradicts"} == {"liar"}
    liar = found["liar"]
    assert (liar.objects, liar.others_objects) == (12, 0)
    assert len(liar.evidence) == 12
    assert {(e.cells, e.says) for e in liar.evidence} == {(16, "occupied")}
    assert (liar.evidence[0].x, liar.evidence[0].y) == (0.6, 0.6)
    assert found["v2"].verdict == "consistent"


def test_the_first_to_see_a_change_is_no_liar_and_neither_are_those_before() -> None:
    """Eight saw the building, it falls, three see the gap: nobody contradicts anybody."""
    before = [(f"v{i}", i, plane(UO)) for i in range(8)]
    after = [(f"w{i}", 10 + i, plane(CE)) for i in range(3)]
    for n in range(4):
        found = standings(*before, *after[:n])
        assert all(s.objects == 0 for s in found.values())
        assert all(s.verdict != "contradicts" for s in found.values())


def test_first_and_last_cannot_be_judged() -> None:
    found = standings(("a", 0, ghosts(40)), ("b", 1, plane()), ("c", 2, plane()), ("d", 3, ghosts(40)))
    assert [found[name].verdict for name in "abcd"] == ["undecidable", "consistent", "consistent", "undecidable"]


def test_ghosts_are_not_consistent_where_no_other_vehicle_can_be_judged() -> None:
    found = standings(("a", 0, plane()), ("x", 1, ghosts(40)), ("b", 2, plane()))
    assert (found["x"].objects, found["x"].others_cells) == (40, 0)
    assert [found[name].verdict for name in "axb"] == ["undecidable"] * 3
    assert standings(("a", 0, plane()), ("x", 1, plane()), ("b", 2, plane()))["x"].verdict == "consistent"


def test_one_ghost_proves_nothing() -> None:
    found = standings(*[(f"v{i}", i, plane()) for i in range(4)], ("x", 2, ghosts(1)))
    assert found["x"].objects == 1
    assert found["x"].verdict == "undecidable"


def test_abstaining_is_not_contradicting() -> None:
    found = standings(("a", 0, plane()), ("b", 1, plane(UN)), ("c", 2, plane(NO_VOTE)), ("d", 3, plane()))
    assert found["b"].cells == found["c"].cells == 0
    assert found["b"].verdict == found["c"].verdict == "undecidable"


def test_unchanged_and_changed_are_the_same_claim_about_the_world() -> None:
    """A vehicle that voted against an older version of the map says "changed" where the others say "unchanged"."""
    found = standings(("a", 0, plane(UO)), ("b", 1, plane(CO)), ("c", 2, plane(UO)))
    assert found["b"].objects == 0
    assert found["b"].cells == TILE_CELLS**2


def test_a_ghost_over_two_tiles_is_one_object() -> None:
    west, east = plane(), plane()
    west[10:14, -3:], east[10:14, :3] = CO, CO
    compared = []
    for index, states in (((0, 0), west), ((0, 1), east)):
        compared += compare(index, [said("a", 0, plane()), said("x", 1, states), said("b", 2, plane())])
    found = {s.vehicle: s for s in standings_of(compared, Lattice())}
    assert [(e.cells, e.x) for e in found["x"].evidence] == [(24, 76.8)]


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.2, 0.5]))
@settings(max_examples=15, deadline=None)
def test_objects_are_the_connected_cells_of_the_whole_map(seed: int, share: float) -> None:
    """Tile by tile and joined: as many, of the same sizes and at the same places as on one large raster."""
    rng = np.random.default_rng(seed)
    raster = np.full((2 * TILE_CELLS, 2 * TILE_CELLS), CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    at_border = np.abs(np.arange(2 * TILE_CELLS) - TILE_CELLS) < 6
    raster[(rng.random(raster.shape) < share) & (at_border[:, None] | at_border)] = CO
    raster[40:44, 40:47] = CO
    compared = []
    for row, col in np.ndindex(2, 2):
        tile = raster[TILE_CELLS * row :, TILE_CELLS * col :][:TILE_CELLS, :TILE_CELLS]
        three = said("a", 0, plane()), said("x", 1, tile), said("b", 2, plane())
        compared += compare((row - 1, col - 1), three)
    found = {s.vehicle: s for s in standings_of(compared, Lattice())}["x"]
    label, _ = scipy.ndimage.label(raster == CO, np.ones((3, 3)))
    sizes = np.bincount(label.reshape(-1))[1:]
    large = np.flatnonzero(sizes >= CONTRADICTIONS.least_cells)
    assert found.objects == len(large)
    told = np.array([(e.x, e.y, e.cells) for e in found.evidence])
    assert told[:, 2].tolist() == sorted(sizes[large].tolist(), reverse=True)[: CONTRADICTIONS.told]
    rows, cols = np.array(scipy.ndimage.center_of_mass(raster == CO, label, large + 1)).T
    expected = np.column_stack([CELL_SIZE * (cols + 0.5) - SIDE_M, CELL_SIZE * (rows + 0.5) - SIDE_M, sizes[large]])
    apart = np.abs(told[:, None] - expected[None]).max(axis=2)
    assert apart.min(axis=1).max() < 0.006, "centimetres are told"


def test_who_contradicts_everywhere_takes_little_room() -> None:
    """At worst every other cell: of 65,536 cells some kilobytes remain, and all objects are counted."""
    states = np.where(np.random.default_rng(1).random((TILE_CELLS, TILE_CELLS)) < 0.5, np.uint8(CO), np.uint8(UE))
    _, _, liar = compare((0, 0), [said("a", 0, plane()), said("b", 2, plane()), said("x", 1, states)])
    arrays = [liar.border.part, liar.border.rows, liar.border.cols]
    arrays += [getattr(some, name) for some in (liar.largest, liar.border.parts) for name in Objects.__slots__]
    assert sum(array.nbytes for array in arrays) < 50_000
    assert liar.inside >= len(liar.largest)


def test_flicker_is_not_counted() -> None:
    flicker = plane()
    flicker[::4, ::4] = CO
    found = standings(("a", 0, plane()), ("b", 1, flicker), ("c", 2, plane()))
    assert found["b"].objects == 0


def test_the_order_of_votes_does_not_matter() -> None:
    votes = [said(f"v{i}", i, ghosts(i)) for i in range(6)]
    forth = standings_of(compare((0, 0), votes), Lattice())
    assert forth == standings_of(compare((0, 0), votes[::-1]), Lattice())


@settings(max_examples=60, deadline=None)
@given(mine=st.integers(1, 40), others=st.integers(0, 200), share=st.floats(0.01, 0.99))
def test_the_tail_is_the_binomial_tail(mine: int, others: int, share: float) -> None:
    assert _tail(mine, others, share, 1.0 - share) == pytest.approx(
        float(binom.sf(mine - 1, mine + others, share)), rel=1e-9, abs=1e-300
    )


@pytest.mark.slow
def test_honest_vehicles_with_equal_noise_are_named_less_often_than_the_significance_says() -> None:
    """100 rounds of nine vehicles that all see random ghosts at the same rate: false alarms stay below 1 %."""
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(100):
        counts = rng.poisson(3.0, 9)
        votes = []
        for i, n in enumerate(counts):
            states = plane()
            for row, col in rng.integers(0, TILE_CELLS - 4, (n, 2)):
                states[row : row + 3, col : col + 3] = CO
            votes.append(said(f"v{i}", i, states))
        alarms += any(s.verdict == "contradicts" for s in standings_of(compare((0, 0), votes), Lattice()))
    assert alarms <= 1
