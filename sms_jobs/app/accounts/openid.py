"""Log-in by an identity provider: OpenID Connect Core 1.0, the authorization code flow with PKCE (RFC 7636).

Who somebody is here is decided here: an administrator gives a person the subject by which the provider knows
them.
The package `joserfc` is that of the extra `openid`; it is loaded where a token is checked.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode, urlsplit

from sms_jobs.app.accounts import people
from sms_jobs.app.accounts.people import LoggedIn
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import people as known
from sms_jobs.errors import ConfigurationError, Conflict, NotAllowed, ServerUnreachable
from sms_jobs.records.people import Right
from sms_jobs.records.shown.people import PersonView
from sms_jobs.records.texts import harmless

_PATIENCE_S = 10.0
_LARGEST = 1 << 20
_LEEWAY_S = 60
_ALGORITHMS = ["RS256", "PS256", "ES256", "EdDSA"]
"""Of signatures with a key that the provider alone has."""
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Journey:
    """A log-in on its way to the provider and back; the browser that began it keeps this.

    Attributes
    ----------
    state, nonce, verifier
        Drawn for this log-in: the first comes back with the answer, the second in the token, and the third
        proves to the provider that whoever asks for the token began the log-in.
    back
        Address to which the provider sends the browser back.
    """

    state: str
    nonce: str
    verifier: str
    back: str


@use_case(None)
def is_offered(services: Services) -> bool:
    """Return whether an identity provider is set."""
    return bool(services.settings.openid_issuer)


@use_case(None)
def begin(services: Services, back: str) -> tuple[str, Journey]:
    """Begin a log-in that will come back to an address.

    Returns
    -------
    The provider's address to which the browser is to go, and what it has to bring back.

    Raises
    ------
    ConfigurationError
        No provider is set, or it describes itself wrongly.
    ServerUnreachable
        It does not answer.
    """
    provider = _provider(services)
    state, nonce, verifier = (secrets.token_urlsafe(32) for _ in range(3))
    journey = Journey(state, nonce, verifier, back)
    challenge = base64.urlsafe_b64encode(hashlib.sha256(journey.verifier.encode()).digest()).rstrip(b"=")
    asked = {
        "response_type": "code",
        "client_id": services.settings.openid_client_id,
        "redirect_uri": back,
        "scope": "openid profile email",
        "state": journey.state,
        "nonce": journey.nonce,
        "code_challenge": challenge.decode(),
        "code_challenge_method": "S256",
    }
    address = str(provider["authorization_endpoint"])
    return f"{address}{'&' if urlsplit(address).query else '?'}{urlencode(asked)}", journey


@use_case(None)
def complete(services: Services, journey: Journey, state: str, code: str) -> LoggedIn:
    """Begin a session for whoever the provider says has come back with a code.

    Raises
    ------
    NotAllowed
        The answer is not for this log-in, its token cannot be trusted, or it names nobody who may come in.
    ConfigurationError, ServerUnreachable
        As `begin` does.
    """
    if not secrets.compare_digest(state.encode(), journey.state.encode()):
        raise NotAllowed("this answer of the identity provider belongs to another log-in; log in again")
    provider = _provider(services)
    claims = _claims(services, provider, _token(services, provider, journey, code), journey.nonce)
    subject = str(claims["sub"])
    with services.catalogue.reading() as session:
        person = known.of_identity(session, _identity(services, subject))
        name = None if person is None else person.name
    if name is None:
        called = harmless(str(claims.get("preferred_username") or claims.get("email") or "somebody"))[:80]
        raise NotAllowed(
            f"the identity provider knows {called} as '{harmless(subject)[:200]}', who has no account "
            f"here; an administrator can add it with 'sms person identity NAME {harmless(subject)[:200]}'"
        )
    return people.begin_session(services.catalogue, services.actor, name, "openid.complete")


@use_case(Right.ADMINISTER)
def set_identity(services: Services, name: str, subject: str | None) -> PersonView:
    """Enter by which subject the identity provider knows a person, or that it knows the person no more.

    Raises
    ------
    NotFound
        There is nobody of that name.
    Conflict
        Somebody else has that subject.
    ConfigurationError
        No provider is set.
    """
    identity = None if subject is None else _identity(services, subject)
    with services.catalogue.writing() as session:
        row = known.named(session, name)
        other = None if identity is None else known.of_identity(session, identity, active=False)
        if other is not None and other.id != row.id:
            raise Conflict(f"'{subject}' is {other.name} already; take it from there first")
        row.identity = identity
        return known.person_view(row)


def _identity(services: Services, subject: str) -> str:
    if not services.settings.openid_issuer:
        raise ConfigurationError(
            "no identity provider is set; set 'openid_issuer' and 'openid_client_id' in sms.toml"
        )
    return f"{services.settings.openid_issuer} {subject}"


def _provider(services: Services) -> Mapping[str, Any]:
    """Return how the provider describes itself (OpenID Connect Discovery 1.0)."""
    issuer = services.settings.openid_issuer
    _identity(services, "")
    found = _asked("GET", f"{issuer.rstrip('/')}/.well-known/openid-configuration")
    wanted = ("authorization_endpoint", "token_endpoint", "jwks_uri")
    if found.get("issuer") != issuer or any(not _is_safe(str(found.get(name, ""))) for name in wanted):
        raise ConfigurationError(
            f"the identity provider at {issuer} calls itself {found.get('issuer')!r:.200}, or has an address "
            "without TLS; correct the setting 'openid_issuer'"
        )
    return found


def _token(services: Services, provider: Mapping[str, Any], journey: Journey, code: str) -> str:
    settings = services.settings
    secret = settings.openid_client_secret.get_secret_value()
    form = {
        "grant_type": "authorization_code",
        "code": code,
        "redirect_uri": journey.back,
        "code_verifier": journey.verifier,
        "client_id": settings.openid_client_id,
    }
    found = _asked(
        "POST", str(provider["token_endpoint"]), form, (settings.openid_client_id, secret) if secret else None
    )
    if not isinstance(found.get("id_token"), str):
        raise NotAllowed("the identity provider gave no token for this log-in; log in again")
    return str(found["id_token"])


def _claims(services: Services, provider: Mapping[str, Any], token: str, nonce: str) -> Mapping[str, Any]:
    """Return what a token says, once all that OpenID Connect Core 3.1.3.7 asks for is proved."""
    try:
        from joserfc import jwt
        from joserfc.errors import JoseError
        from joserfc.jwk import KeySet
    except ImportError as error:
        raise ConfigurationError(
            "joserfc is not installed, which checks the identity provider's tokens: run "
            "\"pip install 'sms-jobs[openid]'\""
        ) from error
    client = services.settings.openid_client_id
    keys = _asked("GET", str(provider["jwks_uri"]))
    try:
        found = jwt.decode(
            token, KeySet.import_key_set({"keys": keys.get("keys", [])}), algorithms=_ALGORITHMS
        )
        jwt.JWTClaimsRegistry(
            leeway=_LEEWAY_S,
            iss={"essential": True, "value": services.settings.openid_issuer},
            aud={"essential": True, "value": client},
            sub={"essential": True},
            exp={"essential": True},
            iat={"essential": True},
            nonce={"essential": True, "value": nonce},
        ).validate(found.claims)
    except (JoseError, ValueError, KeyError, TypeError) as error:
        raise NotAllowed(
            f"the identity provider's token cannot be trusted ({type(error).__name__}); log in again"
        ) from error
    if found.claims.get("azp", client) != client:
        raise NotAllowed("the identity provider's token is for another program; log in again")
    return found.claims


def _asked(
    method: str, address: str, form: Mapping[str, str] | None = None, auth: tuple[str, str] | None = None
) -> dict[str, Any]:
    """Return the JSON object that the provider answers; what it is sent is in no error."""
    import httpx2

    if not _is_safe(address):
        raise ConfigurationError(f"{address:.200} has no TLS; an identity provider needs https")
    try:
        with httpx2.Client(timeout=_PATIENCE_S, follow_redirects=False) as client:
            answer = client.request(method, address, data=form, auth=auth)
            found = answer.json() if len(answer.content) <= _LARGEST else None
    except httpx2.HTTPError as error:
        raise ServerUnreachable(
            f"the identity provider {urlsplit(address).netloc} does not answer ({type(error).__name__}); "
            "try again, or log in with a password"
        ) from None
    except ValueError:
        found = None
    if answer.status_code >= 500:
        raise ServerUnreachable(f"the identity provider answers with status {answer.status_code}; try again")
    if answer.status_code != 200 or not isinstance(found, dict):
        raise NotAllowed(f"the identity provider refuses (status {answer.status_code}); log in again")
    return found


def _is_safe(address: str) -> bool:
    parts = urlsplit(address)
    return parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in _LOOPBACK)
