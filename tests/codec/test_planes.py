"""Planes <-> bytes: what is packed comes back, what is damaged is one clear error."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, Say, at_least, make_ballot, states_plane, two_walls, unpack_all, wall, words_plane
from mapvote.codec.ballot import (
    MOST_STEPS,
    STEPS_PER_NAT,
    UNSAID,
    Ballot,
    check_path,
    decode,
    encode,
    in_nats,
    in_steps,
    pack_odds,
    pack_path,
    pack_points,
    unpack_offer,
    unpack_path,
    unpack_points,
    unpack_states,
    unpack_sureness,
)
from mapvote.codec.fields import pack_fields
from mapvote.codec.manifest import TileHashes
from mapvote.codec.planes import (
    Words,
    compress,
    pack_plane,
    pack_words,
    unpack_bytes,
    unpack_plane,
    unpack_sparse,
    zstd,
)
from mapvote.codec.tile_planes import pack_memory, unpack_memory_plane
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.tile import PLANES, Memory
from mapvote.core.types import F32, I8, CellState, MapvoteError

SIZE = 1000


def unsaid(data: bytes) -> bytes:
    """A frame that does not say how large it is."""
    packer = zstd.ZstdCompressor()
    return packer.compress(data) + packer.flush()


@pytest.mark.parametrize("pack", [zstd.compress, unsaid])
def test_a_plane_unpacks_to_what_was_packed(pack: Callable[[bytes], bytes]) -> None:
    data = np.random.default_rng(1).integers(0, 6, SIZE, dtype=np.uint8).tobytes()
    plane = unpack_plane(pack(data), "<u1", (SIZE,), "plane")
    assert plane.tobytes() == unpack_bytes(pack(data), SIZE, "plane") == data


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        b"no frame",
        zstd.compress(bytes(SIZE))[:-2],
        zstd.compress(bytes(SIZE - 1)),
        zstd.compress(bytes(SIZE + 1)),
        zstd.compress(bytes(1 << 24)),
        unsaid(bytes(SIZE - 1)),
        unsaid(bytes(1 << 24)),
    ],
)
def test_a_damaged_frame_or_one_of_another_size_is_refused(bad: bytes) -> None:
    with pytest.raises(MapvoteError, match=r"^plane "):
        unpack_plane(bad, "<u1", (SIZE,), "plane")


CELL = (10, 10)


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 1e-4, 0.1, 1.0]))
@settings(max_examples=15, deadline=None)
def test_packed_or_not_they_are_the_plane(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    plane = np.where(rng.random(SHAPE) < share, rng.integers(1, 2**63, SHAPE), 0).astype(np.uint64)
    inside = rng.random(SHAPE) < 0.5
    for words in (Words.of(plane), unpack_sparse(pack_words(Words.of(plane)), "gone")):
        assert words.words.all()
        assert np.array_equal(at_least([words], 1), plane)
        for some in (words.within(inside), words.where(Words.whole(inside))):
            assert np.array_equal(at_least([some], 1), np.where(inside, plane, np.uint64(0)))
        assert not len(words.where(Words.whole(np.zeros(SHAPE, np.bool_))).cells)


@given(words=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=8), k=st.integers(1, 5))
@settings(deadline=None)
def test_at_least_counts_bits(words: list[int], k: int) -> None:
    expected = sum(1 << b for b in range(64) if sum(w >> b & 1 for w in words) >= k)
    assert int(at_least([Words.of(words_plane({CELL: w})) for w in words], k)[CELL]) == expected


@pytest.mark.parametrize(
    "bad",
    [
        *(pack_plane(np.zeros(size, np.uint8)) for size in (8, 11, 256 * 256 * 10 + 10)),
        b"",
        b"no zstd frame",
        pack_words(Words.of(words_plane({CELL: 7})))[:-1],
        pack_words(Words.of(words_plane({CELL: 7}))) + b"x",
        compress(bytes([3, 0, 0, 0]) + bytes([1, 1]) + bytes(14), 1),  # a cell twice
        compress(bytes([255, 1, 255, 0]) + bytes([1, 1]) + bytes(14), 1),  # beyond the tile
        compress(bytes([3, 0]) + bytes(8), 1),  # an empty word
    ],
)
def test_words_that_no_vehicle_wrote_are_refused(bad: bytes) -> None:
    with pytest.raises(MapvoteError, match="ballot: gone"):
        unpack_sparse(bad, "gone")


EDGE = float(np.nextafter(np.float32(76.8), np.float32(0.0)))
SIDE = st.one_of(st.floats(0.0, EDGE, width=32), st.sampled_from([0.0, EDGE]))
HEIGHT = st.floats(-1e5, 1e5, width=32)


def voxels(points: F32) -> np.ndarray:
    return np.floor(points.astype(np.float64) / CELL_SIZE).astype(np.int64)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(SIDE, SIDE, st.one_of(st.floats(-30.0, 60.0, width=32), HEIGHT)), max_size=40))
def test_a_point_stays_in_its_voxel_and_within_what_rounding_may_move_it_whatever_the_order(
    points: list[tuple[float, float, float]],
) -> None:
    sent = np.array(points, dtype=np.float32).reshape(-1, 3)
    found = unpack_points(pack_points(sent))
    assert found.dtype == np.float32
    assert found.shape == sent.shape
    near = np.abs(sent[:, 2]) < 1e3  # beyond, float32 itself is coarser than the steps
    np.testing.assert_array_equal(voxels(found)[near], voxels(sent)[near])
    np.testing.assert_allclose(found[near], sent[near], rtol=0, atol=0.5 * CELL_SIZE / 32 + 1e-4)
    np.testing.assert_array_equal(voxels(found)[:, :2], voxels(sent)[:, :2])
    assert unpack_points(pack_points(found[near])).tobytes() == found[near].tobytes(), "it is never moved again"


def test_points_of_a_street_take_less_than_half_of_what_float32_takes() -> None:
    rng = np.random.default_rng(1)
    cells = np.sort(rng.choice(65536, 3000, replace=False))
    at = np.column_stack([cells % 256, cells // 256, rng.integers(0, 9, 3000)])
    sent = ((at + rng.random((3000, 3))) * CELL_SIZE).astype(np.float32)
    assert 2 * len(pack_points(sent)) < len(pack_plane(sent))


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (bytes(8), "is no number of points"),
        (bytes(6) + b"\x20" + bytes(2), "outside its tile or not finite"),
        (bytes(4) + b"\x00\x10" + bytes(3), "outside its tile or not finite"),
        (bytes(9 * 65), "more than 64 points in one cell"),
    ],
    ids=["half", "beyond its voxel", "in the sky", "too many in a cell"],
)
def test_points_that_no_vehicle_wrote_are_refused(raw: bytes, why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        unpack_points(compress(raw, 1))


POINTS = unpack_points(pack_points(wall([(3, 3)], [0.5, 0.8, 1.1])))
CHANGES = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)


def saying(cells: dict[tuple[int, int], int], odds: I8 | None) -> Ballot:
    return make_ballot(two_walls(), {(0, 0): Say(states_plane(cells), odds=odds)})


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(
        st.tuples(st.integers(0, 255), st.integers(0, 255)),
        st.tuples(st.sampled_from(range(5)), st.integers(-MOST_STEPS, MOST_STEPS)),
        max_size=40,
    )
)
def test_every_changed_cell_gets_its_own_byte_back_and_no_other_cell_has_one(
    said: dict[tuple[int, int], tuple[int, int]],
) -> None:
    bytes_of = {cell: odds for cell, (state, odds) in sorted(said.items()) if state in CHANGES}
    sent = saying({cell: state for cell, (state, _) in said.items()}, np.array(list(bytes_of.values()), np.int8))
    got = decode(encode(sent))
    unpack_all(got)
    (tile,) = got.tiles
    assert tile.states is not None
    said_of = unpack_sureness(tile.odds, unpack_states(tile.states))
    assert said_of is not None
    assert said_of[1].tolist() == list(bytes_of.values())


@given(st.lists(st.floats(-100, 100), max_size=20))
def test_log_odds_keep_their_sign_and_lose_half_a_step_at_most(nats: list[float]) -> None:
    back = in_nats(in_steps(np.array(nats, dtype=np.float64)))
    within = np.clip(np.array(nats), -MOST_STEPS / STEPS_PER_NAT, MOST_STEPS / STEPS_PER_NAT)
    assert np.abs(back - within).max(initial=0.0) <= 0.5 / STEPS_PER_NAT
    assert (back * within >= 0).all()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (pack_odds(np.zeros(1, np.int8)), "1 bytes, expected 2"),
        (pack_odds(np.zeros(3, np.int8)), "larger than 2 bytes"),
        (pack_odds(np.array([0, UNSAID], np.int8)), "no log-odds"),
        (compress(b"x" * 100_000_000), "larger than 2 bytes"),
        (b"not zstd", "damaged"),
    ],
    ids=["a cell too few", "a cell too many", "a value that nobody says", "a bomb", "no frame"],
)
def test_a_ballot_that_no_vehicle_sends_is_one_clear_error(data: bytes, says: str) -> None:
    sent = saying({(3, 3): CellState.CHANGED_EMPTY, (3, 4): CellState.CHANGED_OCCUPIED}, None)
    tile = msgspec.structs.replace(sent.tiles[0], odds=data)
    with pytest.raises(MapvoteError, match=f"ballot: odds .*{says}"):
        unpack_all(msgspec.structs.replace(sent, tiles=[tile]))


def test_a_kilometre_is_told_every_five_metres_in_two_hundred_bytes() -> None:
    driven = np.column_stack([np.arange(0.0, 1000.0, 1.1), np.full(910, -40.0), np.full(910, 1.9)])
    packed = pack_path(list(driven), Lattice())
    cells = unpack_path(packed)
    assert len(packed) < 200
    assert 160 <= len(cells) <= 200
    assert cells[[0, -1]].tolist() == np.column_stack(Lattice().cells_of(driven[[0, -1]])).tolist()
    assert (np.hypot(*np.diff(cells, axis=0)[:-1].T) * 0.3 >= 4.7).all()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (pack_plane(np.zeros(3, np.int32)), "not a multiple of 8"),
        (pack_plane(np.zeros((100_001, 2), np.int32)), "larger than"),
        (b"no frame", "damaged"),
    ],
)
def test_a_path_that_is_not_whole_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        unpack_path(data)


def test_nobody_drove_far_from_where_he_voted() -> None:
    packed = pack_path([np.array([10.0, 10.0]), np.array([200.0, 10.0])], Lattice())
    check_path(packed, [(0, 0), (0, 1)])
    with pytest.raises(MapvoteError, match="tile 0,2, far from where the drive voted"):
        check_path(packed, [(0, 0)])


def test_tiles_that_differ_in_their_memory_alone_are_equal_and_not_unequal() -> None:
    tile = TileHashes("p", "g", None, memory="m")
    for same in (TileHashes("p", "g", None), TileHashes("p", "g", None, memory="n")):
        assert tile == same
        assert not tile != same  # noqa: SIM202  # msgspec's own answer would be another
    assert tile != TileHashes("p", "g", "f", memory="m")


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 1e-4, 0.1, 1.0]))
@settings(max_examples=8, deadline=None)
def test_the_memory_of_a_tile_comes_back_for_few_cells_and_for_all(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    planes = np.where(rng.random((PLANES, *SHAPE)) < share, rng.integers(1, 2**32, (PLANES, *SHAPE)), 0)
    digest, packed = pack_memory(Memory.of(planes.astype(np.uint32)))
    np.testing.assert_array_equal(unpack_memory_plane(packed[digest], digest).planes, planes)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 255), max_size=64))
def test_intensity_comes_back_beside_its_points(values: list[int]) -> None:
    points, bright = np.repeat(POINTS[:1], len(values), axis=0), np.array(values, dtype=np.uint8)
    sent = make_ballot(two_walls(), {(0, 0): Say(states_plane(), new_points=points, fields={"intensity": bright})})
    (got,) = unpack_all(decode(encode(sent)))
    assert got.new_points is not None
    assert got.new_points.tobytes() == points.tobytes()
    assert got.fields["intensity"].tolist() == values


def attributes(**fields: np.ndarray) -> bytes:
    return compress(pack_fields(fields))


def test_a_ballot_without_attributes_has_none_and_every_point_must_have_them() -> None:
    points, two = pack_points(POINTS), attributes(intensity=np.zeros(2, np.uint8))
    assert unpack_offer(points, None)[1] == {}
    for offered, why in ((points, "2 bytes, but there are 3 points"), (None, "none of those")):
        with pytest.raises(MapvoteError, match=why):
            unpack_offer(offered, two)
    wrong = {
        "type uint16, not uint8": attributes(intensity=np.zeros(3, "<u2")),
        "'heat' is unknown; known are intensity": attributes(heat=np.zeros(3, "u1")),
        "fields is larger than": attributes(**{str(k): np.zeros(3) for k in range(500)}),
        "no fields of points": compress(b"bright"),
    }
    for why, sent in wrong.items():
        with pytest.raises(MapvoteError, match=why):
            unpack_offer(points, sent)
    with pytest.raises(MapvoteError, match="no states"):
        unpack_sureness(pack_odds(np.zeros(2, np.int8)), None)
