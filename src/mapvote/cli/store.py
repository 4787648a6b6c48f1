"""Verbs that keep a store whole and closed: check it, bring it up to date, say who has keys; and how verbs open one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Annotated, cast

import typer

from mapvote.cli.options import SERVER, KeyFile, StoreName, StoreOrUrl
from mapvote.cli.terminal import waiting

if TYPE_CHECKING:
    from mapvote.server.store.integrity import Damage
    from mapvote.server.store.keys import Key, Role
    from mapvote.server.store.store import Store


def register(app: typer.Typer) -> None:
    """Add these verbs to ``app``."""
    for verb in (check, gc, upgrade, keys):
        app.command(rich_help_panel=SERVER)(verb)


def check(
    store: StoreOrUrl,
    mend: Annotated[bool, typer.Option("--mend", help="set aside what is damaged, mend what --from has")] = False,
    other: Annotated[str | None, typer.Option("--from", metavar="STORE", help="e.g. a backup of this store")] = None,
    key_file: KeyFile = None,
) -> None:
    """Is every plane, ballot and version what it was when it was written? Exit code 1 if something is damaged.

    mapvote check fleet.db --mend --from backup.db
    """
    from mapvote.cli.remote import is_url, server_at
    from mapvote.core.types import MapvoteError
    from mapvote.server.store.integrity import Damage

    if is_url(store):
        if other:
            raise MapvoteError("check: --from takes a STORE, on the machine where it is")
        with server_at(store, key_file) as server, waiting("the server reads every byte"):
            told = server.ask_json("POST" if mend else "GET", "/v1/check")
        found = [Damage(**damage) for damage in told["damage"]]
    else:
        found = _checked(store, mend, other)
    for damage in found:
        print(damage)
    if found:
        raise MapvoteError(f"{store}: {len(found)} things are damaged" + ("" if mend else "; --mend sets them aside"))
    print("every plane, ballot and version is what it was when it was written")


def _checked(store: str, mend: bool, other: str | None) -> list[Damage]:
    from mapvote.codec.arrays import unpack_bytes
    from mapvote.core.types import MapvoteError
    from mapvote.server.store.integrity import check as look
    from mapvote.server.store.planes import MAX_PLANE_BYTES

    def elsewhere(digest: str) -> bytes | None:
        if backup is None:
            return None
        try:
            return unpack_bytes(backup.blob(digest), MAX_PLANE_BYTES, f"tile plane {digest[:12]}")
        except MapvoteError:
            return None

    second = opened_store(other) if other else nullcontext()
    with opened_store(store) as opened, second as backup, waiting("reading every byte"):
        return look(opened, mend=mend, source=elsewhere, by=who())


def gc(
    store: StoreName,
    yes: Annotated[bool, typer.Option("--yes", help="clear it away; else only say what would go")] = False,
) -> None:
    """Clear away what the policy does not keep: old versions (keep.versions) and ballots that can decide nothing more.

    mapvote gc fleet.db
    """
    from mapvote.server.store.retention import clear

    with opened_store(store) as opened, waiting("looking for what can go"):
        done = clear(opened, by=who(), dry_run=not yes)
    counts = f"{done.versions} versions ({done.planes} planes, {done.decisions} decisions)"
    print(f"{counts} and {done.ballots} ballots on tiles, {done.size:,} bytes" + ("" if yes else ": --yes clears them"))
    print(f"the oldest version left is {done.oldest}")


def upgrade(store: StoreName) -> None:
    """Bring a store that an older mapvote wrote to the schema of this one. Stop the server and make a backup first.

    mapvote upgrade fleet.db
    """
    from mapvote.server.store.migrate import upgrade as upgrade_schema
    from mapvote.server.store.store import existing

    database = existing(store_url(store))
    try:
        before, after = upgrade_schema(database)
    finally:
        database.close()
    print(f"schema {after}: nothing to do" if before == after else f"schema {before} is now {after}")


def keys(
    store: StoreName,
    action: Annotated[str, typer.Argument(metavar="[ACTION]", help="list, issue, rotate or revoke")] = "list",
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="of a vehicle or a person")] = None,
    role: Annotated[str, typer.Option(help="vehicle, reader, reviewer or operator")] = "vehicle",
    operator: Annotated[bool, typer.Option("--operator", help="the same as --role operator")] = False,
    days: Annotated[float | None, typer.Option(help="the key ends by itself after so many days")] = None,
    overlap_days: Annotated[float, typer.Option(min=0, help="rotate: how long the old keys still work")] = 1.0,
    keep_votes: Annotated[
        bool | None,
        typer.Option(
            "--keep-votes/--end-votes",
            help="revoke: standing ballots go on counting, or not; a terminal is asked, else they do not",
        ),
    ] = None,
) -> None:
    """List, issue, rotate or revoke keys. A new key is printed once and kept nowhere.

    mapvote keys fleet.db issue car_1
    """
    from mapvote.core.types import MapvoteError
    from mapvote.server.store import keys as store_keys

    with opened_store(store) as opened:
        if action == "list":
            for key in store_keys.listed(opened):
                print(f"{key.role} {key.name}: issued {when(key.created_ns)}, {_state(key, opened.clock())}")
        elif action == "issue" and name is not None:
            print(store_keys.issue(opened, name, cast("Role", "operator" if operator else role), by=who(), days=days))
        elif action == "rotate" and name is not None:
            print(store_keys.rotate(opened, name, by=who(), overlap_days=overlap_days))
        elif action == "revoke" and name is not None:
            keep = _keep_votes(store_keys.ballots_standing(opened, name), name) if keep_votes is None else keep_votes
            revoked, ended = store_keys.revoke(opened, name, by=who(), keep_votes=keep)
            print(f"{revoked} keys of {name} revoked" + (f", {ended} ballots count no more" if ended else ""))
        else:
            raise MapvoteError("keys: say list, issue NAME, rotate NAME or revoke NAME")


def _keep_votes(standing: int, name: str) -> bool:
    """What becomes of the ballots of a name that is revoked, by whoever sits there."""
    import sys

    if not standing or not sys.stdin.isatty():
        return False
    return typer.confirm(f"{standing} ballots of {name} stand. Shall they go on counting?", default=False)


def _state(key: Key, now_ns: int) -> str:
    if key.revoked_ns is not None:
        return f"revoked {when(key.revoked_ns)}"
    end = "" if key.expires_ns is None else f"until {when(key.expires_ns)}"
    return f"valid {end}".strip() if key.valid_at(now_ns) else f"ended {end.removeprefix('until ')}"


def store_url(name: str) -> str:
    """The database URL of what the command line calls STORE. MapvoteError for one that gives a password away."""
    import os

    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    from mapvote.core.types import MapvoteError
    from mapvote.server.store.store import url_of

    given = os.environ.get("MAPVOTE_STORE", "") if name == "-" else name
    if not given:
        raise MapvoteError("STORE is -, but MAPVOTE_STORE is not set")
    if given.startswith(("http://", "https://")):
        raise MapvoteError(f"{given}: this is a server. Name the STORE (a file or a database) on the server's machine")
    try:
        password = make_url(url_of(given)).password
    except ArgumentError:
        raise MapvoteError("STORE is no database URL: postgresql+psycopg://USER@HOST/NAME") from None
    if password is not None and name != "-":
        mend = "set MAPVOTE_STORE to the URL and say - for STORE, or keep the password in ~/.pgpass"
        raise MapvoteError(f"everybody on this machine can read a password on the command line: {mend}")
    return url_of(given)


@contextmanager
def opened_store(name: str) -> Iterator[Store]:
    """An existing store, closed at the end."""
    from mapvote.server.store.store import Store

    store = Store.open(store_url(name))
    try:
        yield store
    finally:
        store.close()


def who() -> str:
    """Who sits at this machine, by the name they are logged in with: what a store's log calls them."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # no name for this number
        return "operator"


def when(stamp_ns: int) -> str:
    """A stamp as a reader of a terminal wants it, UTC."""
    from datetime import UTC, datetime

    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
