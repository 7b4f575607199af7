# This image has not been built yet.
FROM python:3.11-slim AS wheel
RUN apt-get update && apt-get install -y --no-install-recommends g++
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu torch==2.13.0 \
 && pip install --no-cache-dir -r requirements/product.txt -r requirements/dev.txt \
 && SPLATMAKE_PREBUILT=1 python -m build --wheel --no-isolation

FROM python:3.11-slim
COPY --from=wheel /source/dist/*.whl /source/requirements/product.txt /tmp/
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu torch==2.13.0 \
 && pip install --no-cache-dir -r /tmp/product.txt && pip install --no-cache-dir /tmp/*.whl \
 && rm /tmp/*.whl /tmp/product.txt
WORKDIR /work
ENTRYPOINT ["splatmake"]
