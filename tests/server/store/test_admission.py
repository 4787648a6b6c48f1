"""What a ballot must be: founded on enough scans, borne out by its priors, within what can be."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls, wall
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.store.admission import Receipt, accept, examine
from mapvote.server.store.store import Store


def ballot(**more: object) -> Ballot:
    says = {(0, 0): Say(states_plane({(10, 10): CellState.UNCHANGED_OCCUPIED}))}
    return msgspec.structs.replace(make_ballot(two_walls(), says), **more)


def test_a_ballot_of_an_older_vehicle_that_does_not_say_how_it_is_founded_is_taken() -> None:
    assert examine(encode(ballot())).ballot.length_m is None


def test_one_localised_scan_founds_no_ballot() -> None:
    with pytest.raises(MapvoteError, match="only 1 of 10 scans were localised"):
        examine(encode(ballot(scans_localised=1)))


def test_a_drive_steadily_off_its_prior_is_held_back_and_told_so() -> None:
    with pytest.raises(MapvoteError, match=r"held back.* 9\.8 m apart .* claim 1\.00 m"):
        examine(encode(ballot(prior_misfit_m=9.8, prior_sigma_m=1.0)))


def test_a_prior_as_good_as_it_claims_or_openly_bad_is_no_reason_to_hold_back() -> None:
    examine(encode(ballot(prior_misfit_m=1.5, prior_sigma_m=1.0)))
    examine(encode(ballot(prior_misfit_m=9.8, prior_sigma_m=10.0)))


def test_a_misfit_that_is_no_distance_is_refused() -> None:
    with pytest.raises(MapvoteError, match="prior_misfit_m"):
        examine(encode(ballot(prior_misfit_m=float("nan"), prior_sigma_m=1.0)))


def test_more_localised_scans_than_there_were_are_a_lie() -> None:
    with pytest.raises(MapvoteError, match="11 of 10 scans were localised: more than there are"):
        examine(encode(ballot(scans_localised=11)))


@pytest.mark.parametrize("sigma_m", [-0.01, float("nan"), float("inf")])
def test_a_sigma_is_a_distance(sigma_m: float) -> None:
    with pytest.raises(MapvoteError, match=r"median_sigma_m = .* is no distance"):
        examine(encode(ballot(median_sigma_m=sigma_m)))


def points_in_one_cell(n: int) -> Ballot:
    plane = states_plane({(10, 10): CellState.CHANGED_OCCUPIED})
    say = Say(plane, new_points=wall([(10, 10)], list(np.linspace(0.4, 19.0, n))))
    return make_ballot(two_walls(), {(0, 0): say})


def test_a_cell_has_64_voxels_and_no_more_new_points() -> None:
    assert len(examine(encode(points_in_one_cell(64))).ballot.tiles) == 1
    with pytest.raises(MapvoteError, match="more than 64 points in one cell"):
        examine(encode(points_in_one_cell(65)))


def at_height(z: float, tile: tuple[int, int] = (0, 0)) -> Ballot:
    say = Say(states_plane({(10, 10): CellState.CHANGED_OCCUPIED}), new_points=wall([(10, 10)], [z]))
    return make_ballot(two_walls(), {tile: say})


@pytest.mark.parametrize("tile", [(0, 0), (0, 2), (1, 1)])
def test_new_points_lie_at_a_height_where_something_can_be(tmp_path: Path, tile: tuple[int, int]) -> None:
    """The ground of the map lies at 0 m."""
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    said = [str(answer) for answer in accept(store, [examine(encode(at_height(z, tile))) for z in (-11.0, 121.0)])]
    assert all("within 10 m below to 120 m above the map's lowest ground there, 0.0 m" in text for text in said)
    (low,) = accept(store, [examine(encode(at_height(-9.0, tile)))])
    (high,) = accept(store, [examine(encode(at_height(119.0, tile)))])
    assert isinstance(low, Receipt)
    assert isinstance(high, Receipt)
    store.close()


def test_a_drive_is_no_older_than_the_map_and_not_of_tomorrow(tmp_path: Path) -> None:
    now = 1_700_000_000 * 10**9
    first = replace(two_walls(), surveyed_ns=now - 100)
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", first, clock=lambda: now)
    stamps = {now - 101: "before the map was surveyed", now + 301 * 10**9: "ends in the future"}
    for end_ns, why in stamps.items():
        (answer,) = accept(store, [examine(encode(ballot(start_ns=0, end_ns=end_ns)))])
        assert why in str(answer)
    for end_ns in (now - 100, now + 299 * 10**9):
        (answer,) = accept(store, [examine(encode(ballot(start_ns=0, end_ns=end_ns)))])
        assert isinstance(answer, Receipt), answer
    assert Store.open(f"sqlite:///{tmp_path / 's.db'}").point_map().surveyed_ns == now - 100
    store.close()
