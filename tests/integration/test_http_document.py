"""Examples of docs/http.md are of addresses that there are, with bodies that they take."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any, cast

import pytest
from jsonschema import Draft202012Validator
from support.over_http import API, app_of

from sms_jobs.bootstrap import Services

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "http.md"
EXAMPLES = re.findall(r"^\s*(?:.*\|\s*)?(curl .*)$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)


@cache
def described() -> dict[str, Any]:
    return app_of(cast(Services, None)).openapi()


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_asks_for_what_there_is(example: str) -> None:
    said = described()
    found = re.search(r"\$sms(/[^\s\"?]*)", example)
    assert found, example
    body = re.search(r"-d (?:'(\{.*\})'|\"(\{.*\})\")", example)
    method = re.search(r"-X (\w+)", example)
    name = method[1].lower() if method else "post" if " -d " in example else "get"
    asked = API + found[1].replace("$upload", "u0")
    fitting = [
        path
        for path, methods in said["paths"].items()
        if name in methods and re.fullmatch(re.sub(r"\{[^}]*\}", "[^{}]+", path), asked)
    ]
    assert fitting, example
    if body is None:
        return
    exact = min(fitting, key=lambda path: path.count("{"))
    schema = said["paths"][exact][name]["requestBody"]["content"]["application/json"]["schema"]
    given = json.loads(body[1] or body[2].replace('\\"', '"').replace("$upload", "u" + "0" * 24))
    Draft202012Validator({**schema, "components": said["components"]}).validate(given)
