"""The central server's verbs (paper IV): update offline; serve, publish and their kin on a store."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import Config

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mapvote.core.grid import TileIndex
    from mapvote.core.types import U8
    from mapvote.fleet.fuse import Decision
    from mapvote.fleet.publish import Outcome
    from mapvote.fleet.store import Store

StoreName = Annotated[str, typer.Argument(metavar="STORE", help="SQLite file, or URL (postgresql+psycopg://...)")]
GateDrive = Annotated[Path | None, typer.Option(help="reference drive that must localise no worse in a new version")]


def register(app: typer.Typer) -> None:
    """Add the server's verbs to ``app``."""
    for verb in (update, serve, publish, rollback, log, unvote, upgrade, keys, vehicles, changes):
        app.command()(verb)


def update(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="map folder, PCD file or Autoware folder")],
    ballot_files: Annotated[list[Path], typer.Argument(metavar="BALLOT...", help="ballots of one round")],
    out: Annotated[Path | None, typer.Option(help="where the updated map goes")] = None,
    dry_run: Annotated[bool, typer.Option(help="decide and report, write no map")] = False,
    cells: Annotated[Path | None, typer.Option(help="also write the decided states to this .npz")] = None,
    min_votes: Annotated[
        int | None,
        typer.Option(
            min=1, help="vehicles that a change needs; default 1 for the paper's rule, else as in the settings"
        ),
    ] = None,
) -> None:
    """Fuse ballots offline and edit the map: add, delete, keep."""
    from mapvote.config import FuseSettings
    from mapvote.core.ballot import decode
    from mapvote.core.types import MapvoteError
    from mapvote.fleet.fuse import states_over
    from mapvote.fleet.update import update_map
    from mapvote.formats import read_map, write_map

    if out is None and not dry_run:
        raise MapvoteError("update: say where the updated map goes (--out MAP), or --dry-run to only look")
    ballots = []
    for file in ballot_files:
        try:
            ballots.append(decode(file.read_bytes()))
        except OSError as error:
            raise MapvoteError(f"{file}: cannot be read ({error.strerror})") from error
        except MapvoteError as error:
            raise MapvoteError(f"{file}: {error}") from error
    settings = FuseSettings()
    paper = bool(ballots) and ballots[0].method == "paper"
    settings = settings.model_copy(update={"min_votes": min_votes or (1 if paper else settings.min_votes)})
    before = read_map(map_path)
    after, decisions = update_map(before, ballots, settings)
    if cells is not None:
        states, grid = states_over(before.lattice, decisions)
        _write_cells(cells, states, grid.x0, grid.y0)
    if out is not None and not dry_run:
        write_map(after, out)
    _report(decisions, len({ballot.vehicle for ballot in ballots}), settings.min_votes, None if dry_run else out)


def _write_cells(path: Path, states: U8, x0: float, y0: float) -> None:
    """Decided states over the window of all ballots (DESIGN 6), written whole or not at all."""
    import numpy as np

    from mapvote.core.grid import CELL_SIZE
    from mapvote.formats.whole import whole_file

    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, states=states, x0=x0, y0=y0, cell_size=CELL_SIZE)


def _report(decisions: dict[TileIndex, Decision], vehicles: int, min_votes: int, out: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table

    from mapvote.core.types import CellState

    console = Console()
    table = Table("tile", "vehicles", "changed-occupied cells", "changed-empty cells", "points added", "points deleted")
    for index, d in decisions.items():
        occupied = int((d.states == CellState.CHANGED_OCCUPIED).sum())
        empty = int((d.states == CellState.CHANGED_EMPTY).sum())
        if occupied or empty:
            table.add_row(
                *(str(v) for v in (f"{index[0]},{index[1]}", d.vehicles, occupied, empty, d.added, d.deleted))
            )
    if table.row_count:
        console.print(table)
    added, deleted = sum(d.added for d in decisions.values()), sum(d.deleted for d in decisions.values())
    console.print(f"{vehicles} vehicles, {len(decisions)} tiles: {added} points added, {deleted} deleted")
    if vehicles < min_votes:
        console.print(f"A change needs {min_votes} vehicles and {vehicles} voted, so nothing can change: --min-votes 1")
    console.print(f"updated map: {out}" if out is not None else "dry run: no map written")


def serve(
    store: StoreName,
    map_path: Annotated[Path | None, typer.Option("--map", help="first map, if STORE is to be created")] = None,
    host: Annotated[str, typer.Option(help="address to listen on; beyond this machine only with keys")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one")] = 8080,
    gate: GateDrive = None,
    config: Config = None,
) -> None:
    """Serve a store to vehicles and operators until stopped."""
    from mapvote.config import load_settings
    from mapvote.fleet.serve import log_as_json, open_or_create, reference_gate
    from mapvote.fleet.serve import serve as run

    settings = load_settings(config)
    log_as_json()
    opened = open_or_create(store, map_path)
    try:
        judge = None if gate is None else reference_gate(gate, settings)
        run(opened, settings, host=host, port=port, gate=judge, ready=lambda url: print(f"serving {url}", flush=True))
    finally:
        opened.close()


def publish(
    store: StoreName,
    dry_run: Annotated[bool, typer.Option(help="only say what would change")] = False,
    override: Annotated[bool, typer.Option(help="publish in spite of the reasons to hold it")] = False,
    min_votes: Annotated[int | None, typer.Option(min=1, help="vehicles that a change needs")] = None,
    reason: Annotated[str, typer.Option(help="kept with the version")] = "",
    gate: GateDrive = None,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler to fuse on, e.g. tcp://host:8786")] = None,
    config: Config = None,
) -> None:
    """Fuse the ballots that stand and publish the next version."""
    from concurrent.futures import ThreadPoolExecutor

    from mapvote.config import load_settings
    from mapvote.fleet.publish import publish as publish_version
    from mapvote.fleet.serve import reference_gate

    settings = load_settings(config)
    policy = settings.fuse if min_votes is None else settings.fuse.model_copy(update={"min_votes": min_votes})
    judge = None if gate is None else reference_gate(gate, settings)
    with _opened(store) as opened, _cluster(cluster) if cluster else ThreadPoolExecutor(2) as executor:
        done = publish_version(
            opened, policy, reason=reason, dry_run=dry_run, override=override, gate=judge, executor=executor
        )
    _print_outcome(done, "published" if done.published else "dry run" if dry_run else "nothing changed")


def rollback(
    store: StoreName,
    to: Annotated[int, typer.Argument(help="the version that shall be the map again")],
    reason: Annotated[str, typer.Option(help="kept with the version")] = "",
) -> None:
    """Publish an older version again, and bar the votes that led away from it."""
    from mapvote.fleet.publish import rollback as roll_back

    with _opened(store) as opened:
        version = roll_back(opened, to, reason=reason)
    print(f"version {version.number} is version {to} again")


def log(
    store: StoreName,
    events: Annotated[int, typer.Option(min=0, help="also the last so many events")] = 0,
) -> None:
    """Versions of a store, and what happened in it."""
    from rich.console import Console
    from rich.table import Table

    from mapvote.fleet.explain import events as last_events

    with _opened(store) as opened:
        versions, happened = opened.versions(), last_events(opened, events) if events else []
    table = Table("version", "kind", "from", "when", "by", "reason")
    for v in versions:
        origin = v.target if v.target is not None else v.parent
        table.add_row(str(v.number), v.kind, str(origin or ""), _when(v.created_ns), v.published_by, v.reason)
    Console().print(table)
    for event in happened:
        print(f"{event['seq']} {_when(event['at_ns'])} {event['kind']} {event['actor']} {event['detail']}")


def unvote(
    store: StoreName,
    vehicle: Annotated[str | None, typer.Argument(help="whose votes go")] = None,
    everybody: Annotated[bool, typer.Option("--all", help="every vehicle's: begins a new round")] = False,
    drive: Annotated[str | None, typer.Option(help="only this drive; else all of them")] = None,
    replay: Annotated[bool, typer.Option(help="also take it out of what is published, in a new version")] = False,
    yes: Annotated[bool, typer.Option(help="with --replay: publish; else only show the difference")] = False,
) -> None:
    """Withdraw a vehicle's votes, from what is to come or (--replay) from every version."""
    from mapvote.core.types import MapvoteError
    from mapvote.fleet.intake import withdraw
    from mapvote.fleet.replay import replay as replay_without

    if (vehicle is None) != everybody:
        raise MapvoteError("unvote: say whose votes go: a VEHICLE, or --all")
    if replay and (vehicle is None or drive is not None):
        raise MapvoteError("unvote: --replay takes out one whole vehicle; leave out --drive and --all")
    with _opened(store) as opened:
        if not replay or vehicle is None:
            whose = vehicle or "all vehicles"
            print(f"{withdraw(opened, vehicle, drive, by='operator')} ballots of {whose} withdrawn")
            return
        done = replay_without(opened, vehicle, dry_run=not yes)
    _print_outcome(done, "published" if done.published else "only shown: --yes publishes it")


def upgrade(store: StoreName) -> None:
    """Bring a store that an older mapvote wrote to the schema of this one. Stop the server and make a backup first."""
    from mapvote.fleet.migrate import upgrade as upgrade_schema
    from mapvote.fleet.store import existing, url_of

    database = existing(url_of(store))
    try:
        before, after = upgrade_schema(database)
    finally:
        database.close()
    print(f"schema {after}: nothing to do" if before == after else f"schema {before} is now {after}")


def keys(
    store: StoreName,
    action: Annotated[str, typer.Argument(help="list, issue or revoke")] = "list",
    name: Annotated[str | None, typer.Argument(help="vehicle or operator")] = None,
    operator: Annotated[bool, typer.Option(help="issue an operator's key, not a vehicle's")] = False,
) -> None:
    """List, issue or revoke keys. A new key is printed once and kept nowhere."""
    from mapvote.core.types import MapvoteError
    from mapvote.fleet import keys as store_keys

    with _opened(store) as opened:
        if action == "list":
            for key in store_keys.listed(opened):
                state = "valid" if key.revoked_ns is None else f"revoked {_when(key.revoked_ns)}"
                print(f"{key.role} {key.name}: issued {_when(key.created_ns)}, {state}")
        elif action == "issue" and name is not None:
            print(store_keys.issue(opened, name, "operator" if operator else "vehicle"))
        elif action == "revoke" and name is not None:
            print(f"{store_keys.revoke(opened, name)} keys of {name} revoked")
        else:
            raise MapvoteError("keys: say list, issue NAME or revoke NAME")


def vehicles(store: StoreName, config: Config = None) -> None:
    """Which vehicles contradict the others far more than chance, and where."""
    from rich.console import Console
    from rich.table import Table

    from mapvote.config import load_settings
    from mapvote.fleet.explain import vehicle_standings

    settings = load_settings(config)
    with _opened(store) as opened:
        found = vehicle_standings(opened, settings.fuse)
    table = Table("vehicle", "verdict", "cells compared", "contradictions", "of the others", "p", "the largest")
    for s in found:
        places = "; ".join(f"{e.says} at {e.x:.1f}, {e.y:.1f} ({e.cells} cells)" for e in s.evidence[:3])
        table.add_row(
            s.vehicle, s.verdict, str(s.cells), str(s.objects), str(s.others_objects), f"{s.p_value:.2g}", places
        )
    Console().print(table)
    print(
        "Compared where others agree both before and after a vehicle passed; the first and the last cannot be judged."
    )


def changes(
    store: StoreName,
    old: Annotated[int, typer.Option("--from", help="version")] = 1,
    new: Annotated[int | None, typer.Option("--to", help="version; the newest by default")] = None,
    min_cells: Annotated[int, typer.Option(min=1, help="leave out smaller objects")] = 1,
    out: Annotated[Path | None, typer.Option(help="GeoJSON file; else printed")] = None,
) -> None:
    """What was built and demolished between two versions, as GeoJSON in map metres."""
    import json

    from mapvote.fleet.explain import changes_between
    from mapvote.formats.whole import whole_file

    with _opened(store) as opened:
        found = changes_between(opened, old, opened.current() if new is None else new, min_cells)
    text = json.dumps(found, indent=1)
    if out is None:
        print(text)
        return
    with whole_file(out) as part:
        part.write_text(text + "\n")
    print(f"{len(found['features'])} objects in {out}")


@contextmanager
def _opened(name: str) -> Iterator[Store]:
    from mapvote.fleet.store import Store, url_of

    store = Store.open(url_of(name))
    try:
        yield store
    finally:
        store.close()


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    from mapvote.core.types import MapvoteError

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


def _print_outcome(done: Outcome, what: str) -> None:
    from mapvote.fleet.store import names

    tiles = f" in tiles {names(done.tiles)}" if done.tiles else ""
    print(f"version {done.version} ({what}): {done.added} points added, {done.deleted} deleted{tiles}")
    for reason in done.held:
        print(f"hold: {reason}")


def _when(stamp_ns: int) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
