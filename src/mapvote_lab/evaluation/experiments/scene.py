"""One simulated scene and what was made of it, kept on disk: drives, first map, ballots.

Everything is cached by what it depends on: scenario, seed, settings and the program's own sources, so that a run
that was cut short goes on where it stopped and a changed program never meets an old result.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import mapvote
import mapvote_lab
from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.point_map import PointMap
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.types import F64, Drive
from mapvote.core.voxels import voxel_downsample
from mapvote.formats import open_drive, read_map, write_map
from mapvote.formats.atomic import whole_file
from mapvote.formats.drives.options import parse_scans
from mapvote.slam.build import build_map
from mapvote_lab.evaluation.experiments.conditions import Conditions, with_true_ground
from mapvote_lab.evaluation.scoring.scene_truth import Truth, read_truth
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.scenario import load_scenario

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, done, in all)."""

_DRIVES_FROM = ("simulation", "core/geometry.py", "core/grid.py", "core/sensors.py", "formats/drives/kitti.py")
"""What the bytes of drives and truth depend on; most work on the program leaves gigabytes of drives as they are."""
_MAP_FROM = ("core", "codec", "formats", "localisation", "perception", "detection", "slam")
BALLOTS_FROM = (
    *_MAP_FROM, "vehicle.py", "evaluation/experiments/passes.py",
    "evaluation/experiments/paper_readings.py",
)  # fmt: skip


@cache
def sources_digest(parts: tuple[str, ...]) -> str:
    """SHA-256 over the program text of some modules and packages of mapvote and of its laboratory."""
    roots = Path(mapvote.__file__).parent, Path(mapvote_lab.__file__).parent
    digest = hashlib.sha256()
    for part in parts:
        root = next((root for root in roots if (root / part).exists()), None)
        if root is None:
            raise FileNotFoundError(f"no such part of mapvote: {part}")
        for file in [root / part] if part.endswith(".py") else sorted((root / part).rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def key_of(*what: object) -> str:
    """12 hex digits naming everything that a cached result depends on."""
    return hashlib.sha256(json.dumps([str(w) for w in what]).encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Scene:
    """A scenario and a seed, simulated into a folder of the cache when first asked for."""

    scenario: str
    seed: int
    settings: Settings
    cache: Path
    overrides: Mapping[str, Any] = field(default_factory=dict)
    conditions: Conditions = field(default_factory=Conditions)
    """What the drives are put through besides; see there."""
    map_name: str = "map"
    """The folder in ``work`` of the map that is voted on: the first map, or one that was made of it."""

    @property
    def folder(self) -> Path:
        """Drives and truth."""
        text = load_scenario(self.scenario, self.overrides).model_dump_json()
        name, thinning = f"{Path(self.scenario).stem}-{self.seed}", inspect.getsource(voxel_downsample)
        return self.cache / f"{name}-{key_of(text, sources_digest(_DRIVES_FROM), GROUND_MARGIN_M, thinning)}"

    @property
    def work(self) -> Path:
        """What was made of the drives with these settings."""
        s, c = self.settings, self.conditions
        settings = [part.model_dump_json() for part in (s.ndt, s.moving, s.mapping)]
        key = key_of(sources_digest(_MAP_FROM), *settings, c.scans, c.true_poses, c.true_ground)
        return self.folder.with_name(f"{self.folder.name}-made") / key

    def simulate(self, progress: Progress | None = None) -> None:
        """Simulate the drives, unless the cache holds them."""
        if not self.folder.exists():
            told = (lambda done, total: progress("simulating", done, total)) if progress else None
            partial = self.folder.with_name(f".{self.folder.name}.{os.getpid()}")
            simulate(self.scenario, partial, self.seed, progress=told, overrides=self.overrides)
            os.replace(partial, self.folder) if not self.folder.exists() else shutil.rmtree(partial)

    def prepare(self, progress: Progress | None = None) -> None:
        """Simulate the drives and build the first map, unless the cache holds them."""
        self.simulate(progress)
        if not (self.work / "map").exists():
            told = (lambda done, total: progress("mapping", done, total)) if progress else None
            surveys = [self.drive(name) for name in self.drive_names("survey_")]
            point_map, report = build_map(surveys, self.settings, progress=told)
            for track in report.tracks:
                with whole_file(self.work / f"{track.vehicle}.npy") as partial, partial.open("wb") as file:
                    np.save(file, track.T_map_lidar)
            if self.conditions.true_ground:
                point_map = with_true_ground(point_map, self.scenario, self.seed, self.overrides)
            write_map(point_map, self.work / "map")
            give_back_free_pages()

    def drive_names(self, prefix: str) -> list[str]:
        """Drives of the surveys ("survey_") or of the voting vehicles ("v"), in order of their numbers."""
        names = [p.name for p in self.folder.iterdir() if p.name.startswith(prefix) and p.is_dir()]
        return sorted(names, key=lambda name: (len(name), name))

    def drive(self, name: str) -> Drive:
        """A drive with its own prior, or with its true poses for a prior."""
        c = self.conditions
        prior = str(self.folder / "truth" / name / "poses.txt") if c.true_poses else None
        drive = open_drive(self.folder / name, scans=c.scans, prior=prior)
        return replace(drive, prior_sigma_m=0.001, prior_sigma_deg=0.001) if c.true_poses else drive

    def true_poses(self, name: str) -> F64:
        """(n, 4, 4) where the drive's scans were really taken."""
        poses = self.truth.poses(name)
        return poses[parse_scans(self.conditions.scans, len(poses), name)]

    @property
    def truth(self) -> Truth:
        """See :mod:`mapvote_lab.evaluation.scoring.scene_truth`."""
        return read_truth(self.folder)

    @property
    def point_map(self) -> PointMap:
        """The map that is voted on."""
        return read_map(self.work / self.map_name)

    def survey_poses(self, name: str) -> F64:
        """(n, 4, 4) where the SLAM believes the survey vehicle was."""
        return np.asarray(np.load(self.work / f"{name}.npy"), dtype=np.float64)
