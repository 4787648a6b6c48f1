"""Clients in other languages rely on /v1: whoever changes it says so in the changelog."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import jsonschema
import pytest

from contract import CHANGELOG, UPDATE, changed, stored, unnamed
from mapvote_server.api.app import create_app
from stores import NewStore


@pytest.fixture
def document(new_store: NewStore) -> dict[str, Any]:
    return create_app(new_store()).openapi()


def test_what_changes_in_v1_is_named_in_the_changelog(document: dict[str, Any]) -> None:
    lacking = unnamed(changed(stored(), document), CHANGELOG.read_text())
    assert lacking == [], f"name these operations in the newest section of CHANGELOG.md, then run: {UPDATE}"


def test_an_operation_that_came_went_or_differs_is_a_change_and_prose_is_none(document: dict[str, Any]) -> None:
    """The check above can fail."""
    other = copy.deepcopy(document)
    other["paths"]["/v1/info"]["get"]["summary"] = "other words"
    other["components"]["schemas"]["Info"]["description"] = "other words"
    assert changed(document, other) == []
    other["paths"]["/v1/new"] = {"get": other["paths"]["/v1/info"].pop("get")}
    del other["components"]["schemas"]["Receipt"]["properties"]["seq"]
    lacking = changed(document, other)
    assert lacking == ["GET /v1/info", "GET /v1/new", "PUT /v1/ballots/{vehicle}/{drive}"]
    named = "# Changelog\n\n## 2\n\n- `GET /v1/new` replaces `GET /v1/info`.\n\n## 1\n\n- `PUT /v1/ballots/a/b`\n"
    assert unnamed(lacking, named) == ["PUT /v1/ballots/{vehicle}/{drive}"]


def test_the_stored_copy_cannot_be_empty() -> None:
    assert len(stored()["paths"]) > 30


def valid(example: Any, schema: Mapping[str, Any], document: Mapping[str, Any]) -> None:
    checker = jsonschema.Draft202012Validator({**schema, "components": document["components"]})
    assert [error.message for error in checker.iter_errors(example)] == []


def test_every_operation_that_answers_json_has_an_example_and_all_examples_are_as_declared(
    document: dict[str, Any],
) -> None:
    without = []
    for operations in document["paths"].values():
        for operation in operations.values():
            bodies = [operation.get("requestBody", {}), *operation["responses"].values()]
            for content in (body.get("content", {}).get("application/json") for body in bodies):
                if content is not None and "example" in content:
                    valid(content["example"], content["schema"], document)
                elif content is not None and content["schema"]:
                    without.append(operation["operationId"])
            for parameter in operation.get("parameters", ()):
                if "example" in parameter:
                    valid(parameter["example"], parameter["schema"], document)
                assert "example" in parameter or not parameter["required"], parameter["name"]
    assert without == ["cancel_publish"], "nothing is being published where examples are recorded"
