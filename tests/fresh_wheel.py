"""The program as it is packed for a registry, from a copy of what belongs in it."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]


def installed(folder: Path, wheel: Path) -> Path:
    """The ``bin`` of a new environment with the wheel, and with what it needs from the environment of the tests."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", str(wheel)]
    subprocess.run(command, check=True, timeout=300)
    # An environment added by a line of a .pth file brings its packages, but not the program that is being edited.
    own = sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)})
    (Path(own) / "beside.pth").write_text(sysconfig.get_path("purelib"))
    return folder / "bin"


def packed(folder: Path) -> Path:
    """The wheel, in ``folder``. Only what it is made of is copied: tests that run at the same time write caches into
    the rest of the repository, whose files come and go while one copies them."""
    source = folder / "source"
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(source)]
    subprocess.run(command, check=True, timeout=300)
    return next(folder.glob("*.whl"))
