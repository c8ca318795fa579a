"""An identity provider: a server of OpenID Connect with keys of its own, for one client."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

from joserfc import jwt
from joserfc.jwk import RSAKey

CLIENT, SECRET = "sms", "of the client"


@dataclass
class Provider:
    """The provider, who comes to it, and what is wrong with its next tokens.

    Attributes
    ----------
    subject
        Of whoever logs in at it.
    wrong
        Claims that its tokens have instead of the right ones.
    header
        Of its tokens; with another `alg` they are signed with the public key as a secret, or not at all.
    key
        With which it signs; `published` is the one that it says it has.
    """

    issuer: str = ""
    subject: str = "sub-anna"
    wrong: dict[str, Any] = field(default_factory=dict)
    header: dict[str, str] = field(default_factory=lambda: {"alg": "RS256"})
    key: RSAKey = field(default_factory=lambda: RSAKey.generate_key(2048, {"kid": "1"}))
    published: RSAKey | None = None
    codes: dict[str, dict[str, str]] = field(default_factory=dict)

    def description(self) -> dict[str, Any]:
        return {
            "issuer": self.issuer,
            "authorization_endpoint": f"{self.issuer}/authorize",
            "token_endpoint": f"{self.issuer}/token",
            "jwks_uri": f"{self.issuer}/keys",
        }

    def authorize(self, asked: dict[str, str]) -> str:
        """Return where a browser is sent back to."""
        assert asked["response_type"] == "code"
        assert asked["client_id"] == CLIENT
        assert asked["code_challenge_method"] == "S256"
        code = secrets.token_urlsafe(8)
        self.codes[code] = asked
        return f"{asked['redirect_uri']}?{urlencode({'code': code, 'state': asked['state']})}"

    def token(self, form: dict[str, str], authorization: str) -> dict[str, Any] | None:
        """Return the token for a code, once; None where whoever asks is not who began."""
        asked = self.codes.pop(form.get("code", ""), None)
        if (
            asked is None
            or authorization != "Basic " + base64.b64encode(f"{CLIENT}:{SECRET}".encode()).decode()
        ):
            return None
        proof = base64.urlsafe_b64encode(hashlib.sha256(form["code_verifier"].encode()).digest()).rstrip(b"=")
        if proof.decode() != asked["code_challenge"] or form["redirect_uri"] != asked["redirect_uri"]:
            return None
        now = int(time.time())
        claims = {
            "iss": self.issuer,
            "aud": CLIENT,
            "sub": self.subject,
            "iat": now,
            "exp": now + 300,
            "nonce": asked["nonce"],
            "preferred_username": "anna.at.the.lab",
        }
        return {"id_token": _signed(self.header, claims | self.wrong, self.key), "token_type": "Bearer"}


def _signed(header: dict[str, str], claims: dict[str, Any], key: RSAKey) -> str:
    """Return a token; one that is not signed by the key itself is put together by hand."""
    if header["alg"] == "RS256":
        return jwt.encode(header, claims, key)
    parts = [base64.urlsafe_b64encode(json.dumps(part).encode()).rstrip(b"=") for part in (header, claims)]
    shared = hmac.new(key.as_pem(private=False), b".".join(parts), hashlib.sha256).digest()
    signature = base64.urlsafe_b64encode(shared).rstrip(b"=") if header["alg"] == "HS256" else b""
    return b".".join([*parts, signature]).decode()


class _Handler(BaseHTTPRequestHandler):
    provider: Provider

    def do_GET(self) -> None:
        path, asked = urlsplit(self.path).path, parse_qs(urlsplit(self.path).query)
        if path == "/authorize":
            self.send_response(302)
            self.send_header("Location", self.provider.authorize({k: v[0] for k, v in asked.items()}))
            self.end_headers()
        elif path == "/keys":
            self._answer({"keys": [(self.provider.published or self.provider.key).as_dict(private=False)]})
        else:
            self._answer(self.provider.description())

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        form = {k: v[0] for k, v in parse_qs(body).items()}
        found = self.provider.token(form, self.headers.get("Authorization", ""))
        self._answer(found or {"error": "invalid_grant"}, 400 if found is None else 200)

    def _answer(self, value: dict[str, Any], status: int = 200) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.end_headers()
        self.wfile.write(json.dumps(value).encode())

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@contextmanager
def provider() -> Iterator[Provider]:
    """Run a provider on this machine."""
    one = Provider()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"provider": one}))
    one.issuer = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield one
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
