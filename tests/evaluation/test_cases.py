"""Many voters in one pass say what each would alone; how the paper is read; what cached results are named by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.codec.ballot import Ballot, encode
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.matching.localiser import GivenPoses
from mapvote.vehicle import vote_drive
from mapvote_lab.evaluation.cases import as_paper, choose_cases
from mapvote_lab.evaluation.scene import (
    SharedPass,
)

N = 8
POSES = np.array([from_xyz_rpy(20.0 + 0.2 * i, 20.0, 1.8) for i in range(N)])
STAMPS = np.arange(1, N + 1) * 100_000_000


def sheet(x: F64, y: F64, z: F64) -> F64:
    return np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)


ROAD = sheet(np.arange(5.0, 45.0, 0.25), np.arange(5.0, 35.0, 0.25), np.zeros(1))
OLD = sheet(np.array([30.1]), np.arange(15.0, 19.0, 0.15), np.arange(0.1, 3.0, 0.2))
NEW = sheet(np.array([30.1]), np.arange(21.0, 25.0, 0.15), np.arange(0.1, 3.0, 0.2))
BACK = sheet(np.array([40.1]), np.arange(8.0, 32.0, 0.15), np.arange(0.1, 5.0, 0.2))


@pytest.fixture(scope="module")
def street() -> PointMap:
    return map_from_points(np.vstack([ROAD, OLD, BACK]))


@pytest.fixture(scope="module")
def drive() -> Drive:
    today = np.vstack([ROAD[ROAD[:, 0] < 30.0], NEW, BACK[BACK[:, 1] < 20.0]])
    scans = [Scan(int(s), transform(inverse(T), today).astype(np.float32)) for s, T in zip(STAMPS, POSES, strict=True)]
    return Drive(Path("today"), "v1", "today", SENSORS["hdl32e"], STAMPS, scans.__getitem__)


def planes(ballot: Ballot) -> list[tuple[object, ...]]:
    """All but the points: those are shared, so a voxel's may be another than if the voter had been alone."""
    return [(tile.tile, tile.states, tile.tally, tile.gone, tile.free) for tile in ballot.tiles]


@pytest.mark.slow
def test_each_case_says_what_a_vehicle_of_its_own_would_have_said(street: PointMap, drive: Drive) -> None:
    cases, _ = choose_cases(Settings(), "1,1 column,3,5,surfaces")
    shared = SharedPass(drive, street, Settings(), cases, localise=GivenPoses(STAMPS, POSES))
    seen = []
    for scan in drive:
        seen += shared.observe(scan)
    seen += shared.finish()
    assert [observation.scan.index for observation in seen] == list(range(N))
    said = set()
    for case in cases:
        settings = Settings(voting=case.voting, paper=case.paper)
        alone, _ = vote_drive(drive, street, settings, localise=GivenPoses(STAMPS, POSES))
        together = shared.ballot(case)
        assert planes(together) == planes(alone)
        assert together.settings_hash == alone.settings_hash
        said.add(encode(together))
    assert len(said) == len(cases)


def test_an_occluded_scan_abstains_by_default_and_the_map_of_the_papers_street_keeps_whatever_stood_still() -> None:
    settings = as_paper(Settings(), "as_published")
    assert settings.paper.occluded == "abstains"
    assert not settings.mapping.drop_strays
    assert as_paper(Settings(), "street570") == Settings(), "every other street is as it is set"
    assert as_paper(Settings(), "as_published", ["mapping.drop_strays"]) == Settings(), "what the user set stays"
    assert as_paper(Settings(), "street570", reading="occluded=votes").paper.occluded == "votes"
    with pytest.raises(MapvoteError, match="occluded=abstains"):
        as_paper(Settings(), "as_published", reading="hidden=no")
