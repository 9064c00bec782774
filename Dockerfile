# One image a service: `docker build --build-arg PARTS=sim .` (sim, edge, recorder, or all for the command line's tools).
FROM python:3.11-slim AS build
ARG PARTS=all
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY schemas schemas
COPY runtime runtime
COPY services services
COPY tools tools
COPY examples examples
RUN python -m venv /opt/hilrig \
    && /opt/hilrig/bin/pip install --no-cache-dir --constraint constraints.txt ".[${PARTS}]"

FROM python:3.11-slim
COPY --from=build /opt/hilrig /opt/hilrig
ENV PATH=/opt/hilrig/bin:$PATH PYTHONUNBUFFERED=1
# The recorder writes to /recordings: give the folder that is mounted there to this user.
RUN useradd --create-home --uid 10001 hilrig && mkdir /recordings && chown hilrig /recordings
USER hilrig
STOPSIGNAL SIGTERM
CMD ["hilrig", "--help"]
