"""The operator's verbs: serve a store, publish from it, say what decides, go back, take votes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.looks import sound_map
from mapvote.cli.options import SERVER, Config, KeyFile, Reason, StoreName, StoreOrUrl
from mapvote.cli.remote import is_url, server_at
from mapvote.cli.store import opened_store, store_url, when, who
from mapvote.cli.terminal import waiting

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mapvote.server.store.publish import Outcome


def register(app: typer.Typer) -> None:
    """Add these verbs to ``app``."""
    for verb in (serve, publish, policy, rollback, unvote):
        app.command(rich_help_panel=SERVER)(verb)


def serve(
    store: StoreName,
    map_path: Annotated[Path | None, typer.Option("--map", metavar="MAP", help="first map of a new STORE")] = None,
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="where to listen")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="0: any free one")] = 8080,
    open_: Annotated[bool, typer.Option("--open", help="need no keys, on this machine, until one is issued")] = False,
    config: Config = None,
) -> None:
    """Serve a store to vehicles and operators until stopped. A new store's first operator key is shown once.

    mapvote serve fleet.db --map my_map
    """
    from mapvote.config import load_with_sources
    from mapvote.server.http.serve import log_as_json, open_or_create
    from mapvote.server.http.serve import serve as run
    from mapvote.server.store.keys import issue
    from mapvote.server.store.policy import Policy

    settings, sources = load_with_sources(config)
    first = Policy.of(settings) if config is not None or _of_policy(sources) else None
    with waiting(f"opening {store}"):
        opened, new = open_or_create(store_url(store), map_path, first, read=sound_map)
    try:
        if not new:
            _refuse_policy(sources)
        log_as_json()
        if new and not open_:
            print(
                f"key of the operator, shown this once: {issue(opened, 'operator', 'operator', by=who())}", flush=True
            )
        run(opened, settings, host=host, port=port, opened=open_, ready=_say_where)
    finally:
        opened.close()


def _of_policy(sources: Mapping[str, str]) -> list[str]:
    """Settings that a store takes as its policy when it is created, and never again."""
    return [name for name in sources if name.partition(".")[0] in ("fuse", "gate", "voting")]


def _refuse_policy(sources: Mapping[str, str]) -> None:
    from mapvote.core.types import MapvoteError

    for name in _of_policy(sources):
        mend = "leave the setting out; `mapvote policy STORE` shows and changes the policy"
        raise MapvoteError(f"{sources[name]}: {name} has no effect, because an existing store has its policy: {mend}")


def _say_where(url: str) -> None:
    print(f"serving {url}", flush=True)


def publish(
    store: StoreOrUrl,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say what would change")] = False,
    override: Annotated[bool, typer.Option("--override", help="publish in spite of the reasons to hold it")] = False,
    reason: Reason = "",
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler to fuse on, e.g. tcp://host:8786")
    ] = None,
    config: Config = None,
    key_file: KeyFile = None,
) -> None:
    """Fuse the ballots that stand and publish the next version; a server does it by itself, with its own cluster.

    mapvote publish fleet.db --dry-run
    """
    from concurrent.futures import ThreadPoolExecutor

    from mapvote.config import load_with_sources
    from mapvote.core.types import MapvoteError
    from mapvote.server.store.publish import preview
    from mapvote.server.store.publish import publish as publish_version
    from mapvote.server.views.localisation_gate import gate_by

    if is_url(store):
        if cluster or config:
            raise MapvoteError("publish: the server has its own --cluster and --config; leave these out")
        ask = {"dry_run": dry_run, "override": override, "reason": reason}
        with server_at(store, key_file) as server, waiting("deciding"):
            told = server.ask_json("POST", "/v1/publish", json=ask)
        added, deleted = told["points_added"], told["points_deleted"]
        _tell(
            told["version"], _what(told["published"], dry_run), added, deleted, "; ".join(told["tiles"]), told["held"]
        )
        return
    settings, sources = load_with_sources(config)
    _refuse_policy(sources)
    reference = gate_by(settings.ndt)
    workers = dask_cluster(cluster) if cluster else ThreadPoolExecutor(2)
    with opened_store(store) as opened, workers as executor, waiting("deciding"):
        if dry_run:
            done = preview(opened, gate=reference, executor=executor)
        else:
            done = publish_version(
                opened, by=who(), reason=reason, override=override, gate=reference, executor=executor
            )
    _print_outcome(done, _what(done.published, dry_run))


def _what(published: bool, dry_run: bool) -> str:
    return "published" if published else "dry run" if dry_run else "nothing changed"


def policy(
    store: StoreOrUrl,
    values: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="e.g. fuse.min_votes=3")] = None,
    reason: Reason = "",
    key_file: KeyFile = None,
) -> None:
    """Show what decides in a store (round, votes, gate), or change it. Holds at once, in a running server too.

    mapvote policy fleet.db fuse.min_votes=3 --reason "more vehicles now"
    """
    from mapvote.core.types import MapvoteError

    pairs = [value.partition("=") for value in values or ()]
    if any(not equals for _, equals, _ in pairs):
        raise MapvoteError("policy: give KEY=VALUE, e.g. fuse.min_votes=3; nothing at all shows the policy")
    wanted = {key: value for key, _, value in pairs}
    if is_url(store):
        with server_at(store, key_file) as server:
            ask = {"values": wanted, "reason": reason}
            told = server.ask_json("PATCH", "/v1/policy", json=ask) if pairs else server.ask_json("GET", "/v1/policy")
    else:
        with opened_store(store) as opened:
            if pairs:
                opened.change_policy(wanted, by=who(), reason=reason)
            told = opened.policy_changes()[-1].as_json()
    print(f"policy of {when(told['at_ns'])} by {told['by']}" + (f": {told['reason']}" if told["reason"] else ""))
    for section, entries in told["policy"].items():
        for key, value in entries.items():
            print(f"{section}.{key}={value}")


def rollback(
    store: StoreOrUrl,
    to: Annotated[int, typer.Argument(metavar="VERSION", help="the version that shall be the map again")],
    reason: Reason = "",
    key_file: KeyFile = None,
) -> None:
    """Publish an older version again, and bar the votes that led away from it.

    mapvote rollback fleet.db 1 --reason "the second was wrong"
    """
    from mapvote.server.store.publish import rollback as roll_back

    if is_url(store):
        with server_at(store, key_file) as server:
            number = server.ask_json("POST", "/v1/rollback", json={"to": to, "reason": reason})["version"]
    else:
        with opened_store(store) as opened:
            number = roll_back(opened, to, by=who(), reason=reason).number
    print(f"version {number} is version {to} again")


def unvote(
    store: StoreOrUrl,
    vehicle: Annotated[str | None, typer.Argument(metavar="[VEHICLE]", help="whose votes go")] = None,
    everybody: Annotated[bool, typer.Option("--all", help="every vehicle's: begins a new round")] = False,
    drive: Annotated[str | None, typer.Option(metavar="NAME", help="only this drive; else all of them")] = None,
    replay: Annotated[bool, typer.Option("--replay", help="also out of what is published, in a new version")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="with --replay: publish; else only show the difference")] = False,
    key_file: KeyFile = None,
) -> None:
    """Withdraw a vehicle's votes, from what is to come or (--replay) from every version.

    mapvote unvote fleet.db car_1
    """
    from mapvote.core.types import MapvoteError
    from mapvote.server.store.ballots import withdraw
    from mapvote.server.store.replay import replay as replay_without

    if (vehicle is None) != everybody:
        raise MapvoteError("unvote: say whose votes go: a VEHICLE, or --all")
    if replay and (vehicle is None or drive is not None):
        raise MapvoteError("unvote: --replay takes out one whole vehicle; leave out --drive and --all")
    if is_url(store):
        if vehicle is None or drive is None:
            raise MapvoteError(
                f"unvote: {store} withdraws one drive: name VEHICLE and --drive, or run this on the STORE"
            )
        with server_at(store, key_file) as server:
            count = server.ask_json("DELETE", f"/v1/ballots/{vehicle}/{drive}")["withdrawn"]
        print(f"{count} ballots of {vehicle} withdrawn")
        return
    with opened_store(store) as opened:
        if not replay or vehicle is None:
            whose = vehicle or "all vehicles"
            print(f"{withdraw(opened, vehicle, drive, by=who())} ballots of {whose} withdrawn")
            return
        with waiting("deciding anew"):
            done = replay_without(opened, vehicle, by=who(), dry_run=not yes)
    _print_outcome(done, "published" if done.published else "only shown: --yes publishes it")


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
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
    from mapvote.server.store.queries import names

    _tell(done.version, what, done.added, done.deleted, names(done.tiles), done.held)


def _tell(version: int, what: str, added: int, deleted: int, tiles: str, held: Sequence[str]) -> None:
    print(
        f"version {version} ({what}): {added} points added, {deleted} deleted" + (f" in tiles {tiles}" if tiles else "")
    )
    for reason in held:
        print(f"hold: {reason}")
