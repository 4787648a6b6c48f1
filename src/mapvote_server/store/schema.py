"""The tables. One store holds one map. Times are nanoseconds since 1970, hashes SHA-256 in hex.

Votes and versions are never overwritten. A ballot that is replaced or withdrawn is marked with the event that did so.
Hence any past round can be fused again (un-vote by replay).
"""

from __future__ import annotations

import sqlalchemy as sa

from mapvote_server.store.database import sum_but

metadata = sa.MetaData(
    naming_convention={
        "ix": "ix_%(column_0_label)s",
        "uq": "uq_%(table_name)s_%(column_0_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)
_Hash = sa.String(64)
TILE_PLANES = "points", "ground", "free", "memory", "fields"
"""Columns of version_tiles: hashes of planes."""

maps = sa.Table(
    "maps",
    metadata,
    sa.Column("map_id", sa.String(200), primary_key=True),
    sa.Column("x0", sa.Double, nullable=False),
    sa.Column("y0", sa.Double, nullable=False),
    sa.Column("georeference", sa.JSON, nullable=False),
    sa.Column("secret", sa.String(64), nullable=False),
    sa.Column("surveyed_ns", sa.BigInteger),
    sum_but("x0", "y0"),
)
"""``secret``: the key of vehicles' pseudonyms; it never leaves the store. ``surveyed_ns``: end of the last drive of
which the first version was made; null if unknown."""

policies = sa.Table(
    "policies",
    metadata,
    sa.Column("seq", sa.BigInteger, sa.ForeignKey("events.seq"), primary_key=True, autoincrement=False),
    sa.Column("policy", sa.JSON, nullable=False),
    sum_but(),
)
"""One row a change; the event says who made it, when and why. The newest one holds."""

keys = sa.Table(
    "keys",
    metadata,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("role", sa.String(16), primary_key=True),
    sa.Column("hash", _Hash, primary_key=True),
    sa.Column("created_ns", sa.BigInteger, nullable=False),
    sa.Column("revoked_ns", sa.BigInteger),
    sa.Column("expires_ns", sa.BigInteger),
    sum_but("revoked_ns", "expires_ns"),
    sa.UniqueConstraint("hash"),
)
"""``role``: vehicle, reader, reviewer or operator; only the hash of a key is kept. ``expires_ns``: null for never."""

events = sa.Table(
    "events",
    metadata,
    sa.Column("seq", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("actor", sa.String(80), nullable=False),
    sa.Column("detail", sa.String(400), nullable=False),
    sum_but(),
)
"""The log, and the one order of everything: writers take turns, so ``seq`` grows in the order of commits."""

blobs = sa.Table(
    "blobs",
    metadata,
    sa.Column("hash", _Hash, primary_key=True),
    sa.Column("data", sa.LargeBinary, nullable=False),
)
"""Content-addressed planes of tiles: zstd frames, named by the hash of what is inside."""

versions = sa.Table(
    "versions",
    metadata,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("parent", sa.Integer),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("target", sa.Integer),
    sa.Column("created_ns", sa.BigInteger, nullable=False),
    sa.Column("published_by", sa.String(80), nullable=False),
    sa.Column("reason", sa.String(400), nullable=False),
    sa.Column("mark", sa.BigInteger, nullable=False),
    sa.Column("policy", sa.JSON, nullable=False),
    sa.Column("cleared_seq", sa.BigInteger),
    sum_but("cleared_seq"),
)
"""``mark``: the last event that the version knew of. ``target``: the version that a rollback or replay starts from.
``cleared_seq``: the event by which its planes and decisions were cleared away; what is left is that it was."""

version_tiles = sa.Table(
    "version_tiles",
    metadata,
    sa.Column("version", sa.Integer, sa.ForeignKey("versions.number"), primary_key=True),
    sa.Column("row", sa.Integer, primary_key=True),
    sa.Column("col", sa.Integer, primary_key=True),
    *(sa.Column(plane, _Hash) for plane in TILE_PLANES),
    sa.Index("ix_version_tiles_tile", "row", "col", "version"),
)
"""Only tiles that the version sets; every other tile is that of its parent. Null points: the version has no such tile.
``memory``: for every cell the version of its last change, and when objects were added and deleted; null: never.
``fields``: further attributes of the points (codec/tile_planes.py); null: none."""

ballots = sa.Table(
    "ballots",
    metadata,
    sa.Column("seq", sa.BigInteger, sa.ForeignKey("events.seq"), primary_key=True, autoincrement=False),
    sa.Column("first_seq", sa.BigInteger, nullable=False),
    sa.Column("gone_seq", sa.BigInteger),
    sa.Column("vehicle", sa.String(64), nullable=False),
    sa.Column("drive", sa.String(64), nullable=False),
    sa.Column("digest", _Hash, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("received_ns", sa.BigInteger, nullable=False),
    sa.Column("settings_hash", sa.String(128), nullable=False),
    sa.Column("cast_by", sa.String(32), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sum_but("gone_seq", "bytes"),
    sa.Index("ix_ballots_drive", "vehicle", "drive"),
    sa.Index("ix_ballots_gone_seq", "gone_seq"),
    sa.Index("ix_ballots_end", "vehicle", "end_ns"),
    sa.Index("ix_ballots_received_ns", "received_ns"),
)
"""``cast_by``: method and stage; ``bytes``: size of the upload; ``version``: the version that the vehicle used.
``first_seq``: the event with which this drive first arrived; ``gone_seq``: the event that replaced or withdrew this
ballot."""

ballot_tiles = sa.Table(
    "ballot_tiles",
    metadata,
    sa.Column("row", sa.Integer, primary_key=True),
    sa.Column("col", sa.Integer, primary_key=True),
    sa.Column("ballot", sa.BigInteger, sa.ForeignKey("ballots.seq"), primary_key=True),
    sa.Column("base", sa.String(64), nullable=False),
    sa.Column("votes", sa.LargeBinary, nullable=False),
    sum_but("row", "col", "ballot"),
    sa.Index("ix_ballot_tiles_ballot", "ballot"),
)
"""``votes``: the votes on the tile as the ballot holds them (:func:`mapvote.codec.ballot.encode_tile`). Two rows of the
same sum say the same."""

paths = sa.Table(
    "paths",
    metadata,
    sa.Column("ballot", sa.BigInteger, sa.ForeignKey("ballots.seq"), primary_key=True, autoincrement=False),
    sa.Column("path", sa.LargeBinary, nullable=False),
    sum_but(),
)
"""Paths of vehicles, for ballots that contain one (:func:`mapvote.codec.ballot.pack_path`)."""

decisions = sa.Table(
    "decisions",
    metadata,
    sa.Column("version", sa.Integer, sa.ForeignKey("versions.number"), primary_key=True),
    sa.Column("row", sa.Integer, primary_key=True),
    sa.Column("col", sa.Integer, primary_key=True),
    sa.Column("states", sa.LargeBinary, nullable=False),
    sa.Column("tally", sa.LargeBinary, nullable=False),
    sa.Column("vehicles", sa.Integer, nullable=False),
    sa.Column("added", sa.Integer, nullable=False),
    sa.Column("deleted", sa.Integer, nullable=False),
    sa.Column("odds", sa.LargeBinary),
    sa.Column("standings", sa.LargeBinary, nullable=False),
    sa.Column("edits", sa.LargeBinary),
    sa.Column("fell", sa.LargeBinary),
    sum_but("version", "row", "col", "vehicles", "added", "deleted"),
)
"""The decision record (store/decisions.py). ``tally``: (5, 65536), compressed. ``odds``: log-odds of the changed
cells by the vehicles that voted for them, see :func:`mapvote.fusion.loss_budget.pack_agreed`; null: no vehicle sent
any. ``standings``: which ballots counted, and why the others did not. ``edits``: the votes behind points that came or
went in cells of which ``states`` state no such change; null: there are none. ``fell``: cells of which something fell
with a demolished object (fusion/gravity.py); null: none."""

reviews = sa.Table(
    "reviews",
    metadata,
    sa.Column("seq", sa.BigInteger, sa.ForeignKey("events.seq"), primary_key=True, autoincrement=False),
    sa.Column("gone_seq", sa.BigInteger),
    sa.Column("verdict", sa.String(16), nullable=False),
    sa.Column("comment", sa.String(400), nullable=False),
    sa.Column("feature", sa.JSON, nullable=False),
    sum_but("gone_seq"),
)
"""Verdicts of reviewers. ``feature``: the change as they saw it; ``gone_seq``: the event that undid the verdict."""

review_cells = sa.Table(
    "review_cells",
    metadata,
    sa.Column("row", sa.Integer, primary_key=True),
    sa.Column("col", sa.Integer, primary_key=True),
    sa.Column("review", sa.BigInteger, sa.ForeignKey("reviews.seq"), primary_key=True),
    sa.Column("cells", sa.LargeBinary, nullable=False),
    sum_but(),
)
"""The cells (65536 packed bits) of a reviewed change. Change votes on them do not count: for a rejected change votes of
drives that first arrived before the rejection, for a held one all votes until the hold ends."""

quarantine = sa.Table(
    "quarantine",
    metadata,
    sa.Column("kind", sa.String(16), primary_key=True),
    sa.Column("name", sa.String(160), primary_key=True),
    sa.Column("seq", sa.BigInteger, sa.ForeignKey("events.seq"), nullable=False),
    sa.Column("why", sa.String(200), nullable=False),
)
"""Damaged items, which are not used: planes by hash, ballots and decisions by number and tile."""

deliveries = sa.Table(
    "deliveries",
    metadata,
    sa.Column("address", _Hash, primary_key=True),
    sa.Column("seq", sa.BigInteger, nullable=False),
)
"""Up to which event a webhook has taken them, by the hash of its address."""

SUMMED = {
    "map": maps, "policy": policies, "key": keys, "event": events, "version": versions, "ballot": ballots,
    "votes": ballot_tiles, "decision": decisions, "review": reviews, "reviewed": review_cells, "path": paths,
}  # fmt: skip
"""Tables whose rows carry a sum over all that is written once, by the kind of damage."""
