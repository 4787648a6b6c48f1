"""The page that asks a browser for its key, and the cookie that keeps the key until the browser is closed.

A browser's own question asks for a name and a password, without a word what to type. A script of another site cannot
send the cookie (SameSite=Strict), and no script can read it (HttpOnly).
"""

from __future__ import annotations

import html
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from importlib import resources
from urllib.parse import parse_qs

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope

from mapvote_server.errors import Unauthorised

PATH = "/key"
"""Where the form is sent."""
STYLE = "/viewer/key.css"
COOKIE = "mapvote_key"
_PAGES = ("/", "/docs")
_MOST_BYTES = 4096


def key_in_cookie(headers: Iterable[tuple[bytes, bytes]]) -> str | None:
    """The key that the form has left with the browser."""
    sent = next((value.decode("latin-1") for name, value in headers if name == b"cookie"), "")
    try:
        cookie = SimpleCookie(sent).get(COOKIE)
    except CookieError:
        return None
    return cookie.value if cookie else None


def asks_for_page(scope: Scope) -> bool:
    """Whether a browser asks for one of the pages, and not a program for an answer."""
    accepted = next((value for name, value in scope["headers"] if name == b"accept"), b"")
    return scope["method"] == "GET" and scope["path"] in _PAGES and b"text/html" in accepted


def is_page(scope: Scope) -> bool:
    """Whether a link of another server may lead here: a page that a browser opens as a whole."""
    mode = next((value for name, value in scope["headers"] if name == b"sec-fetch-mode"), b"")
    return scope["method"] == "GET" and scope["path"] in _PAGES and mode == b"navigate"


def form(reason: str = "") -> Response:
    """401 with the form; ``reason`` the last key was not taken."""
    body = _file("key.html").replace("WHY", html.escape(reason))
    return Response(body, 401, {"WWW-Authenticate": "Bearer", "Cache-Control": "no-store"}, media_type="text/html")


def style() -> Response:
    """The form's style, which needs no key."""
    return Response(_file("key.css"), media_type="text/css")


def _file(name: str) -> str:
    return (resources.files("mapvote_server") / "web" / name).read_text()


async def key_sent(scope: Scope, receive: Receive) -> str:
    """The key in a form that was sent; Unauthorised if there is none."""
    body = b""
    async for part in Request(scope, receive).stream():
        body += part
        if len(body) > _MOST_BYTES:
            raise Unauthorised("this is no key: paste the one that the operator gave you")
    try:
        key = parse_qs(body.decode()).get("key", [""])[0].strip()
    except (UnicodeDecodeError, ValueError):
        key = ""
    if not key:
        raise Unauthorised("this is no key: paste the one that the operator gave you")
    return key


def welcome(scope: Scope, key: str) -> Response:
    """To the page, with the cookie."""
    response = Response(status_code=303, headers={"Location": "./", "Cache-Control": "no-store"})
    response.set_cookie(COOKIE, key, httponly=True, samesite="strict", secure=scope["scheme"] == "https")
    return response
