# geomoe3d in a container that needs no root and no home folder. Engines without root (podman, rootless docker) build it
# too. Results belong to whoever runs it:
#
#     docker build -t geomoe3d .
#     docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" geomoe3d register source.ply target.ply --output T.txt
#
# On a machine without GPU, --build-arg TORCH_INDEX=URL takes PyTorch from an index of builds for processors, which are
# smaller; PyTorch's installation page names it.
FROM python:3.12-slim

ARG TORCH_INDEX=""
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONDONTWRITEBYTECODE=1

WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY configs ./configs
COPY geomoe3d ./geomoe3d
RUN pip install ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$(grep '^torch==' constraints.txt)"
RUN pip install --constraint constraints.txt ".[las,e57]"
RUN apt-get update \
 && apt-get install --yes --no-install-recommends $(python -m geomoe3d.doctor --apt) \
 && rm -rf /var/lib/apt/lists/*

ENV HOME=/tmp
WORKDIR /data
USER 65534:65534
ENTRYPOINT ["geomoe3d"]
CMD ["--help"]
