# rsltrace with ROS 2 Jazzy's rclpy as wheels: docker build -t rsltrace .
#   docker run --rm -it -v "$PWD:/work" rsltrace record job.yaml -o run.mcap
FROM python:3.12-slim-bookworm

# git: for the version of the checkout, and for rsltrace bisect
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends git \
    && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN python -m pip install --no-cache-dir "/src[ros,view,tables]" && rm -rf /src

WORKDIR /work
ENTRYPOINT ["rsltrace"]
CMD ["--help"]
