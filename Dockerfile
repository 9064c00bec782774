# One image per service: `docker build --build-arg PARTS=sim .` (router, sim, edge, recorder, console; all: every command).
ARG PYTHON=3.11.11-slim-bookworm

FROM python:${PYTHON} AS build
ARG PARTS=all
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY schemas schemas
COPY runtime runtime
COPY services services
COPY tools tools
COPY examples examples
# The installers are not needed at run time.
RUN python -m venv /opt/hilrig \
    && /opt/hilrig/bin/pip install --no-cache-dir --constraint constraints.txt ".[${PARTS}]" \
    && /opt/hilrig/bin/pip uninstall --yes setuptools pip

FROM python:${PYTHON}
COPY --from=build /opt/hilrig /opt/hilrig
ENV PATH=/opt/hilrig/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
# The recorder writes to /recordings: the folder mounted there, and the certificates, must belong to this user.
RUN useradd --create-home --uid 10001 hilrig && mkdir /recordings && chown hilrig /recordings
USER 10001:10001
STOPSIGNAL SIGTERM
CMD ["hilrig", "--help"]
