"""Other people's web pages at a server on the visitor's machine."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import httpx2
import pytest

from hand_made import two_walls
from live_server import serving_here
from mapvote_server.api.security import HEADERS
from mapvote_server.store.store import Store
from stores import vote_gone


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An open server with ballots that wait to be published."""
    home = tmp_path_factory.mktemp("browsers")
    store = Store.create(f"sqlite:///{home / 's.db'}", two_walls())
    vote_gone(store)
    settings = '[server]\nhosts = ["maps.example.org"]\n'
    with serving_here(home / "s.db", settings=settings, log=home / "log") as address:
        yield address
    assert store.current() == 1
    store.close()


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
        {"Host": "maps.example.org.evil.example"},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": "[::1].evil.example"},
        {"Host": "["},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://192.0.2.1"},
        {"Origin": "http://localhost"},
        {"Origin": "http://127.0.0.1"},
    ],
)
def test_a_rebound_name_or_a_foreign_page_publishes_nothing(url: str, headers: dict[str, str]) -> None:
    for method, path, body in (("POST", "/v1/publish", {"override": True}), ("GET", "/v1/map", None)):
        answer = httpx2.request(method, url + path, json=body, headers=headers, timeout=300.0)
        assert answer.status_code == 403, answer.text
        assert "[server] hosts" in answer.json()["detail"]


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_an_image_or_a_link_of_a_foreign_page_sets_nothing_off(url: str, site: str) -> None:
    """Browsers send no Origin with those, but the credentials that they keep."""
    for path in ("/v1/check", "/v1/desk", "/v1/map", "/nothing"):
        for mode in ("no-cors", "navigate"):
            headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Mode": mode}
            assert httpx2.get(url + path, headers=headers, timeout=60.0).status_code == 403, path
    link = {"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "navigate"}
    assert httpx2.get(url, headers=link, timeout=60.0).status_code == 200
    assert httpx2.get(url, headers=link | {"Sec-Fetch-Mode": "no-cors"}, timeout=60.0).status_code == 403
    for ours in ("same-origin", "none"):
        assert httpx2.get(f"{url}/v1/check", headers={"Sec-Fetch-Site": ours}, timeout=60.0).status_code == 200


def test_a_request_without_a_host_is_refused(url: str) -> None:
    host, _, port = url.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(b"GET /v1/map HTTP/1.0\r\n\r\n")
        assert connection.recv(100).split()[1] in (b"400", b"403")


def test_its_own_page_and_the_name_that_the_operator_gave_it_are_let_in(url: str) -> None:
    for headers in (
        {},
        {"Origin": url},
        {"Host": "maps.example.org", "Origin": "https://maps.example.org"},
        {"Origin": "https://MAPS.example.org"},
        {"Host": "localhost:8080"},
    ):
        answer = httpx2.post(f"{url}/v1/publish", json={"dry_run": True}, headers=headers, timeout=60.0)
        assert answer.status_code == 200


def test_every_answer_tells_the_browser_to_load_nothing_from_elsewhere(url: str) -> None:
    for path in ("/", "/docs", "/viewer/app.js", "/v1/map", "/healthz", "/nothing", "/openapi.json"):
        answer = httpx2.get(url + path, timeout=300.0)
        assert {name: answer.headers[name] for name, _ in HEADERS} == dict(HEADERS), path
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert not any(word in policy for word in ("unsafe-inline", "http"))
        if answer.headers["content-type"].startswith("text/html"):
            assert not any(word in answer.text for word in ("style=", "<style"))
