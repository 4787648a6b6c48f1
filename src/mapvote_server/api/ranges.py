"""Parts of a file by the header Range (RFC 9110, section 14)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from mapvote_server.api.etags import has_already
from mapvote_server.api.problems import refuse
from mapvote_server.errors import NotInFile


def asked_bytes(text: str | None, size: int) -> range | None:
    """The bytes that a Range asks for of a file of ``size`` bytes; None for the whole file: without the header, and of
    what is no single range of bytes, which a server may ignore.

    NotInFile if the file has none of the bytes.
    """
    match = re.fullmatch(r"bytes=([0-9]{0,18})-([0-9]{0,18})", (text or "").replace(" ", "").lower())
    if match is None or match[1] == match[2] == "":
        return None
    if not match[1]:
        part = range(max(0, size - int(match[2])), size)
    else:
        last = int(match[2]) if match[2] else size - 1
        if last < int(match[1]) and match[2]:
            return None
        part = range(int(match[1]), min(last + 1, size))
    if not part:
        raise NotInFile(f"the file has {size} bytes, none of {text}")
    return part


def answer_part(request: Request, file: BinaryIO, size: int, tag: str, media_type: str) -> Response:
    """The answer to GET for an open file, which is closed at its end: 200, 206, 304 or 416."""
    headers = {"ETag": tag, "Accept-Ranges": "bytes", "Cache-Control": "private, no-cache"}
    if has_already(request, tag):
        file.close()
        return Response(status_code=304, headers=headers)
    fresh = request.headers.get("if-range", tag) == tag
    try:
        part = asked_bytes(request.headers.get("range"), size) if fresh else None
    except NotInFile as error:
        file.close()
        refused = refuse(error, request.url.path)
        refused.headers["Content-Range"] = f"bytes */{size}"
        return refused
    sent = range(size) if part is None else part
    headers["Content-Length"] = str(len(sent))
    if part is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    status = 200 if part is None else 206
    return _PartOfFile(file, _pieces(file, sent), status, headers, media_type)


class _PartOfFile(StreamingResponse):
    """Closes its file however the answer ends: also where the client goes, or asked for the headers alone."""

    def __init__(
        self, file: BinaryIO, pieces: Iterator[bytes], status: int, headers: Mapping[str, str], media_type: str
    ) -> None:
        super().__init__(pieces, status, headers, media_type)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await super().__call__(scope, receive, send)


def _pieces(file: BinaryIO, sent: range) -> Iterator[bytes]:
    file.seek(sent.start)
    left = len(sent)
    while left:
        piece = file.read(min(left, 1 << 18))
        left -= len(piece)
        yield piece
