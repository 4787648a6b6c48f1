"""The review desk: pending changes, and verdicts on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from mapvote.codec.ballot import tile_key
from mapvote.shapes.geojson import feature_rows
from mapvote_server.api.lanes import on
from mapvote_server.api.page_routes import packed
from mapvote_server.api.schemas import (
    AS_CSV,
    MOST_SEQ,
    PLAIN,
    Ask,
    DeskAnswer,
    Pending,
    SeqOfBody,
    TableOrMap,
    VerdictGiven,
    as_json,
    as_table,
    problems,
    sends_bytes,
)
from mapvote_server.api.services import Parts, Reviewer, Services
from mapvote_server.questions.desk import Desk, Proposed, desk, review, verdict_of
from mapvote_server.store.reviews import undo

router = APIRouter()


class ReviewAsk(Ask):
    """A verdict on one change."""

    change: str = Field(max_length=100, pattern=PLAIN, description="id of a change on the desk")
    verdict: Literal["accepted", "held", "rejected"]
    comment: str = Field(default="", max_length=300, pattern=PLAIN)
    after: SeqOfBody | None = Field(default=None, description="the verdict that it had when you looked")


@router.get(
    "/v1/desk",
    response_model=DeskAnswer | Pending,
    responses=problems(403) | AS_CSV,
    summary="What a publish would change now",
)
async def whole_desk(by: Reviewer, parts: Parts, format: TableOrMap = "json") -> Response:
    """Pending changes as GeoJSON with their verdicts; deletions beyond the policy's budget; held and rejected changes;
    the reasons to hold the version; the hashes of the tiles that a publish would make (null: without points), which
    `/v1/clouds` serves meanwhile.

    ``geojson`` and ``csv`` hold all of them in one list.
    """
    found = await _look(parts)
    left_out = [verdict_of(one) for one in found.reviewed]
    if format == "json":
        answer = {
            "version": found.version,
            "held": found.held,
            "doubts": found.doubts,
            "waits": found.waits,
            "pending": found.pending,
        }
        tiles = {tile_key(index): _hashes(made) for index, made in found.edited.items()}
        return as_json(answer | {"waiting": found.waiting, "reviewed": left_out, "tiles": tiles})
    listed = found.pending | {"features": [*found.pending["features"], *found.waiting, *left_out]}
    return as_json(listed) if format == "geojson" else as_table([_flat(row) for row in feature_rows(listed)])


@router.get("/v1/desk/clouds", summary="Points that a publish would add and delete", **sends_bytes(403))
async def pending_clouds(by: Reviewer, parts: Parts, request: Request) -> Response:
    """Tile by tile, two clouds each, as `/v1/clouds/changed` gives them."""
    return packed(request, (await _look(parts)).clouds, "no-store")


def _hashes(made: Proposed) -> dict[str, str] | None:
    return {"points": made.hashes.points, "ground": made.hashes.ground} if made.points else None


async def _look(parts: Services) -> Desk:
    """The desk as of now; its tiles are proposed to the clouds."""
    found = await parts.rounds.run(desk, parts.store, parts.fusing, parts.gate)
    parts.clouds.propose((made.hashes, made.make) for made in found.edited.values())
    return found


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A verdict has its own columns."""
    said = row["verdict"] or {"verdict": "", "by": "", "comment": ""}
    return dict(row) | {"verdict": said["verdict"], "by": said["by"], "comment": said["comment"]}


@router.post("/v1/desk/reviews", responses=problems(403, 404, 409), summary="Accept, hold or reject a change")
async def decide(by: Reviewer, parts: Parts, ask: ReviewAsk) -> VerdictGiven:
    """A publish obeys it: the votes of a rejected change do not count any more, those of a held one wait.

    409 if another reviewer decided meanwhile.
    """
    given = parts.store, ask.change, ask.verdict
    return VerdictGiven(
        seq=await parts.rounds.run(review, *given, by=by, comment=ask.comment, after=ask.after, executor=parts.fusing)
    )


@router.delete("/v1/desk/reviews/{seq}", responses=problems(403, 404, 409), summary="Take a verdict back")
@on("commands")
def take_back(by: Reviewer, parts: Parts, seq: Annotated[int, Path(ge=0, le=MOST_SEQ)]) -> VerdictGiven:
    """The change is pending again."""
    undo(parts.store, seq, by=by)
    return VerdictGiven(seq=seq)
