# One image for all services of a lab. `docker build --build-arg PARTS=all .` adds the viewer and studies (1 GB more); PARTS is a
# list of extras, see docs/operations.md.
ARG PYTHON=3.11.11-slim-bookworm

FROM python:${PYTHON} AS build
ARG PARTS=console,rig
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE NOTICE ./
COPY schemas schemas
COPY runtime runtime
COPY services services
COPY tools tools
COPY examples examples
COPY compose compose
COPY exercises exercises
# The installers are not needed at run time.
RUN python -m venv /opt/hilrig \
    && /opt/hilrig/bin/pip install --no-cache-dir --constraint constraints.txt ".[${PARTS}]" \
    && /opt/hilrig/bin/pip uninstall --yes setuptools pip

FROM python:${PYTHON}
COPY --from=build /opt/hilrig /opt/hilrig
ENV PATH=/opt/hilrig/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 MPLCONFIGDIR=/tmp
# The services run as this user; the folders of certificates and recordings must belong to it.
RUN useradd --create-home --uid 10001 hilrig && mkdir /certs /recordings && chown hilrig /certs /recordings
USER 10001:10001
STOPSIGNAL SIGTERM
CMD ["hilrig", "--help"]
