"""One simulated scene and what was made of it, kept on disk: drives, first map, ballots.

Everything is cached by what it depends on: scenario, seed, settings and the program's own sources, so that a run
that was cut short goes on where it stopped and a changed program never meets an old result.
"""

from __future__ import annotations

import hashlib
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
from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.types import F64, Drive, PointMap
from mapvote.evaluation.truth import Truth, read_truth
from mapvote.formats import open_drive, read_map, write_map
from mapvote.formats.whole import whole_file
from mapvote.mapping import build_map
from mapvote.simulation import simulate
from mapvote.simulation.scenario import load_scenario

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, done, in all)."""

_DRIVES_FROM = (
    "simulation", "core/geometry.py", "core/grid.py", "core/points.py", "core/sensors.py", "formats/kitti.py",
)  # fmt: skip
"""What the bytes of drives and truth depend on; most work on the program leaves gigabytes of drives as they are."""
_MAP_FROM = ("core", "formats", "perception", "mapping.py")
BALLOTS_FROM = (*_MAP_FROM, "vehicle.py")


def default_cache() -> Path:
    """$XDG_CACHE_HOME/mapvote, else ~/.cache/mapvote."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mapvote"


@cache
def sources_digest(parts: tuple[str, ...]) -> str:
    """SHA-256 over the program text of some modules and packages of mapvote."""
    root = Path(mapvote.__file__).parent
    files = [
        f for part in parts for f in ([root / part] if part.endswith(".py") else sorted((root / part).rglob("*.py")))
    ]
    digest = hashlib.sha256()
    for file in files:
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
    truth_poses: bool = False
    """Give survey and vehicles their true poses: what localisation costs is then left out."""

    @property
    def folder(self) -> Path:
        """Drives and truth."""
        text = load_scenario(self.scenario, self.overrides).model_dump_json()
        name = f"{Path(self.scenario).stem}-{self.seed}"
        return self.cache / f"{name}-{key_of(text, sources_digest(_DRIVES_FROM), GROUND_MARGIN_M)}"

    @property
    def work(self) -> Path:
        """What was made of the drives with these settings."""
        s = self.settings
        made_by = (
            sources_digest(_MAP_FROM),
            s.ndt.model_dump_json(),
            s.moving.model_dump_json(),
            s.mapping.model_dump_json(),
        )
        return self.folder / f"made-{'truth' if self.truth_poses else 'ndt'}-{key_of(*made_by)}"

    def prepare(self, progress: Progress | None = None) -> None:
        """Simulate the drives and build the first map, unless the cache holds them."""
        if not self.folder.exists():
            told = (lambda done, total: progress("simulating", done, total)) if progress else None
            partial = self.folder.with_name(f".{self.folder.name}.{os.getpid()}")
            simulate(self.scenario, partial, self.seed, progress=told, overrides=self.overrides)
            os.replace(partial, self.folder) if not self.folder.exists() else shutil.rmtree(partial)
        if not (self.work / "map").exists():
            told = (lambda done, total: progress("mapping", done, total)) if progress else None
            surveys = [self.drive(name) for name in self.drive_names("survey_")]
            point_map, report = build_map(surveys, self.settings, progress=told)
            for track in report.tracks:
                with whole_file(self.work / f"{track.vehicle}.npy") as partial, partial.open("wb") as file:
                    np.save(file, track.T_map_lidar)
            write_map(point_map, self.work / "map")

    def drive_names(self, prefix: str) -> list[str]:
        """Drives of the surveys ("survey_") or of the voting vehicles ("v"), in order of their numbers."""
        names = [p.name for p in self.folder.iterdir() if p.name.startswith(prefix) and p.is_dir()]
        return sorted(names, key=lambda name: (len(name), name))

    def drive(self, name: str) -> Drive:
        """A drive with its own prior, or with its true poses for a prior."""
        prior = str(self.folder / "truth" / name / "poses.txt") if self.truth_poses else None
        drive = open_drive(self.folder / name, prior=prior)
        return replace(drive, prior_sigma_m=0.001, prior_sigma_deg=0.001) if self.truth_poses else drive

    @property
    def truth(self) -> Truth:
        """See :mod:`mapvote.evaluation.truth`."""
        return read_truth(self.folder)

    @property
    def point_map(self) -> PointMap:
        """The first map."""
        return read_map(self.work / "map")

    def survey_poses(self, name: str) -> F64:
        """(n, 4, 4) where the SLAM believes the survey vehicle was."""
        return np.asarray(np.load(self.work / f"{name}.npy"), dtype=np.float64)
