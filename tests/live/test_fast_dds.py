"""The DDS of most ROS 2 installations: clouds of a Fast DDS writer, compiled here, are read by our reader."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from live.loopback_dds import until
from live.test_dds import cloud
from mapvote.core.sensors import SENSORS
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.live.dds import Network
from mapvote.live.messages import from_cdr

SOURCE = Path(__file__).with_name("fast_dds_talker.cpp")
SENT = 20


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("g++") is None or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("needs g++ and Fast DDS (Debian: libfastrtps-dev)")
    program = tmp_path_factory.mktemp("talker") / "talker"
    subprocess.run(["g++", "-O1", "-o", program, SOURCE, "-lfastrtps", "-lfastcdr"], check=True)
    return program


@pytest.mark.slow
@pytest.mark.parametrize("offered", ["reliable", "best_effort"])
def test_every_cloud_of_a_fast_dds_writer_is_the_scan_that_was_sent(
    talker: Path, offered: str, tmp_path: Path, domain: int
) -> None:
    pytest.importorskip("cyclonedds")
    file = tmp_path / "cloud"
    file.write_bytes(cloud(70_000))
    network = Network(domain)
    process = subprocess.Popen([talker, str(domain), file, str(SENT), offered])
    try:
        (one,) = until(network.published, "the writer was not found")
        assert (one.topic, one.kind, one.reliable) == ("/points", CLOUD, offered == "reliable")
        incoming, scans = network.subscribe("/points", CLOUD, reliable=one.reliable), []
        while process.poll() is None:
            network.wait(0.2)
            scans += [scan_from_point_cloud2(from_cdr(CLOUD, data), SENSORS["hdl32e"]) for _, data in incoming.take()]
    finally:
        process.kill()
        process.wait()
    assert len(scans) == SENT if offered == "reliable" else len(scans) > 0.8 * SENT
    assert {len(scan.points) for scan in scans} == {70_000}
