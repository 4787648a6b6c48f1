"""The examples of docs/extending.md work from outside the package: a distribution of its own with an entry point."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import laspy
import numpy as np
import pytest
from msgspec.structs import replace

from command_line import typed
from hand_made import Say, make_ballot, states_plane, wall
from mapvote.codec.ballot import Ballot, encode
from mapvote.config import FuseSettings, Settings, choose_case
from mapvote.core import rule
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.points import point_fields
from mapvote.core.types import F64, CellState, Drive, MapvoteError
from mapvote.formats import DriveWriter, export_map, open_drive
from mapvote.fusion.fuse import update_map
from mapvote.matching.localiser import GivenPoses
from mapvote.matching.matcher import map_around
from mapvote.vehicle import vote_drive
from mapvote_server.api.app import URL, in_process
from mapvote_server.store.examination import examine
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from stores import NewStore, send
from streets import drive_along, path, street

PAGE = (Path(__file__).parents[1] / "docs/extending.md").read_text()
Install = Callable[[str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Lays an example of the page as an installed distribution."""
    own = list(rule.RULES)
    caches = rule.plugged_in, point_fields

    def lay(module: str) -> None:
        (source,) = re.findall(rf"^```python\n(# {module}\.py\n.*?)^```", PAGE, re.M | re.S)
        entry = rf'^```toml\n\[project\.entry-points\."([^"]+)"\]\n(\w+) = "({module}:[^"]+)"\n```'
        ((group, name, target),) = re.findall(entry, PAGE, re.M)
        folder = tmp_path / "site"
        about = folder / f"{module}-1.0.dist-info"
        about.mkdir(parents=True)
        (folder / f"{module}.py").write_text(source)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
        monkeypatch.syspath_prepend(folder)
        for cached in caches:
            cached.cache_clear()

    yield lay
    for cached in caches:
        cached.cache_clear()
    for name in [name for name in rule.RULES if name not in own]:
        del rule.RULES[name]
        sys.modules.pop(name, None)


def ballot_by(method: str, point_map: PointMap) -> Ballot:
    """A short drive past a new wall, voted on by a rule."""
    poses = path(8)
    drive = drive_along(poses, 3, prior=poses)
    settings = choose_case(Settings(), method)
    given = GivenPoses(drive.stamps_ns, poses)
    return vote_drive(drive, point_map, settings, localise=given)[0]


@pytest.fixture(scope="module")
def old_map() -> PointMap:
    """The street without the front of one house, so that a drive finds something new."""
    points = street(7)
    gone = (points[:, 1] > 11) & (points[:, 0] > -21) & (points[:, 0] < -7)
    return map_from_points(points[~gone])


def test_a_rule_of_another_distribution_casts_ballots_that_fuse_and_that_a_server_admits(
    install: Install, old_map: PointMap, new_store: NewStore
) -> None:
    install("any_hit")
    ballot = ballot_by("any_hit", old_map)
    assert ballot.method == "any_hit"
    updated, decisions = update_map(old_map, [ballot], Settings().fuse.model_copy(update={"min_votes": 1}))
    assert sum(decision.added for decision in decisions.values()) > 100, "the new house comes in"
    assert updated.n_points > old_map.n_points
    store = new_store(old_map, name="fleet.db")
    name = store.database.url.database
    with in_process(store, owner="kim") as transport, httpx2.Client(transport=transport, base_url=URL) as client:
        refused = client.put(f"/v1/ballots/{ballot.vehicle}/{ballot.drive}", content=encode(ballot))
        assert refused.status_code == 409, "the policy asks for surfaces"
    typed("policy", name, "round.method=any_hit")
    with in_process(store, owner="kim") as transport, httpx2.Client(transport=transport, base_url=URL) as client:
        admitted = client.put(f"/v1/ballots/{ballot.vehicle}/{ballot.drive}", content=encode(ballot))
        assert admitted.status_code == 201, admitted.text
        other = replace(ballot_by("surfaces", old_map), drive="other")
        refused = client.put(f"/v1/ballots/{other.vehicle}/other", content=encode(other))
        assert refused.status_code == 409
        assert "uses method surfaces, two-stage; the current round accepts only any_hit, two-stage" in refused.text


def classed_drive(poses: F64, seed: int, folder: Path) -> Drive:
    """A drive from files of x, y, z and class: 6 (building) above 0.3 m, 2 (ground) below."""
    drive = drive_along(poses, seed, prior=poses)
    writer = DriveWriter(folder, f"car_{seed}", drive.sensor, start_ns=0, motion_compensated=True).open()
    for i, scan in enumerate(drive):
        height_m = transform(poses[i], scan.points)[:, 2]
        writer.write_scan(i, scan.points, np.where(height_m > 0.3, np.float32(6), np.float32(2)))
    writer.close(drive.stamps_ns, poses)
    return open_drive(folder, columns="x,y,z,class")


def test_an_attribute_of_another_distribution_goes_from_a_drive_over_a_server_to_a_las_file(
    install: Install, old_map: PointMap, new_store: NewStore, tmp_path: Path
) -> None:
    points = all_points(old_map)
    classed = map_from_points(points, fields={"classification": np.where(points[:, 2] > 0.3, 5, 2).astype(np.uint8)})
    poses = path(8)
    drives = [classed_drive(poses, seed, tmp_path / f"drive_{seed}") for seed in (3, 4)]
    settings = Settings()
    without = vote_drive(drives[0], classed, settings, localise=GivenPoses(drives[0].stamps_ns, poses))[0]
    assert all(tile.fields is None for tile in without.tiles), "nobody brings the attribute"
    install("point_class")
    ballots = [vote_drive(drive, classed, settings, localise=GivenPoses(drive.stamps_ns, poses))[0] for drive in drives]
    store = new_store(classed, Policy(fuse=FuseSettings(min_votes=2, max_deleted_share=1.0)), name="fleet.db")
    send(store, *ballots)
    assert publish(store).points_added > 100, "the new house comes in"
    export_map(store.point_map(), tmp_path / "out.las")
    written = laspy.read(tmp_path / "out.las")
    classes = np.asarray(written.classification)
    assert set(classes.tolist()) == {2, 5, 6}
    assert (classes == 6).sum() > 100
    assert (np.asarray(written.z)[classes == 6] > 0.3).all()


def test_a_server_refuses_an_attribute_that_no_distribution_brings(old_map: PointMap) -> None:
    cell = {(100, 100): CellState.CHANGED_OCCUPIED}
    fields = {"classification": np.array([6, 6], np.uint8)}
    says = {(0, 0): Say(states_plane(cell), new_points=wall(list(cell), [0.45, 0.75]), fields=fields)}
    with pytest.raises(MapvoteError, match="'classification' is unknown; known are intensity; or install"):
        examine(encode(make_ballot(old_map, says)))


def test_a_matcher_of_another_distribution_localises_a_drive(install: Install) -> None:
    install("fine_vgicp")
    poses = path(8)
    off_m = from_xyz_rpy(0.6, -0.4, 0.1)
    drive = drive_along(poses, 3, prior=poses @ off_m)
    settings = Settings.model_validate({"ndt": {"matcher": "fine_vgicp"}})
    _, report = vote_drive(drive, map_from_points(street(7)), settings)
    assert not report.lost
    errors_m = [np.linalg.norm(T[:3, 3] - true[:3, 3]) for T, true in zip(report.T_map_lidar, poses, strict=True)]
    assert max(errors_m) < 0.15


def test_a_matcher_that_no_distribution_brings_is_named_with_those_that_are_known(old_map: PointMap) -> None:
    with pytest.raises(MapvoteError, match="no matcher 'gicp'; known are ndt, vgicp"):
        map_around("gicp", old_map)


def test_a_rule_that_no_distribution_brings_is_named_with_those_that_are_known(old_map: PointMap) -> None:
    with pytest.raises(MapvoteError, match=r"no case 'any_hit'; choose one of paper, surfaces, 1, 2, 3, 4, 5"):
        choose_case(Settings(), "any_hit")
    with pytest.raises(MapvoteError, match="vote rule 'any_hit' is unknown; known are paper, surfaces"):
        rule.rule_named("any_hit")


def test_versions_of_a_rule_never_share_a_round(install: Install) -> None:
    install("any_hit")
    settings = choose_case(Settings(), "any_hit")
    before = settings.digest()
    rule.RULES["any_hit"] = rule.Rule(voter="any_hit:AnyHit", version="2")
    assert settings.digest() != before


@pytest.mark.slow
def test_evaluate_scores_a_rule_of_another_distribution(install: Install, tmp_path: Path) -> None:
    install("any_hit")
    said = typed("evaluate", "corner", "--seed", "5", "--case", "any_hit")
    assert "any_hit" in said
    assert not np.isnan(float(re.findall(r"any_hit\D+([\d.]+)", said)[0]))
