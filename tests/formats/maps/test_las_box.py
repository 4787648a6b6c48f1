"""A LAS file whose offset was lost: its header still says where its points belong."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mapvote.doctor.maps import examine_map
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import stream_las, write_las

pytest.importorskip("laspy")
OFFSETS = 155
"""Where the header's offsets of x, y and z stand."""


def _file(path: Path, *, lost: bool) -> Path:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, [80.0, 60.0, 6.0], (4000, 3)) + np.array([412_340.0, 5_423_980.0, 110.0])
    write_las(path, Cloud(points))
    if lost:
        data = bytearray(path.read_bytes())
        data[OFFSETS : OFFSETS + 24] = struct.pack("<3d", 0.0, 0.0, 0.0)
        path.write_bytes(data)
    return path


def test_a_lost_offset_is_named_with_what_would_mend_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lost = _file(tmp_path / "lost.las", lost=True)
    list(stream_las(lost))
    assert "the points lie beside the box of the file's header: +412" in caplog.text
    findings, _ = examine_map(lost)
    assert any("beside the box" in f.what and "offset lost" in f.mend for f in findings)


def test_a_sound_file_says_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sound = _file(tmp_path / "sound.las", lost=False)
    list(stream_las(sound))
    findings, _ = examine_map(sound)
    assert "beside" not in caplog.text
    assert not any("beside the box" in f.what for f in findings)
