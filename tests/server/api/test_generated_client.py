"""Integrators generate a client from the OpenAPI document: openapi-python-client's calls every operation."""

from __future__ import annotations

import base64
import json
import os
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx2
import pytest

from asked import LANELETS, POLICY, ballot, lived_in
from contract import ROOT
from hand_made import two_walls
from live_server import serving_here
from mapvote.codec.ballot import encode
from mapvote_server.store.keys import issue
from mapvote_server.store.store import Store
from stores import WALL

PROGRAMS = Path(os.environ.get("MAPVOTE_CONTRACT_PROGRAMS", ROOT / ".venv-contract/bin"))
"""The generator needs an older typer than our users have: it has an environment of its own."""
INSTALL = "python3 -m venv .venv-contract && .venv-contract/bin/pip install openapi-python-client"
CALLER = Path(__file__).with_name("call_every_operation.py")
CONFIG = """\
post_hooks: []
content_type_overrides:
  application/vnd.laszip+copc: application/octet-stream
  application/xml: application/octet-stream
"""
Call = tuple[str, dict[str, Any], Any]
"""(operation, arguments, body: JSON, or bytes as base64)."""


def calls(change: str, verdict: int, plane: str, ground: str, raw: bytes, vote: bytes) -> list[Call]:
    """Each operation once, in an order in which each succeeds."""
    tile = {"points": plane, "ground": ground, "level": 0}
    drive = {"vehicle": "a", "drive": "d3"}
    return [
        *((name, {}, None) for name in ("get_livez", "get_healthz", "get_readyz", "get_metrics", "get_info")),
        *((name, {}, None) for name in ("get_map", "get_policy", "get_overview", "listen")),
        ("get_version", {"number": 1}, None),
        ("get_cloud_file", {"number": 1}, None),
        ("get_stac_catalogue", {}, None),
        ("get_stac_item", {"number": 1, "same": 1}, None),
        ("list_versions", {"limit": 1, "offset": 1}, None),
        ("get_plane", {"digest": plane}, None),
        ("restore_plane", {"digest": plane}, base64.b64encode(raw).decode()),
        ("get_changed_clouds", {"from": 1, "to": 2}, None),
        ("get_cloud_level", tile, None),
        ("list_changes", {"from": 1, "bbox": "0,0,76.8,76.8"}, None),
        ("list_affected_lanelets", {"from": 1}, base64.b64encode(LANELETS.encode()).decode()),
        ("get_changes_page", {"from": 1}, None),
        ("explain_cell", {"x": 3.15, "y": 3.15}, None),
        ("get_evidence", {"row": 0, "col": 0}, None),
        ("list_coverage", {"limit": 1}, None),
        *((name, {}, None) for name in ("list_passes", "list_paths", "list_vehicles", "list_publishes", "list_keys")),
        ("get_log", {"events": 3}, None),
        *((name, {}, None) for name in ("check_store", "quarantine_damage", "list_clearable", "clear")),
        ("undo_review", {"seq": verdict}, None),
        *((name, {}, None) for name in ("get_desk", "get_pending_clouds")),
        ("review_change", {}, {"change": change, "verdict": "accepted"}),
        ("change_policy", {}, {"values": {"fuse.min_votes": 2}}),
        ("put_ballot", drive, base64.b64encode(vote).decode()),
        ("withdraw_ballot", drive, None),
        ("cancel_publish", {}, None),
        ("publish", {}, {"override": True}),
        ("roll_back", {}, {"to": 1}),
        ("replay", {}, {"vehicle": "a"}),
        ("withdraw_vehicle", {"vehicle": "b"}, None),
        ("withdraw_all", {"everybody": True}, None),
        ("issue_key", {}, {"name": "car", "role": "vehicle"}),
        ("rotate_key", {}, {"name": "car"}),
        ("revoke_keys", {}, {"name": "car"}),
    ]


@pytest.mark.slow
def test_a_client_generated_from_the_document_calls_every_operation(tmp_path: Path) -> None:
    generator = PROGRAMS / "openapi-python-client"
    if not generator.exists():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"the generator is not installed: {INSTALL}")
    with closing(Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls(), POLICY)) as store:
        hashes = lived_in(store).tiles()[0, 1]
        vote = encode(ballot(store, "a", "d3", WALL, (0, 1)))
        key = issue(store, "boss", "operator")
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url:
        with httpx2.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=60.0) as http:
            document = http.get("/openapi.json").json()
            change = http.get("/v1/desk").json()["pending"]["features"][0]["id"]
            verdict = http.post("/v1/desk/reviews", json={"change": change, "verdict": "held"}).json()["seq"]
            raw = http.get(f"/v1/tiles/{hashes.points}").content
        (tmp_path / "openapi.json").write_text(json.dumps(document))
        (tmp_path / "config.yaml").write_text(CONFIG)
        asked = ["--path", tmp_path / "openapi.json", "--config", tmp_path / "config.yaml", "--fail-on-warning"]
        made = [str(word) for word in (generator, "generate", *asked, "--output-path", tmp_path / "client")]
        subprocess.run(made, check=True, capture_output=True, text=True, timeout=60.0)
        operations = [one for methods in document["paths"].values() for one in methods.values()]
        groups = {one["operationId"]: {"map": "map_"}.get(one["tags"][0], one["tags"][0]) for one in operations}
        listed = calls(change, verdict, hashes.points, hashes.ground, raw, vote)
        assert {name for name, _, _ in listed} == groups.keys()
        given = json.dumps([[groups[name], name, arguments, body] for name, arguments, body in listed])
        command = [str(PROGRAMS / "python"), str(CALLER), str(tmp_path / "client"), url, key]
        done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0, done.stderr[-3000:]
    answers = json.loads(done.stdout)
    assert [name for name, _, _ in answers] == [name for name, _, _ in listed]
    statuses = {name: status for name, status, _ in answers if status not in (200, 201)}
    assert statuses == {"cancel_publish": 404}, "nothing is being published"
    kinds = {name: kind for name, _, kind in answers}
    assert (kinds["cancel_publish"], kinds["get_desk"], kinds["listen"]) == ("Problem", "DeskAnswer", "ReadTimeout")
    assert (kinds["publish"], kinds["put_ballot"], kinds["list_changes"]) == ("Published", "Receipt", "Changes")
