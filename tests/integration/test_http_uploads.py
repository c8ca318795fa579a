"""Files are sent over HTTP and imported; slow and endless requests are refused."""

from __future__ import annotations

import hashlib
import io
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2
import numpy as np
import pytest
from PIL import Image
from support.over_http import API, app_of, served

from sms_jobs import bootstrap
from sms_jobs.web import protection


@pytest.fixture
def client(home: Path) -> Iterator[httpx2.Client]:
    """A client of an empty home."""
    bootstrap.initialise(home)
    with bootstrap.services(home, "web") as services, served(app_of(services)) as asking:
        yield asking


def send(client: httpx2.Client, upload: str, name: str, content: bytes, offset: int = 0) -> httpx2.Response:
    headers = {"X-Content-SHA256": hashlib.sha256(content).hexdigest()}
    return client.put(f"uploads/{upload}/{name}", content=content, params={"offset": offset}, headers=headers)


def image(rng: np.random.Generator) -> bytes:
    """Return an image of a speckled coupon, as PNG."""
    written = io.BytesIO()
    Image.fromarray(rng.integers(0, 255, (64, 64), dtype=np.uint8)).save(written, "png")
    return written.getvalue()


def test_images_are_sent_and_imported(client: httpx2.Client, rng: np.random.Generator) -> None:
    upload = client.post("uploads").json()["id"]
    for number in range(2):
        content = image(rng)
        assert send(client, upload, f"coupon/load_{number}.png", content[:1000]).status_code == 200
        assert send(client, upload, f"coupon/load_{number}.png", content[1000:], 1000).status_code == 200
    asked = {"upload": upload, "folder": "coupon", "campaign": "coupon", "alone": True}
    lines = client.post("imports/images", json=asked).text.splitlines()
    answer = json.loads(lines[-1])["answer"]
    assert [(one["state"], one["outcome"]) for one in answer["tuples"]] == [
        ("0", "imported"),
        ("1", "imported"),
    ]
    assert client.get("campaigns/coupon").json()["campaign"]["views"] == ["C1"]
    send(client, upload, "log.csv", b"state,load[kN]\n0,1.5\n1,2.5\n")
    read = client.post("imports/readings", json={"upload": upload, "file": "log.csv", "campaign": "coupon"})
    assert read.json()["states"] == ["0", "1"]
    assert client.delete(f"uploads/{upload}").status_code == 204


def test_a_refusal_does_not_tell_where_the_spool_lies(client: httpx2.Client, home: Path) -> None:
    upload = client.post("uploads").json()["id"]
    send(client, upload, "log.csv", b"no table")
    for subject, body in (
        ("calibration", {"files": ["log.csv"]}),
        ("surface", {"file": "log.csv", "campaign": "none"}),
        ("images", {"campaign": "none"}),
        ("readings", {"file": "other.csv", "campaign": "none"}),
    ):
        refused = client.post(f"imports/{subject}", json={"upload": upload} | body)
        assert refused.status_code in (404, 422), subject
        assert str(home) not in refused.text


def test_a_body_that_trickles_is_given_up(client: httpx2.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protection, "_RECEIVED_WITHIN_S", 0.5)
    with socket.create_connection((client.base_url.host, client.base_url.port or 0), timeout=10.0) as raw:
        head = f"POST {API}/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        raw.sendall(f"{head}Content-Length: 1000\r\n\r\n".encode() + b"{")
        began = time.monotonic()
        answer = raw.recv(4096)
    assert b"408" in answer.splitlines()[0]
    assert time.monotonic() - began < 5.0


def test_a_body_without_end_is_refused(client: httpx2.Client) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(40):
            yield bytes(1 << 20)

    try:
        answer = client.post("jobs", content=endless(), headers={"Content-Type": "application/json"})
    except (httpx2.WriteError, httpx2.ReadError):
        return  # the server hung up while it was still being sent
    assert answer.status_code == 413
    assert "larger" in answer.json()["error"]


def test_head_is_answered_as_get_without_a_body(client: httpx2.Client) -> None:
    assert client.head("status").status_code == 200
    assert client.head("status").content == b""
    assert client.head("jobs/none").status_code == 404
    addresses = {(one["method"], one["path"]) for one in client.get("", follow_redirects=True).json()}
    assert {("GET", "/status"), ("POST", "/uploads"), ("DELETE", "/session")} <= addresses
