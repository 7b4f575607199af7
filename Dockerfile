FROM python:3.11-slim AS wheel
RUN apt-get update && apt-get install -y --no-install-recommends g++
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir build setuptools==84.2.1 torch==2.13.0 numpy==2.4.6 \
 && SPLATMAKE_PREBUILT=1 python -m build --wheel --no-isolation

FROM python:3.11-slim
COPY --from=wheel /source/dist/*.whl /tmp/
RUN pip install --no-cache-dir /tmp/*.whl && rm /tmp/*.whl
WORKDIR /work
ENTRYPOINT ["splatmake"]
