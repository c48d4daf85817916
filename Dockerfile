# legged_mw on CUDA. torch and warp bring their CUDA libraries; the host brings the driver (nvidia-container-toolkit).
#   docker build -t legged_mw .
#   docker run --gpus all --rm -v legged_mw_kernels:/cache legged_mw                     # doctor: what it finds
#   docker run --gpus all --rm -v legged_mw_kernels:/cache -v "$PWD/logs:/data/logs" legged_mw train --task go1_flat
#   docker run --gpus all --rm -v "$PWD/logs:/data/logs" -p 8080:8080 legged_mw play --task go1_flat --viewer web --host 0.0.0.0 --port 8080
FROM python:3.12-slim-bookworm

# what MuJoCo draws through: the GPU's EGL where the toolkit mounts it, else Mesa's
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libegl-mesa0 libgl1 libosmesa6 && rm -rf /var/lib/apt/lists/*

# graphics too, not compute alone; compiled kernels outside of the image; any user may write both
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=all WARP_CACHE_PATH=/cache MPLCONFIGDIR=/tmp/matplotlib HOME=/tmp
RUN mkdir --mode=777 /cache /data

COPY pyproject.toml README.md LICENSE constraints.txt /src/
COPY legged_mw /src/legged_mw
COPY configs /src/configs
COPY resources /src/resources
RUN pip install --no-cache-dir --constraint /src/constraints.txt "/src[deploy,video]" && rm -rf /src/build && legged-mw --version

WORKDIR /data
ENTRYPOINT ["legged-mw"]
CMD ["doctor"]
