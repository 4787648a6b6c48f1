"""The operator's verbs: serve a store, publish, explain, roll back, withdraw votes, check, clear, issue keys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapvote.cli.door import all_changes, api_at, check_ending, is_url, sound_map
from mapvote.cli.options import Config, KeyFile, Panel, Reason, StoreOrUrl
from mapvote.cli.terminal import print_table, waiting
from mapvote.core.times import utc
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mapvote.client.connection import Connection


def register(app: typer.Typer) -> None:
    """Add the verbs of a server and its store."""
    verbs = (serve, publish, policy, log, explain, coverage, rollback, unvote, check, gc, keys)
    for verb in verbs:
        # Half of every local map is negative: -12.5 is a coordinate there, no option.
        negative = {"ignore_unknown_options": True} if verb is explain else None
        app.command(rich_help_panel=Panel.SERVER, context_settings=negative)(verb)


def serve(
    store: Annotated[
        str,
        typer.Argument(metavar="STORE", help="an SQLite file, a postgresql+psycopg:// URL, or - for $MAPVOTE_STORE"),
    ],
    map_path: Annotated[Path | None, typer.Option("--map", metavar="MAP", help="first map of a new STORE")] = None,
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="address to listen on")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="port to listen on; 0: any free one")] = 8080,
    open_: Annotated[
        bool, typer.Option("--open", help="need no key, on this machine only, until the first key is issued")
    ] = False,
    upgrade: Annotated[bool, typer.Option("--upgrade", help="only upgrade the schema of an older STORE")] = False,
    gate_drives: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder of the drives that the policy may name as gate.drive")
    ] = None,
    config: Config = None,
) -> None:
    """Serve a store to vehicles and operators until stopped. The first operator key of a new store is shown once.

    Only this verb needs the STORE itself; all others take the URL that it prints as well. Stop the server and make a
    backup before --upgrade.

        mapvote serve fleet.db --map my_map
    """
    from mapvote.config import load_with_sources
    from mapvote_server.api.serve import log_as_json, open_or_create
    from mapvote_server.api.serve import serve as run
    from mapvote_server.gate import gate_by
    from mapvote_server.store.keys import issue
    from mapvote_server.store.policy import Policy
    from mapvote_server.stores import store_url, who

    if upgrade:
        from mapvote_server.store.migrate import upgrade as upgrade_schema
        from mapvote_server.store.store import existing

        with closing(existing(store_url(store))) as database:
            before, after = upgrade_schema(database)
        print(f"schema {after}: nothing to do" if before == after else f"schema {before} is now {after}")
        return
    settings, sources = load_with_sources(config)
    first = Policy.of(settings) if config is not None or _of_policy(sources) else None
    with waiting(f"opening {store}"):
        opened, new = open_or_create(store_url(store), map_path, first, read=sound_map)
    with closing(opened):
        if not new:
            _refuse_policy(sources)
        log_as_json()
        if new and not open_:
            key = issue(opened, "operator", "operator", by=who())
            print(f"key of the operator, shown this once: {key}", flush=True)
        drives = str(gate_drives or settings.server.gate_drives)
        if drives and not Path(drives).is_dir():
            raise MapvoteError(f"{drives}: no folder of gate drives is there")
        gate = gate_by(settings.ndt, drives)

        def ready(url: str) -> None:
            print(f"serving {url}", flush=True)

        run(opened, settings, host=host, port=port, opened=open_, gate=gate, ready=ready)


def _of_policy(sources: Mapping[str, str]) -> list[str]:
    """Settings that become a store's policy when it is created, and have no effect later."""
    return [name for name in sources if name.partition(".")[0] in ("fuse", "gate", "voting")]


def _refuse_policy(sources: Mapping[str, str]) -> None:
    for name in _of_policy(sources):
        mend = "leave the setting out; `mapvote policy STORE` shows and changes the policy"
        raise MapvoteError(f"{sources[name]}: {name} has no effect, because an existing store has its policy: {mend}")


def publish(
    store: StoreOrUrl,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only report what would change")] = False,
    override: Annotated[bool, typer.Option("--override", help="publish even if the policy holds the version")] = False,
    reason: Reason = "",
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="address of a Dask scheduler that fuses, e.g. tcp://host:8786")
    ] = None,
    config: Config = None,
    key_file: KeyFile = None,
) -> None:
    """Fuse the standing ballots and publish the next version.

    Only a STORE takes --cluster and --config: a server fuses by its own.

    mapvote publish fleet.db --dry-run
    """
    from mapvote.config import load_with_sources

    settings = None
    if not is_url(store):
        settings, sources = load_with_sources(config)
        _refuse_policy(sources)
    elif cluster or config:
        raise MapvoteError("publish: the server has its own --cluster and --config; leave these out")
    ask = {"dry_run": dry_run, "override": override, "reason": reason}
    with (
        dask_cluster(cluster) if cluster else nullcontext() as executor,
        api_at(store, key_file, settings, executor) as server,
        waiting("deciding"),
    ):
        answer = server.ask_json("POST", "/v1/publish", json=ask)
    _print_outcome(answer, "dry run" if dry_run else "nothing changed")


def _print_outcome(answer: Mapping[str, Any], otherwise: str) -> None:
    outcome = "published" if answer["published"] else otherwise
    tiles = f" in tiles {'; '.join(answer['tiles'])}" if answer["tiles"] else ""
    changed = f"{answer['points_added']} points added, {answer['points_deleted']} deleted"
    print(f"version {answer['version']} ({outcome}): {changed}{tiles}")
    if answer["waits"]:
        print(answer["waits"])
    for doubt in answer["doubts"]:
        print(f"look: {doubt}")
    for reason in answer["held"]:
        print(f"hold: {reason}")


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """An executor on a Dask cluster. MapvoteError if Dask is not installed or no scheduler answers."""
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise MapvoteError("--cluster needs Dask: pip install 'mapvote[dask]'") from error
    try:
        client = Client(address, timeout="10s")
    except OSError as error:
        raise MapvoteError(f"--cluster {address}: no Dask scheduler answers there") from error
    with client:
        yield client.get_executor(pure=False)


def policy(
    store: StoreOrUrl,
    values: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="e.g. fuse.min_votes=3")] = None,
    reason: Reason = "",
    key_file: KeyFile = None,
) -> None:
    """Show or change the policy of a store: its round, quorum, limits and gate. A change takes effect at once.

    mapvote policy fleet.db fuse.min_votes=3 --reason "more vehicles now"
    """
    pairs = [value.partition("=") for value in values or ()]
    if any(not equals for _, equals, _ in pairs):
        raise MapvoteError("policy: give KEY=VALUE, e.g. fuse.min_votes=3; without values the policy is shown")
    ask = {"values": {key: value for key, _, value in pairs}, "reason": reason}
    with api_at(store, key_file) as server:
        answer = server.ask_json("PATCH", "/v1/policy", json=ask) if pairs else server.ask_json("GET", "/v1/policy")
    print(f"policy of {utc(answer['at_ns'])} by {answer['by']}" + (f": {answer['reason']}" if answer["reason"] else ""))
    for section, entries in answer["policy"].items():
        for key, value in entries.items():
            print(f"{section}.{key}={value}")


def log(
    store: StoreOrUrl,
    events: Annotated[int, typer.Option(min=0, metavar="N", help="also list the last N events")] = 0,
    old: Annotated[
        int | None, typer.Option("--from", metavar="VERSION", help="list the changes since this version")
    ] = None,
    new: Annotated[
        int | None,
        typer.Option("--to", metavar="VERSION", help="list the changes up to this version; default: the newest"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write the changes to a file: .geojson, or .gpkg (GeoPackage)")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="write one page with the largest changes in 3D"),
    ] = None,
    metres: Annotated[
        bool, typer.Option("--metres", help="write map metres instead of longitude and latitude")
    ] = False,
    geojson: Annotated[bool, typer.Option("--geojson", help="print the changes as GeoJSON instead of a table")] = False,
    key_file: KeyFile = None,
) -> None:
    """List the versions of a store, or what was built and demolished between two of them.

    With --from or --to: a table of the changes, the largest first. --out writes them as GeoJSON in longitude and
    latitude, or as a GeoPackage in the map's own coordinate system. A map in local metres gives metres.

        mapvote log fleet.db --events 20

        mapvote log fleet.db --from 1 --out changes.geojson
    """
    check_ending(out, "--out", ".geojson", ".json", ".gpkg")
    check_ending(page, "--html", ".html", ".htm")
    if (old, new, out, page) == (None, None, None, None) and not geojson:
        with api_at(store, key_file) as server:
            _print_versions(server.ask_json("GET", f"/v1/log?events={events}"))
        return
    import json

    from mapvote.formats.atomic import write_whole

    local = metres or (out is not None and out.suffix.lower() == ".gpkg")
    query = f"from={old or 1}" + ("" if new is None else f"&to={new}")
    with api_at(store, key_file) as server, waiting("comparing versions"):
        changes = all_changes(server, f"{query}&lonlat={str(not local).lower()}")
        text = server.ask("GET", f"/v1/changes/page?{query}").text if page is not None else ""
    if page is not None:
        write_whole(page, text)
        print(f"the largest of {len(changes['features'])} changes in {page}")
    _tell_damaged(changes)
    if out is not None:
        _write_changes(changes, out)
    elif geojson:
        print(json.dumps(changes, indent=1))
    elif page is None:
        _print_changes(changes)


def _print_versions(answer: Mapping[str, Any]) -> None:
    rows = []
    for v in answer["versions"]:
        origin = v["target"] if v["target"] is not None else v["parent"]
        made = v["kind"], str(origin or ""), utc(v["created_ns"]), v["published_by"], v["reason"]
        rows.append((str(v["number"]), *made))
    print_table(("version", "kind", "from", "when", "by", "reason"), rows)
    for event in answer["events"]:
        print(f"{event['seq']} {utc(event['at_ns'])} {event['kind']} {event['actor']} {event['detail']}")


_MOST_CHANGES = 40


def _print_changes(changes: Mapping[str, Any]) -> None:
    """The changes as a table, the largest first."""
    rows = []
    largest_first = sorted(changes["features"], key=lambda feature: -feature["properties"]["area_m2"])
    for feature in largest_first[:_MOST_CHANGES]:
        about = feature["properties"]
        (x0, y0), (x1, y1) = about["box"]
        votes = f"{about['votes_min']}" if about["versions"] else "none: taken back"
        sizes = f"{about['area_m2']:.1f}", f"{about['height_m']:.1f}", str(about["points"])
        rows.append((about["kind"], f"{0.5 * (x0 + x1):.1f}", f"{0.5 * (y0 + y1):.1f}", *sizes, votes))
    versions = f"from version {changes['from_version']} to {changes['to_version']}"
    if not rows:
        print(f"nothing changed {versions}")
        return
    print_table(("change", "x (m)", "y (m)", "m2", "m high", "points", "votes at least"), rows)
    if len(changes["features"]) > _MOST_CHANGES:
        print(f"and {len(changes['features']) - _MOST_CHANGES} smaller ones; --out FILE writes all of them")
    print(f"{len(changes['features'])} changes {versions}")
    if not all(feature["properties"]["versions"] for feature in changes["features"]):
        print("taken back: no vehicle voted for it, a rollback or a replay took an earlier decision back")


def _tell_damaged(answer: Mapping[str, Any]) -> None:
    if answer.get("damaged"):
        left_out = "; ".join(answer["damaged"])
        typer.echo(f"left out: tiles {left_out} are damaged (see mapvote check)", err=True)


def _write_changes(changes: dict[str, Any], out: Path) -> None:
    import json

    from mapvote.formats.atomic import write_whole
    from mapvote.formats.geo.frame import frame_of
    from mapvote.formats.geo.geopackage import write_geopackage

    if out.suffix.lower() == ".gpkg":
        write_geopackage(out, changes["features"], frame_of(changes["georeference"]))
    else:
        write_whole(out, json.dumps(changes, indent=1) + "\n")
    print(f"{len(changes['features'])} objects in {out}")


def explain(
    store: StoreOrUrl,
    x: Annotated[float, typer.Argument(metavar="X", help="map metres")],
    y: Annotated[float, typer.Argument(metavar="Y", help="map metres")],
    key_file: KeyFile = None,
) -> None:
    """Explain a cell of the map: every vote on it, and which version counted the vote or why none did.

    mapvote explain fleet.db 12.5 -3.0
    """
    with api_at(store, key_file) as server:
        answer = server.ask_json("GET", f"/v1/cells?x={x}&y={y}")
    print(f"cell {answer['row']}, {answer['col']}: {answer['thing'] or 'empty'}")
    for decision in answer["decisions"]:
        edit = decision.get("edit")
        trimmed = ""
        if edit is not None:
            went = "deleted" if edit["state"] == "changed_empty" else "added"
            trimmed = f"; points {went} by {edit['votes']} of {edit['votes'] + edit['against']} vehicles"
        fell = f"; {decision['fell']}" if decision.get("fell") else ""
        print(f"version {decision['version']} decided {decision['state']}{trimmed}{fell}")
    if answer.get("probability") is not None:
        print(f"probability that the last decision is right: {answer['probability']:.2f}")
    for v in answer["votes"]:
        sure = "" if v.get("sure") is None else f", {100 * v['sure']:.0f} % sure"
        ended = v["end"][:19].replace("T", " ") + "Z"
        counted = ", ".join(str(number) for number in v["counted_in"])
        before = f"counted in version {counted}" if counted else "counted in no version"
        counts_text = "counts now" if v["counts"] else f"does not count now: {v['why']}"
        gone = f", {v['marks']} of its voxels gone" if v["marks"] and v["state"] == "unchanged_occupied" else ""
        print(
            f"{v['vehicle']}: {v['state']}{gone}{sure}. Drive {v['drive']} ended {ended}, with version {v['version']}"
        )
        print(f"    {before}; {counts_text}")
    if answer["unlisted"]:
        print(f"{answer['unlisted']} older votes on the tile do not count and are not listed")


_MOST_STRETCHES = 20


def coverage(
    store: StoreOrUrl,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="also write all stretches of road as GeoJSON")
    ] = None,
    key_file: KeyFile = None,
) -> None:
    """List the roads where one more pass would decide cells, by tile and direction, most cells first.

    A cell counts if one more vehicle with the same vote as an earlier one would decide it.

    mapvote coverage fleet.db --out drive_next.geojson
    """
    import json

    from mapvote.formats.atomic import write_whole

    check_ending(out, "--out", ".geojson", ".json")
    with api_at(store, key_file) as server:
        passes = server.ask_json("GET", "/v1/coverage/passes")
    rows = []
    for feature in passes["features"][:_MOST_STRETCHES]:
        about = feature["properties"]
        line = feature["geometry"]["coordinates"]
        ends = [f"({x:.0f}, {y:.0f})" for x, y in (line[0], line[-1])]
        counts = (str(about[name]) for name in ("cells", "built", "gone"))
        rows.append((f"{about['row']},{about['col']}", f"{about['heading_deg']}°", *ends, *counts))
    if rows:
        print_table(("tile", "heading", "from (x, y), m", "to", "cells", "built", "gone"), rows, "One more pass")
    elif not passes["cells"]:
        print("no cell waits for one more pass")
    if passes["without_path"]:
        print(
            f"{passes['without_path']} of {passes['cells']} cells that wait: their ballots do not say where they drove"
        )
    if passes["waits"]:
        print(passes["waits"])
    if passes["damaged"]:
        typer.echo(f"left out: tiles {'; '.join(passes['damaged'])} are damaged (see mapvote check)", err=True)
    if out is not None:
        write_whole(out, json.dumps(passes) + "\n")
        print(f"{out}: {len(passes['features'])} stretches of road")


def rollback(
    store: StoreOrUrl,
    to: Annotated[int, typer.Argument(metavar="VERSION", help="the version to return to")],
    reason: Reason = "",
    key_file: KeyFile = None,
) -> None:
    """Publish an older version again. Votes that changed it since then do not count any more.

    mapvote rollback fleet.db 1 --reason "the second was wrong"
    """
    with api_at(store, key_file) as server:
        number = server.ask_json("POST", "/v1/rollback", json={"to": to, "reason": reason})["version"]
    print(f"version {number} is version {to} again")


def unvote(
    store: StoreOrUrl,
    vehicle: Annotated[
        str | None, typer.Argument(metavar="VEHICLE", help="the vehicle whose votes are withdrawn")
    ] = None,
    everybody: Annotated[
        bool, typer.Option("--all", help="withdraw the votes of all vehicles, to begin a new round")
    ] = False,
    drive: Annotated[str | None, typer.Option(metavar="NAME", help="only this drive; default: all drives")] = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="also remove the votes from published versions, in a new version")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="with --replay: publish; without it only show the difference")
    ] = False,
    key_file: KeyFile = None,
) -> None:
    """Withdraw a vehicle's votes from later versions or, with --replay, from every version.

    mapvote unvote fleet.db car_1
    """
    from urllib.parse import quote

    if (vehicle is None) != everybody:
        raise MapvoteError("unvote: name one VEHICLE, or give --all")
    if drive is not None and everybody:
        raise MapvoteError("unvote: --drive is of one VEHICLE; leave out --all")
    if replay and (everybody or drive is not None):
        raise MapvoteError("unvote: --replay removes one whole vehicle; leave out --drive and --all")
    with api_at(store, key_file) as server, waiting("deciding anew" if replay else "withdrawing"):
        if replay:
            done = server.ask_json("POST", "/v1/replay", json={"vehicle": vehicle, "dry_run": not yes})
        else:
            whose = "/".join(quote(name, safe="") for name in (vehicle, drive) if name is not None)
            path = "/v1/ballots?everybody=true" if everybody else f"/v1/ballots/{whose}"
            done = server.ask_json("DELETE", path)
    if replay:
        _print_outcome(done, "only shown: --yes publishes it")
    else:
        print(f"{done['withdrawn']} ballots of {vehicle or 'all vehicles'} withdrawn")


def check(
    store: StoreOrUrl,
    mend: Annotated[bool, typer.Option("--mend", help="quarantine damaged parts; with --from replace them")] = False,
    other: Annotated[
        str | None, typer.Option("--from", metavar="STORE|URL", help="a store with sound copies, e.g. a backup")
    ] = None,
    key_file: KeyFile = None,
) -> None:
    """Read every byte of a store and compare it with its checksum. Exit code 1 if something is damaged.

    mapvote check fleet.db --mend --from backup.db
    """
    if other is not None and not mend:
        raise MapvoteError("check: --from replaces damaged parts: give --mend too")
    with api_at(store, key_file) as server, waiting("reading every byte"):
        if other is not None:
            planes = {d["name"] for d in server.ask_json("GET", "/v1/check")["damage"] if d["kind"] == "plane"}
            with api_at(other, key_file) as backup:
                restored = [digest for digest in sorted(planes) if _restored(server, backup, digest)]
            for digest in restored:
                print(f"plane {digest}: mended from {other}")
        damages = server.ask_json("POST" if mend else "GET", "/v1/check")["damage"]
    for damage in damages:
        done = f"; {damage['mended']}" if damage["mended"] else ""
        print(f"{damage['kind']} {damage['name']}: {damage['why']}{done}")
    if damages:
        raise MapvoteError(f"{store}: {len(damages)} things are damaged" + ("" if mend else "; --mend sets them aside"))
    print("every plane, ballot and version is what it was when it was written")


def _restored(server: Connection, backup: Connection, digest: str) -> bool:
    """Put a plane back if the backup has it as it was written."""
    from mapvote.client.connection import Refused

    try:
        plane = backup.ask("GET", f"/v1/tiles/{digest}").content
        return bool(server.ask("PUT", f"/v1/tiles/{digest}", content=plane).json()["restored"])
    except Refused as error:  # 404: the backup lacks it; 422: it is damaged there too
        if error.status not in (404, 422):
            raise
        return False


def gc(
    store: StoreOrUrl,
    yes: Annotated[bool, typer.Option("--yes", help="delete; without it only list what would be deleted")] = False,
    key_file: KeyFile = None,
) -> None:
    """Delete what the policy does not keep: old versions (keep.versions) and ballots that can decide nothing more.

    mapvote gc fleet.db
    """
    with api_at(store, key_file) as server, waiting("looking for what can go"):
        done = server.ask_json("POST" if yes else "GET", "/v1/gc")
    counts = f"{done['versions']} versions ({done['planes']} planes, {done['decisions']} decisions)"
    size = f"{done['ballots']} ballots on tiles, {done['size']:,} bytes"
    print(f"{counts} and {size}" + ("" if yes else ": --yes clears them"))
    print(f"the oldest version left is {done['oldest']}")


def keys(
    store: StoreOrUrl,
    action: Annotated[str, typer.Argument(metavar="ACTION", help="list, issue, rotate or revoke")] = "list",
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="name of a vehicle or a person")] = None,
    role: Annotated[str, typer.Option(metavar="ROLE", help="vehicle, reader, reviewer or operator")] = "vehicle",
    days: Annotated[float | None, typer.Option(metavar="N", help="the key expires after N days")] = None,
    overlap_days: Annotated[
        float, typer.Option(min=0, metavar="N", help="rotate: the old keys work for N more days")
    ] = 1.0,
    keep_votes: Annotated[
        bool | None,
        typer.Option(
            "--keep-votes/--end-votes",
            help="revoke: whether standing ballots still count [default: ask on a terminal, else they do not]",
        ),
    ] = None,
    key_file: KeyFile = None,
) -> None:
    """List, issue, rotate or revoke keys. A new key is printed once and stored only as a hash.

    mapvote keys fleet.db issue car_1
    """
    if action not in ("list", "issue", "rotate", "revoke") or (action != "list" and name is None):
        raise MapvoteError("keys: give list, issue NAME, rotate NAME or revoke NAME")
    with api_at(store, key_file) as server:
        if action == "list":
            rows = [
                (key["role"], key["name"], utc(key["created_ns"]), _state(key))
                for key in server.ask_json("GET", "/v1/keys")["keys"]
            ]
            print_table(("role", "name", "issued", "state"), rows)
        elif action == "issue":
            valid = sum(key["name"] == name and key["valid"] for key in server.ask_json("GET", "/v1/keys")["keys"])
            ask = {"name": name, "role": role, "days": days}
            print(server.ask_json("POST", "/v1/keys", json=ask)["key"])
            if valid:
                typer.echo(
                    f"{name} had {valid} valid {'key' if valid == 1 else 'keys'} before, and all of them stay valid: "
                    "rotate replaces the old ones, revoke ends all",
                    err=True,
                )
        elif action == "rotate":
            ask = {"name": name, "overlap_days": overlap_days}
            print(server.ask_json("POST", "/v1/keys/rotate", json=ask)["key"])
        else:
            keep = _ask_to_keep(server, name) if keep_votes is None else keep_votes
            done = server.ask_json("POST", "/v1/keys/revoke", json={"name": name, "keep_votes": keep})
            ended = f", {done['ballots']} ballots do not count any more" if done["ballots"] else ""
            print(f"{done['revoked']} keys of {name} revoked{ended}")


def _ask_to_keep(server: Connection, name: str | None) -> bool:
    """Whether the ballots of a revoked name still count: ask on a terminal, else no."""
    import sys

    if not sys.stdin.isatty():
        return False
    listed = server.ask_json("GET", "/v1/keys")["keys"]
    standing = next((key["ballots"] for key in listed if key["name"] == name), 0)
    question = f"{standing} ballots of {name} stand. Shall they still count?"
    return bool(standing) and typer.confirm(question, default=False)


def _state(key: Mapping[str, Any]) -> str:
    if key["revoked_ns"] is not None:
        return f"revoked {utc(key['revoked_ns'])}"
    if key["expires_ns"] is None:
        return "valid"
    return f"{'valid until' if key['valid'] else 'ended'} {utc(key['expires_ns'])}"
