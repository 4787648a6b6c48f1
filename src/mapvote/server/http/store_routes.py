"""The store itself: its policy, its log, its integrity."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from mapvote.server.http.answers import Checked, Info, Log, PolicyAnswer
from mapvote.server.http.auth import operator, reviewer
from mapvote.server.http.schemas import PLAIN, as_json, problems
from mapvote.server.http.services import services
from mapvote.server.store.integrity import check
from mapvote.server.views.overview import log_of, overview

router = APIRouter()


class PolicyAsk(BaseModel):
    """What to change of the policy."""

    model_config = ConfigDict(extra="forbid")
    values: dict[str, str | int | float | bool] = Field(max_length=100, description="by section.key: fuse.min_votes")
    reason: str = Field(default="", max_length=200, pattern=PLAIN)


@router.get("/v1/policy", response_model=PolicyAnswer, responses=problems(), summary="The policy")
def policy(request: Request) -> Response:
    """The policy in force, who set it and why."""
    return as_json(services(request).store.policy_changes()[-1].as_json())


@router.patch("/v1/policy", response_model=PolicyAnswer, responses=problems(403), summary="Change the policy")
def change_policy(request: Request, ask: PolicyAsk) -> Response:
    """In force at once. 422 names the value that is not possible, or the key that does not exist."""
    by, store = operator(request), services(request).store
    store.change_policy(ask.values, by=by, reason=ask.reason)
    return as_json(store.policy_changes()[-1].as_json())


@router.get("/v1/info", response_model=Info, responses=problems(), summary="What is in the store")
def info(request: Request) -> Response:
    """The map, its newest version, and how much there is of everything."""
    return as_json(overview(services(request).store))


@router.get("/v1/log", response_model=Log, responses=problems(403), summary="What happened")
def log(request: Request, events: Annotated[int, Query(ge=0, le=10_000)] = 0) -> Response:
    """Every version, and the last so many events."""
    reviewer(request)
    return as_json(log_of(services(request).store, events))


@router.get("/v1/check", response_model=Checked, responses=problems(403), summary="Is every byte as written?")
async def whole(request: Request) -> Response:
    """Reads the whole store and names what is damaged. Nothing is changed."""
    operator(request)
    parts = services(request)
    found = await to_thread.run_sync(check, parts.store, limiter=parts.threads.deciding)
    return as_json({"damage": found})


@router.post("/v1/check", response_model=Checked, responses=problems(403), summary="Set aside what is damaged")
async def mend(request: Request) -> Response:
    """As GET; what is damaged is set aside. Planes are mended on the server's own machine, from a backup."""
    by, parts = operator(request), services(request)
    found = await to_thread.run_sync(partial(check, parts.store, mend=True, by=by), limiter=parts.threads.deciding)
    return as_json({"damage": found})
