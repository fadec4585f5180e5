# rsltrace with ROS 2 Jazzy's rclpy as wheels: docker build -t rsltrace .
#   docker run --rm -it -v "$PWD:/work" rsltrace record job.yaml -o run.mcap
FROM python:3.12-slim-bookworm

COPY . /src
RUN python -m pip install --no-cache-dir "/src[ros,view,tables]" && rm -rf /src

WORKDIR /work
ENTRYPOINT ["rsltrace"]
CMD ["--help"]
