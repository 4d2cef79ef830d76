"""Requests made up from the service's own OpenAPI page: whatever is asked, no fault and no hang."""

from __future__ import annotations

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from test_service import TOKEN

from caryatid.config import Config
from caryatid.service import SessionPool, make_app
from caryatid.sessions import Session

pytestmark = pytest.mark.slow

PATIENCE = 20.0
"""An answer that takes longer counts as none [s]; the slowest takes a fiftieth of it."""

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
HEADERS = {"Authorization": f"Bearer {TOKEN}"}
HURRIED = settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    database=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture(scope="module")
def operations(tmp_path_factory, views):
    """All requests that a service announces, which has a session of two views."""
    folder = tmp_path_factory.mktemp("service")
    with Session.begin(folder / "table") as session:
        for view in views[:2]:
            session.add(view)
    app = make_app(SessionPool(folder, Config(), 2), token=TOKEN, max_request=1_000_000, waiting=8)
    page = schemathesis.openapi.from_asgi("/openapi.json", app, headers=HEADERS)
    return [operation.ok() for operation in page.get_all_operations()]


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
@pytest.mark.parametrize("index", range(13))
def test_whatever_is_asked_the_answer_is_one_that_was_announced(operations, index, mode):
    """Of a session that is there and of others; what is sent fits the page, or does not."""
    assert len(operations) == 13
    operation = operations[index]
    there = {"path_parameters": {"name": "table"}} if "{name}" in operation.path else {}
    asked = []
    for options in [there, {}] if there else [{}]:

        @HURRIED
        @given(case=operation.as_strategy(generation_mode=mode, **options))
        def ask(case):
            answer = case.call(headers=HEADERS, timeout=PATIENCE)
            case.validate_response(answer, checks=CHECKS)
            assert answer.elapsed < PATIENCE
            asked.append(answer.status_code)

        try:
            ask()
        except Unsatisfiable:
            assert mode is GenerationMode.NEGATIVE, "what fits the page can always be made up"
    assert asked or mode is GenerationMode.NEGATIVE
