"""A small fault is named where the drive surely shows it; a drive that shows too little says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core import geometry
from mapvote.core.geometry import inverses
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, Scan
from mapvote.doctor import Finding
from mapvote.doctor.drive_evidence import DriveEvidence, Road, Run
from mapvote.doctor.prior import measure_time
from mapvote.doctor.prior_fit import CANNOT_TELL, check_small, compare, fit_to_chain

ROAD = Road("+z", 1.8, 0.4, np.array([0.0, 0.0, 1.0]), 0.02)


def along(metres: float, curved: bool = False) -> F64:
    """Poses 0.7 m apart, straight on or in a bend."""
    step = geometry.from_xyz_rpy(0.7, 0, 0, yaw=0.02 if curved else 0.0)
    T = [geometry.from_xyz_rpy(3.0, -2.0, 1.8)]
    while len(T) < metres / 0.7:
        T.append(T[-1] @ step)
    return np.stack(T)


def straying(T: F64, sigma_m: float, seed: int = 1) -> F64:
    """Errors of a GNSS receiver: errors that last for ten seconds."""
    rng, memory, error = np.random.default_rng(seed), np.exp(-0.01), np.zeros(3)
    out = T.copy()
    for one in out:
        error = memory * error + np.sqrt(1 - memory**2) * rng.normal(0, sigma_m, 3)
        one[:3, 3] += error
    return out


def smaller(T: F64, factor: float) -> F64:
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def yawed(deg: float) -> F64:
    return geometry.from_xyz_rpy(0, 0, 0, yaw=np.radians(deg))


def run_of(T: F64, start: int, end: int, every: int = 3) -> Run:
    indices = np.arange(start, end, every)
    seen = np.array([geometry.inverse(T[start]) @ T[i] for i in indices])
    return Run(indices, seen, np.full(len(indices), 0.9))


def runs_of(T: F64) -> list[Run]:
    return [run_of(T, start, start + 31) for start in range(0, len(T) - 31, 31)]


def evidence(
    T: F64, sigma_m: float, runs: list[Run] | None = None, chain: Run | None = None, sigma_deg: float = 1.0
) -> DriveEvidence:
    """Evidence of a drive whose scans show the motion of poses T (n, 4, 4), a tenth of a second apart."""
    stamps_ns = np.arange(len(T)) * 100_000_000
    nothing = Scan(0, np.zeros((0, 3), np.float32))
    e = DriveEvidence(
        Drive(Path("d"), "v", "d", SENSORS["hdl32e"], stamps_ns, lambda i: nothing, None, sigma_m, sigma_deg)
    )
    known = {"runs": runs or runs_of(T), "chain": chain or run_of(T, 0, len(T)), "road_below": ROAD}
    vars(e).update(known, looks={"turns": np.zeros(1)})
    return e


def compared(prior: F64, T: F64, runs: list[Run] | None = None, sigma_m: float = 1.0) -> list[Finding]:
    """Findings on a prior (n, 4, 4), where scans would show the motion of T."""
    return compare(evidence(T, sigma_m, runs), prior)[0]


def found_in(T: F64, prior: F64, sigma_m: float = 0.3, chain: Run | None = None) -> list[Finding]:
    return list(check_small(evidence(T, sigma_m, chain=chain), prior, None))


@pytest.mark.parametrize("curved", [False, True])
def test_scale_and_heading_are_told_apart_within_their_errors(curved: bool) -> None:
    T = along(150.0, curved)
    turned = smaller(straying(T, 0.02), 0.97) @ yawed(3.0)
    whole = fit_to_chain(turned, run_of(T, 0, len(T)))
    assert whole is not None
    assert whole.scale.value == pytest.approx(0.97, abs=2 * whole.scale.sigma)
    assert whole.turn.value == pytest.approx(3.0, abs=2 * whole.turn.sigma)
    assert abs(whole.pitch.value) < 2 * whole.pitch.sigma
    mended = whole.turn.poses(whole.scale.poses(turned))
    again = fit_to_chain(mended, run_of(T, 0, len(T)))
    assert again is not None
    assert abs(again.turn.value) < 0.1
    assert again.scale.value == pytest.approx(1.0, abs=0.001)


def test_positions_four_per_cent_too_small_are_named_on_a_street_and_undecided_on_forty_metres() -> None:
    street, short = along(250.0), along(42.0)
    for seed in range(5):
        assert all(f.severity == "note" for f in found_in(street, straying(street, 0.3, seed)))
        named = found_in(street, smaller(straying(street, 0.3, seed), 0.96))
        assert any("differ in scale" in f.what for f in named if f.severity != "note"), named
        unsure = " ".join(f.what for f in found_in(short, smaller(straying(short, 0.6, seed), 0.96), 0.6))
        assert "that may be chance" in unsure or int(unsure.split("show from ")[1].split("%")[0]) > 4, unsure


def late_by(rows: int) -> tuple[F64, F64]:
    """(poses of a drive whose speed and heading change, its prior so many rows late)."""
    T = [np.eye(4)]
    for i in range(200):
        step_m, turn = 0.7 + 0.4 * np.sin(i / 8), 0.03 * np.sin(i / 15)
        T.append(T[-1] @ geometry.from_xyz_rpy(step_m, 0, 0, yaw=turn))
    return np.stack(T), np.stack([*T[:1] * rows, *T[:-rows]])


@pytest.mark.parametrize(("rows", "severity"), [(2, "warning"), (5, "error")])
def test_a_prior_that_is_late_is_named_with_its_seconds_where_speed_and_heading_change(
    rows: int, severity: str
) -> None:
    T, prior = late_by(rows)
    time = measure_time(prior, runs_of(T), np.arange(len(T)) * 100_000_000)
    (finding,) = check_small(evidence(T, 0.05), prior, time)
    assert (finding.severity, finding.what[:26]) == (severity, f"the prior is 0.{rows}0 s late (")
    alone = f"the prior is 0.{rows}0 s late (+-0.00): so 0.00 m remain"
    assert compared(prior, T, sigma_m=0.05)[0].what.startswith(alone)


def test_a_prior_that_is_a_tenth_of_a_second_late_is_not_reported() -> None:
    """Less than PriorCheck.least_time_s: priors err so much by themselves, although the scans show it."""
    T, prior = late_by(1)
    time = measure_time(prior, runs_of(T), np.arange(len(T)) * 100_000_000)
    assert time is not None
    assert time.value == pytest.approx(0.1, abs=0.01)
    assert not any("late" in finding.what for finding in check_small(evidence(T, 0.05), prior, time))


def test_readings_that_a_map_shall_decide_among_place_the_scans_differently() -> None:
    T = along(100.0, curved=True)
    prior = inverses(T)
    readings = compared(prior, T)[0].readings
    placed = [reading.poses(prior) for reading in readings]
    assert len(placed) > 0
    assert not any(np.allclose(a, b, atol=1e-6) for k, a in enumerate(placed) for b in placed[k + 1 :])


def test_a_straight_street_along_x_cannot_tell_a_mirrored_track_and_a_bend_can() -> None:
    for curved in (False, True):
        T = along(120.0, curved)
        mirrored = T * np.array([1.0, -1, 1, 1])[None, :, None]
        mirrored[:, :3, :3] = T[:, :3, :3]
        found = compared(mirrored, T)
        told = [f.what for f in found]
        assert curved or all(f.severity == "note" for f in found)
        if curved:
            assert told[0].startswith("the prior's track is mirrored (y negated): so 0.00 m remain"), told
        else:
            assert any(what.startswith(CANNOT_TELL) and "track is mirrored" in what for what in told), told


def test_on_a_straight_street_turned_scans_swapped_axes_and_turned_headings_are_named_together() -> None:
    T = along(120.0)
    for yaw_deg, name in ((90, "x and y of the scans are swapped"), (180, "in reverse order")):
        C = yawed(yaw_deg)
        turned = [Run(run.indices, C @ run.T_first_lidar @ geometry.inverse(C), run.fit) for run in runs_of(T)]
        (error,) = compared(T, T, turned)
        assert error.severity == "error"
        assert f"turned by {yaw_deg} deg about z" in error.what
        assert name in error.what
        assert "cannot decide which" in error.what


@pytest.mark.parametrize(
    ("scans_deg", "prior_deg", "name"),
    [
        (20, 0, "the scans are turned by 21.1 deg about z"),
        (0, 20, "the prior's headings are off by 20.0 deg"),
        (20, 15, "the prior's headings are off by 35.0 deg"),
    ],
)
def test_the_side_that_is_turned_scans_or_headings_is_named_and_the_prior_if_both_are(
    scans_deg: float, prior_deg: float, name: str
) -> None:
    T, (C, D) = along(150.0, curved=True), (yawed(deg) for deg in (scans_deg, prior_deg))
    runs = [Run(run.indices, C @ run.T_first_lidar @ geometry.inverse(C), run.fit) for run in runs_of(T)]
    (error,) = (f for f in compared(T @ D, T, runs) if f.severity == "error")
    assert error.what.startswith(name)


@pytest.mark.parametrize(
    ("share", "name"),
    [
        (0.3, "the prior fits the scans in 2 of 6 places only; it does not between scans 62 and 185"),
        (0.6, "between scans 155 and 185 the prior is 20.1 m off the scans' motion, elsewhere 0.0 m (2 of 6 places)"),
    ],
)
def test_a_prior_that_stands_still_for_the_rest_of_the_drive_is_named_with_its_scan(share: float, name: str) -> None:
    T = along(150.0, curved=True)
    held = np.minimum(np.arange(len(T)), int(share * len(T)))
    assert [f.what for f in compared(T[held], T) if f.severity == "error"] == [name]


def test_a_prior_that_scatters_by_more_than_it_states_is_told_so() -> None:
    T = along(150.0, curved=True)
    scattered = T.copy()
    scattered[:, :3, 3] += np.random.default_rng(1).normal(0.0, 0.2, (len(T), 3))
    for sigma_m, told in ((0.02, True), (0.5, False)):
        found = compare(evidence(T, sigma_m, sigma_deg=0.1), scattered)[0]
        assert any(f"prior_sigma_m says {sigma_m}" in f.what for f in found) == told, found


def test_two_faults_at_once_are_both_named_and_mended() -> None:
    T = along(150.0, curved=True)
    inverse, and_then = compared(inverses(smaller(T, 1.5)), T)
    assert inverse.what == "two faults at once: the prior holds inverse poses (T_lidar_map)"
    assert and_then.what.startswith(
        "and once that is mended: the prior's positions are 1.500 times (+-0.001) too large"
    )
    scaled, and_then = compared(smaller(T @ yawed(20), 1 / 0.3048), T)
    assert scaled.what.startswith("two faults at once: the prior's positions are 3.4")
    assert and_then.what.startswith("and once that is mended: the prior's headings are off by 20.3 deg")


def test_a_place_where_a_scan_does_not_fit_those_before_it_is_named() -> None:
    T = along(120.0)
    chain = run_of(T, 0, len(T))
    fit = np.where(np.arange(len(chain.fit)) == 20, 0.3, chain.fit)
    told = found_in(T, T, chain=Run(chain.indices, chain.T_first_lidar, fit))
    assert any("between scans 57 and 60" in f.what for f in told), told


@pytest.mark.parametrize(
    ("metres", "sigma_m"),
    [
        *((40.0, sigma_m) for sigma_m in (0.02, 0.3, 1.0, 3.0)),
        (250.0, 0.02),
        pytest.param(250.0, 3.0, marks=pytest.mark.slow),
    ],
)
def test_a_prior_that_errs_as_drive_toml_states_is_sound(metres: float, sigma_m: float) -> None:
    """Errors that last ten seconds; constant for five seconds, then others; growing; a tilt of a degree throughout."""
    T = along(metres, curved=True)
    for seed in range(2):
        jumping = T.copy()
        pieces = np.random.default_rng(seed).normal(0, sigma_m, (len(T) // 50 + 1, 3))
        jumping[:, :3, 3] += pieces[np.arange(len(T)) // 50]
        tilted = straying(T, sigma_m, seed) @ geometry.from_xyz_rpy(0, 0, 0, roll=0.015, pitch=-0.01)
        growing = T.copy()
        growing[:, :3, 3] += sigma_m * np.linspace(0.0, 1.5, len(T))[:, None] * [1.0, -0.5, 0.2]
        for prior in (straying(T, sigma_m, seed), jumping, growing, tilted):
            found = compared(prior, T, sigma_m=sigma_m)
            assert [f.what for f in found if f.severity == "error"] == []
            assert prior is jumping or [f.what for f in found if f.severity == "warning"] == []
