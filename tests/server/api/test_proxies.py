"""The client of a request behind reverse proxies, as RFC 7239 and X-Forwarded-For name it."""

from __future__ import annotations

import pytest

from mapvote.config import ServerSettings
from mapvote_server.api.proxies import Proxies

OURS = Proxies(["192.0.2.0/28", "2001:db8::1"])


@pytest.mark.parametrize(
    ("peer", "headers", "client"),
    [
        ("192.0.2.1", {}, "192.0.2.1"),
        ("192.0.2.1", {"x-forwarded-for": "198.51.100.7"}, "198.51.100.7"),
        ("198.51.100.1", {"x-forwarded-for": "203.0.113.9"}, "198.51.100.1"),
        ("192.0.2.1", {"x-forwarded-for": "203.0.113.9, 198.51.100.7"}, "198.51.100.7"),
        ("192.0.2.1", {"x-forwarded-for": "203.0.113.9, 198.51.100.7, 192.0.2.2"}, "198.51.100.7"),
        ("192.0.2.1", {"forwarded": "for=198.51.100.7;proto=https"}, "198.51.100.7"),
        ("192.0.2.1", {"forwarded": 'for=203.0.113.9, For="[2001:db8:cafe::17]:4711"'}, "2001:db8:cafe::17"),
        ("2001:db8::1", {"forwarded": 'for="198.51.100.7:80"'}, "198.51.100.7"),
        ("192.0.2.1", {"forwarded": "for=unknown"}, "192.0.2.1"),
        ("192.0.2.1", {"forwarded": "for=_hidden"}, "192.0.2.1"),
        ("192.0.2.1", {"x-forwarded-for": "198.51.100.7", "forwarded": "for=203.0.113.9"}, "192.0.2.1"),
        ("192.0.2.1", {"x-forwarded-for": "198.51.100.7", "forwarded": "for=198.51.100.7"}, "198.51.100.7"),
        ("192.0.2.1", {"x-forwarded-for": "\x00, <script>"}, "192.0.2.1"),
        ("", {"x-forwarded-for": "198.51.100.7"}, ""),
    ],
)
def test_only_trusted_proxies_are_believed_and_only_as_far_as_they_are(
    peer: str, headers: dict[str, str], client: str
) -> None:
    sent = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    assert OURS.client(peer, sent) == client
    scope = {"client": (peer, 1), "headers": sent, "scheme": "http"}
    OURS.apply(scope)
    assert scope["client"][0] == client
    assert (scope["scheme"] == "https") == ("proto=https" in str(headers))


def test_a_proxy_that_is_no_address_is_an_error_of_the_settings() -> None:
    assert ServerSettings.model_validate({"proxies": "10.0.0.0/8, ::1"}).proxies == ("10.0.0.0/8", "::1")
    with pytest.raises(ValueError, match="nginx"):
        ServerSettings(proxies=("nginx",))
