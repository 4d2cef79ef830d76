# docker build --tag caryatid .        docs/start.md says how to run it
FROM python:3.11-slim AS build
WORKDIR /clone
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.11-slim
COPY constraints.txt /tmp/
COPY --from=build /wheels /tmp/wheels
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt "$(echo /tmp/wheels/*.whl)[view]" \
    && useradd --create-home --uid 1000 caryatid \
    && install --directory --owner=caryatid /work
USER 1000
# Compile the kernels once, into the user's cache, and not in each container.
RUN python -m caryatid.simulation.warm_up
WORKDIR /work
EXPOSE 8770
ENTRYPOINT ["caryatid"]
