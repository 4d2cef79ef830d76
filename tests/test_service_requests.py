"""Requests made up from the service's own OpenAPI page: whatever is asked, no fault and no hang."""

from __future__ import annotations

import pytest
import schemathesis
from conftest import npy
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from test_service import TOKEN, body, serving, text

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
    app = make_app(SessionPool(folder, Config(), 2, 8), token=TOKEN, max_request=1_000_000)
    page = schemathesis.openapi.from_asgi("/openapi.json", app, headers=HEADERS)
    return [operation.ok() for operation in page.get_all_operations()]


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
@pytest.mark.parametrize("index", range(9))
def test_whatever_is_asked_the_answer_is_one_that_was_announced(operations, index, mode):
    """Of a session that is there and of others; what is sent fits the page, or does not."""
    assert len(operations) == 9
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


NUMBERS = st.one_of(st.floats(-3.0, 3.0), st.floats(allow_nan=False, allow_infinity=False, width=32))


@st.composite
def odd_views(draw, view):
    """A view with something odd about its camera or its images."""
    K, T = view.K.tolist(), view.pose.tolist()
    for matrix in (K, T):
        for _ in range(draw(st.integers(0, 2))):
            row = draw(st.integers(0, len(matrix) - 1))
            matrix[row][draw(st.integers(0, len(matrix) - 1))] = draw(NUMBERS)
    camera = {"K": K, "T_world_camera": T, "depth_scale": draw(st.floats(1e-300, 1e300))}
    depth = view.depth * draw(st.sampled_from([1.0, 0.0, 1e-3, 5.0, 1e3, 1e30]))
    height, width = draw(st.sampled_from([depth.shape, (1, 1), (2, 160), (120, 2), (60, 80)]))
    changes = {"camera": camera}
    if draw(st.booleans()):
        changes["depth"] = text(npy(depth[:height, :width]))
    if draw(st.booleans()):
        changes["labels"] = None
    return body(view, **changes)


@pytest.mark.parametrize("first", [True, False])
def test_views_with_odd_cameras_are_taken_or_refused(tmp_path, views, first):
    codes = set()
    with serving(tmp_path) as client:
        client.post("/sessions", json={"name": "table"})
        if not first:
            client.post("/sessions/table/views", json=body(views[0]))

        @settings(HURRIED, max_examples=60)
        @given(odd=odd_views(views[1]))
        def send(odd):
            answer = client.post("/sessions/table/views", json=odd)
            assert answer.status_code in (201, 422), answer.text
            if answer.status_code == 201:
                assert client.delete("/sessions/table/views/last").status_code == 200
            codes.add(answer.status_code)

        send()
    assert codes == {201, 422}
