# One image for every process of the service; docker-compose.yml names which one a container runs.
FROM python:3.11-slim AS service

COPY requirements/service.lock /tmp/service.lock
RUN pip install --no-cache-dir --disable-pip-version-check --require-hashes -r /tmp/service.lock && rm /tmp/service.lock

WORKDIR /opt/eitskin
COPY skin skin.toml ./
COPY protocol protocol
COPY services services
COPY models models
COPY bridges bridges
COPY firmware_stub firmware_stub
# Bytecode now: the file system is read-only at run time.
RUN python -m compileall -q protocol services models bridges firmware_stub && chmod 755 skin

ENV PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 EITSKIN_RUNTIME=/run/eitskin
USER 1000:1000
CMD ["python", "-m", "services.publisher"]

# The same with what a bridge needs: `target` in docker-compose.yml.
FROM service AS bridge
ARG BRIDGE=ros2
USER 0:0
COPY requirements/${BRIDGE}.lock /tmp/bridge.lock
RUN pip install --no-cache-dir --disable-pip-version-check --require-hashes -r /tmp/bridge.lock && rm /tmp/bridge.lock
USER 1000:1000
# What is built where no stage is named.
FROM service
