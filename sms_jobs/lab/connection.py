"""Requests to a server: its errors are raised here as they were there, and short absences are waited for."""

from __future__ import annotations

import ipaddress
import ssl
import time
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import httpx2

import sms_jobs.errors
from sms_jobs.errors import (
    CommitInDoubt,
    ConfigurationError,
    InvalidInput,
    NotAllowed,
    ServerUnreachable,
    SmsError,
)

_API = "/api/v1"
_PATIENCE_S = 60.0
"""How long a server that is away, or too busy, is waited for."""
_PAUSE_S = 0.2
_LONGEST_PAUSE_S = 5.0
_TIMEOUT = httpx2.Timeout(90.0, connect=10.0)
"""Whoever waits for jobs is answered within a minute."""
_AWAY = frozenset({429, 502, 503, 504})
_KINDS = {
    name: kind
    for name, kind in vars(sms_jobs.errors).items()
    if isinstance(kind, type) and issubclass(kind, SmsError)
}


class Connection:
    """A server's interface /api/v1, in the name of a token.

    Raises
    ------
    InvalidInput
        The URL or the token cannot be one.
    """

    def __init__(self, url: str, token: str | None) -> None:
        self.url = checked_url(url)
        headers = {} if token is None else {"Authorization": f"Bearer {checked_token(token)}"}
        self._client = httpx2.Client(base_url=self.url, headers=headers, timeout=_TIMEOUT)

    def get(self, path: str, asked: Mapping[str, Any] | None = None) -> Any:
        """Return the JSON of an address."""
        return self._read(path, asked).json()

    def get_bytes(self, path: str, asked: Mapping[str, Any] | None = None) -> bytes:
        """Return what is at an address."""
        return self._read(path, asked).content

    def post(self, path: str, body: Mapping[str, Any]) -> Any:
        """Ask for a change, once; raises `CommitInDoubt` where nobody knows whether it was made."""
        return self._change("POST", path, json=body)

    def delete(self, path: str) -> Any:
        """Ask for something to be taken away, once; raises as `post` does."""
        return self._change("DELETE", path)

    def _change(self, method: str, path: str, **given: Any) -> Any:
        try:
            return _require_success(self._client.request(method, f"{_API}{path}", **given)).json()
        except (httpx2.ConnectError, httpx2.ConnectTimeout) as error:
            raise self._unreachable(error) from error
        except httpx2.HTTPError as error:
            raise CommitInDoubt(
                f"the connection to {self.url} broke ({type(error).__name__}) while something was asked for, "
                "which may be done or not; look before you try again"
            ) from error

    def close(self) -> None:
        """Close all connections."""
        self._client.close()

    def _read(self, path: str, asked: Mapping[str, Any] | None) -> httpx2.Response:
        """Ask until there is an answer; not longer than `_PATIENCE_S` where the server is away."""
        deadline, pause = time.monotonic() + _PATIENCE_S, _PAUSE_S
        while True:
            try:
                answer = self._client.get(f"{_API}{path}", params=asked)
            except httpx2.HTTPError as error:
                if time.monotonic() + pause > deadline or _untrusted(error) is not None:
                    raise self._unreachable(error) from error
            else:
                if answer.status_code not in _AWAY or time.monotonic() + pause > deadline:
                    return _require_success(answer)
            time.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _unreachable(self, error: httpx2.HTTPError) -> SmsError:
        untrusted = _untrusted(error)
        if untrusted is not None:
            return ConfigurationError(
                f"the certificate of {self.url} is not trusted ({untrusted.verify_message}); name the "
                "certificate of who signed it in the environment as SSL_CERT_FILE"
            )
        return ServerUnreachable(
            f"{self.url} does not answer ({type(error).__name__}); look whether 'sms serve' runs there"
        )


def checked_url(url: str) -> str:
    """Return the address of a server, without a slash at its end.

    Raises `InvalidInput` for anything else, and for one to which a token would go in clear text.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise InvalidInput(f"'{_without_secrets(url)}' is no address; write it like https://lab.example.org")
    if parts.username is not None or parts.password is not None:
        raise InvalidInput("an address has no name and password in it; give a token instead")
    if parts.scheme == "http" and not _is_this_machine(parts.hostname):
        raise InvalidInput(
            f"{url} is not encrypted, so that anybody on the way could read the token; write https://"
        )
    return url.rstrip("/")


def checked_token(token: str) -> str:
    """Return a token; raise `InvalidInput`, which does not repeat it, for what cannot be one."""
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise InvalidInput("the token has characters that no token has; copy it as a whole, in one line")
    return token


def _without_secrets(url: str) -> str:
    return url.rpartition("@")[2][:100]


def _is_this_machine(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _untrusted(error: BaseException | None) -> ssl.SSLCertVerificationError | None:
    while error is not None and not isinstance(error, ssl.SSLCertVerificationError):
        error = error.__cause__ or error.__context__
    return error


def _require_success(answer: httpx2.Response) -> httpx2.Response:
    """Return an answer; raise what it says went wrong, as the same class with the same words."""
    if answer.is_success:
        return answer
    try:
        said = answer.json()
        words, name = str(said["error"]), str(said["kind"])
    except (ValueError, KeyError, TypeError):
        words, name = f"{answer.url.host} answered with status {answer.status_code}; is it sms_jobs?", ""
    fallback = ServerUnreachable if answer.status_code in _AWAY else SmsError
    raise _KINDS.get(name, NotAllowed if answer.status_code == 401 else fallback)(words)
