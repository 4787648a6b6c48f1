"""The review desk: pending changes, and verdicts on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from mapvote.core.answers import answer
from mapvote.shapes.geojson import feature_rows
from mapvote_server.api.lanes import on
from mapvote_server.api.page_routes import packed
from mapvote_server.api.paging import BoxAsked, PartAsked
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import (
    AS_CSV,
    MOST_SEQ,
    PLAIN,
    Ask,
    SeqOfBody,
    TableOrMap,
    as_json,
    as_table,
    sends_bytes,
)
from mapvote_server.api.services import Parts, Reviewer, Services
from mapvote_server.questions.desk import Desk, DeskAnswer, Pending, desk, review
from mapvote_server.store.reviews import VerdictAnswer, undo

router = APIRouter()


class ReviewAsk(Ask):
    """A verdict on one change."""

    change: str = Field(max_length=100, pattern=PLAIN, description="id of a change on the desk")
    verdict: Literal["accepted", "held", "rejected"]
    comment: str = Field(default="", max_length=300, pattern=PLAIN)
    after: SeqOfBody | None = Field(default=None, description="the verdict that it had when you looked")


@router.get(
    "/v1/desk",
    operation_id="get_desk",
    response_model=DeskAnswer | Pending,
    responses=problems(403) | AS_CSV,
    summary="What a publish would change now",
)
async def whole_desk(
    request: Request, by: Reviewer, parts: Parts, part: PartAsked, box: BoxAsked, format: TableOrMap = "json"
) -> Response:
    """Pending changes as GeoJSON with their verdicts; deletions beyond the policy's budget; held and rejected changes;
    the reasons to hold the version; the hashes of the tiles that a publish would make (null: without points), which
    `/v1/clouds` serves meanwhile.

    ``geojson`` and ``csv`` hold all of them in one list. ``limit`` and ``offset`` name a part of that list, or of the
    pending changes in ``json``.
    """
    shown = (await _look(parts)).answer.within(box)
    if format == "json":
        pending = replace(shown.pending, features=part.of(shown.pending.features))
        return part.link(request, as_json(replace(shown, pending=pending)), len(shown.pending.features))
    listed = shown.in_one()
    features = part.of(listed.features)
    answer = as_table(list(map(_flat, feature_rows(features)))) if format == "csv" else None
    return part.link(request, answer or as_json(replace(listed, features=features)), len(listed.features))


@router.get(
    "/v1/desk/clouds",
    operation_id="get_pending_clouds",
    summary="Points that a publish would add and delete",
    **sends_bytes(403),
)
async def pending_clouds(by: Reviewer, parts: Parts, request: Request) -> Response:
    """Tile by tile, two clouds each, as `/v1/clouds/changed` gives them."""
    return packed(request, (await _look(parts)).clouds, "no-store")


async def _look(parts: Services) -> Desk:
    """The desk as of now; its tiles are proposed to the clouds."""
    looked_at = await parts.rounds.run(desk, parts.store, parts.fusing, parts.gate)
    parts.clouds.propose([(made.hashes, made.make) for made in looked_at.edited.values()])
    return looked_at


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A verdict has three columns of its own."""
    given: VerdictAnswer | None = row["verdict"]
    flat: dict[str, Any] = {}
    for name, value in row.items():
        columns = ("verdict", "by", "comment") if name == "verdict" else ()
        flat |= {column: "" if given is None else getattr(given, column) for column in columns} or {name: value}
    return flat


@answer
@dataclass(frozen=True, slots=True)
class VerdictGiven:
    """The verdict's number in the log."""

    seq: int


@router.post(
    "/v1/desk/reviews",
    operation_id="review_change",
    responses=problems(403, 404, 409),
    summary="Accept, hold or reject a change",
)
async def decide(by: Reviewer, parts: Parts, ask: ReviewAsk) -> VerdictGiven:
    """A publish obeys it: the votes of a rejected change do not count any more, those of a held one wait.

    409 if another reviewer decided meanwhile.
    """
    given = parts.store, ask.change, ask.verdict
    return VerdictGiven(
        seq=await parts.rounds.run(review, *given, by=by, comment=ask.comment, after=ask.after, executor=parts.fusing)
    )


@router.delete(
    "/v1/desk/reviews/{seq}",
    operation_id="undo_review",
    responses=problems(403, 404, 409),
    summary="Take a verdict back",
)
@on("commands")
def take_back(by: Reviewer, parts: Parts, seq: Annotated[int, Path(ge=0, le=MOST_SEQ)]) -> VerdictGiven:
    """The change is pending again."""
    undo(parts.store, seq, by=by)
    return VerdictGiven(seq=seq)
