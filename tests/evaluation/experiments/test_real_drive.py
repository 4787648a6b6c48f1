"""Real streets, KITTI drives in the map of their own other blocks: where we are, that nothing changed, and what did."""

from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.evaluation.experiments.cases import choose_cases
from mapvote.evaluation.experiments.inject import Injection, score_injection
from mapvote.evaluation.experiments.real_drive import disturbed, run_real, split
from mapvote.formats import read_T_map_lidar

KITTI = Path(__file__).parents[3] / "../shared/data/kitti/2011_09_26_0001"
needs_kitti = pytest.mark.skipif(not KITTI.is_dir(), reason="the KITTI scans are not at ../shared/data (licence)")


def test_every_scan_is_mapped_or_voted_with_once() -> None:
    mapped, voting = split(50, 12)
    used = np.concatenate(
        [np.arange(50)[slice(*map(int, part.split(":")))] for text in (mapped, *voting) for part in text.split(",")]
    )
    assert sorted(used.tolist()) == list(range(50))
    with pytest.raises(MapvoteError, match="too few"):
        split(10, 12)


@needs_kitti
@pytest.mark.slow
@pytest.mark.parametrize("options", [{"change_prior": disturbed}, {"first_pose_only": True}, {"thin": True}])
def test_vehicles_find_themselves_within_10_cm_and_none_is_lost(options: dict[str, bool]) -> None:
    """Every third scan at 12 m/s is 4 m from the last: a motion not yet known must not settle one house too early."""
    cases, _ = choose_cases(Settings(), "1")
    run = run_real(KITTI, cases, Settings(), **options)  # type: ignore[arg-type]
    assert len(run.error_m) == run.scans == 24
    assert np.median(run.error_m) <= 0.10
    assert run.error_m.max() <= 0.30
    assert run.error_m.max() < run.prior_error_m.max()


@needs_kitti
@pytest.mark.slow
@pytest.mark.parametrize(("drive", "thin"), [("0001", False), ("0001", True), ("0005", False), ("0005", True)])
def test_hardly_anything_is_called_changed_where_nothing_changed(drive: str, thin: bool) -> None:
    """Movers apart .2 % of determined cells and a quarter of case 1's share at most, movers included 1 %."""
    cases, _ = choose_cases(Settings(), "1,columns")
    run = run_real(KITTI.with_name(f"2011_09_26_{drive}"), cases, Settings(), thin=thin)
    share = run.changed_share("columns", with_movers=False)
    assert share <= 0.002
    assert share <= 0.25 * run.changed_share("1", with_movers=False)
    assert run.changed_share("columns", with_movers=True) <= 0.01


@needs_kitti
@pytest.mark.slow
def test_what_was_injected_is_found() -> None:
    cases, _ = choose_cases(Settings(), "columns")
    injection = Injection(1, read_T_map_lidar(KITTI / "prior.txt", KITTI)[:, :2, 3])
    run = run_real(KITTI, cases, Settings(), edit=injection)
    for kind, precision in (("built", 0.75), ("demolished", 0.90)):
        score = score_injection(injection, run.states["columns"], kind, run.reached)
        assert score.objects == 10
        assert score.cell_recall >= 0.80
        assert score.found >= 9
        assert score.precision_near >= precision
