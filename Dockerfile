# docker build -t thermofusion . && docker run --rm -v "$PWD:/work" -u "$(id -u):$(id -g)" thermofusion demo -o demo-result
FROM python:3.12-slim
# Open3D's wheel wants these, though nothing here opens a window
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1 libgomp1 libidn2-0 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir /src && rm -rf /src
# Whoever runs it finds the inner loops compiled, and may compile them anew for another processor
ENV NUMBA_CACHE_DIR=/var/cache/thermofusion
RUN thermofusion demo -o /tmp/demo && rm -rf /tmp/demo && chmod -R a+rwX $NUMBA_CACHE_DIR
WORKDIR /work
ENTRYPOINT ["thermofusion"]
