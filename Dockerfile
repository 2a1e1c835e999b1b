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
ARG BRIDGE=foxglove
USER 0:0
COPY requirements/${BRIDGE}.lock /tmp/bridge.lock
RUN pip install --no-cache-dir --disable-pip-version-check --require-hashes -r /tmp/bridge.lock && rm /tmp/bridge.lock
USER 1000:1000
# A ROS node for each skin, with ROS 2 from PyPI's wheels; where a robot's own ROS runs it, no image of ours is needed.
FROM python:3.11-slim AS ros2-built
RUN apt-get update && apt-get install -y --no-install-recommends g++ make python3-dev
WORKDIR /opt/eitskin
COPY Makefile pyproject.toml README.md LICENSE ./
COPY protocol protocol
COPY bridges/ros2 bridges/ros2
COPY tests/bridges/tf2_msgs tests/bridges/tf2_msgs
RUN make ros-venv PYTHON=python

FROM python:3.11-slim AS ros2
COPY --from=ros2-built /opt/eitskin/.venv-ros /opt/eitskin/.venv-ros
ENV PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1 EITSKIN_RUNTIME=/run/eitskin ROS_LOG_DIR=/tmp HOME=/tmp
USER 1000:1000
CMD ["/opt/eitskin/.venv-ros/lib/eitskin_ros/skin"]

# What is built where no stage is named.
FROM service
