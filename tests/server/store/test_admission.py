"""What founds a ballot: enough scans, and a prior that its fixes bear out."""

import msgspec
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.store.admission import examine


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
