"""`mapvote update`: the offline server on files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hand_made import Say, make_ballot, states_plane, two_walls, wall
from mapvote.cli import app
from mapvote.codec.ballot import Ballot, encode
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, CellState, MapvoteError
from mapvote.formats import read_map, write_map
from mapvote.fusion.fuse import update_map

KEEP = FuseSettings(min_votes=1)


@pytest.fixture
def street() -> PointMap:
    return two_walls()


def gone(street: PointMap, vehicle: str = "v1", **more: object) -> Ballot:
    """The vehicle says that the first cell of the wall in tile (0, 0) is gone."""
    says = {(0, 0): Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))}
    return make_ballot(street, says, vehicle=vehicle, **more)  # type: ignore[arg-type]


def test_untouched_tiles_are_the_same_objects(street: PointMap) -> None:
    after, decisions = update_map(street, [gone(street)], KEEP)
    assert after.tiles[0, 1] is street.tiles[0, 1]
    assert len(after.tiles[0, 0].points) == len(street.tiles[0, 0].points) - 3
    assert decisions[0, 0].deleted == 3


def test_the_same_ballot_twice_is_one_vote(street: PointMap) -> None:
    keep = make_ballot(street, {(0, 0): Say(states_plane({(10, 10): 0}))}, vehicle="v2")
    after, _ = update_map(street, [gone(street), gone(street), keep], KEEP)
    assert after.tiles[0, 0] is street.tiles[0, 0]


def test_a_building_where_the_map_had_no_tile(street: PointMap) -> None:
    built = Say(states_plane({(5, 5): CellState.CHANGED_OCCUPIED}), new_points=wall([(5, 5)], [0.45, 0.75]))
    after, _ = update_map(street, [make_ballot(street, {(4, 4): built}, vehicle=v) for v in "ab"], FuseSettings())
    assert len(after.tiles[4, 4].points) == 2


@pytest.mark.parametrize(
    ("ballots", "message"),
    [
        (lambda m: [], "no ballots"),
        (lambda m: [gone(m), gone(m, "v2", method="paper")], "never mixes methods"),
        (lambda m: [gone(m), gone(m, "v2", settings_hash="t")], "never mixes methods"),
        (lambda m: [gone(m, map_id="elsewhere")], "not on 'test-map'"),
        (lambda m: [gone(m, base={(0, 0): "0" * 64})], "another version of tile 0,0"),
        (lambda m: [gone(m), gone(m, end_ns=5_000_000_000)], "given twice"),
        (lambda m: [gone(m, method="astrology")], "unknown"),
    ],
)
def test_a_round_that_cannot_be_fused_says_why(
    street: PointMap, ballots: Callable[[PointMap], list[Ballot]], message: str
) -> None:
    with pytest.raises(MapvoteError, match=message):
        update_map(street, ballots(street), KEEP)


def run(arguments: Sequence[object]) -> str:
    result = CliRunner().invoke(app, ["update", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_update_on_files(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    for vehicle in ("v1", "v2"):
        (tmp_path / vehicle).write_bytes(encode(gone(street, vehicle)))
    files = [tmp_path / "v1", tmp_path / "v2"]
    run([tmp_path / "map", *files, "--out", tmp_path / "new", "--cells", tmp_path / "cells.npz"])
    assert len(read_map(tmp_path / "new").tiles[0, 0].points) == len(street.tiles[0, 0].points) - 3
    with np.load(tmp_path / "cells.npz") as cells:
        assert cells["states"][10, 10] == CellState.CHANGED_EMPTY
        assert (float(cells["x0"]), float(cells["y0"]), float(cells["cell_size"])) == (0.0, 0.0, 0.3)
    assert "dry run" in run([tmp_path / "map", *files, "--dry-run", "--out", tmp_path / "nothing"])
    assert not (tmp_path / "nothing").exists()


def test_update_says_who_sent_what_another_sent(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    borders = np.random.default_rng(1).integers(-5, 6, (2, 256)).cumsum(axis=1).clip(-20, 20)
    rows = np.arange(256)[:, None]
    states = np.where((rows > 60 + borders[0]) & (rows < 180 + borders[1]), CellState.UNCHANGED_EMPTY, NO_VOTE).astype(
        np.uint8
    )
    for vehicle, moved in (("v1", states), ("v2", np.roll(states, 1, axis=0))):
        (tmp_path / vehicle).write_bytes(encode(make_ballot(street, {(0, 0): Say(moved)}, vehicle)))
    told = run([tmp_path / "map", tmp_path / "v1", tmp_path / "v2", "--dry-run"])
    assert "on 1 tile: the two count as one vehicle there" in told


def test_one_vehicle_alone_needs_min_votes_1(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    (tmp_path / "b").write_bytes(encode(gone(street)))
    assert "--min-votes 1" in run([tmp_path / "map", tmp_path / "b", "--dry-run"])
    assert "0 points added, 3 deleted" in run([tmp_path / "map", tmp_path / "b", "--dry-run", "--min-votes", "1"])


def test_a_ballot_that_is_none_names_the_file(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    (tmp_path / "b").write_bytes(b"nonsense")
    with pytest.raises(MapvoteError, match=r"/b: ballot: not readable"):
        run([tmp_path / "map", tmp_path / "b", "--dry-run"])
