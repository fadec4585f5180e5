#!/bin/sh
# The repository that docs/bisect.md shows, in the present folder: every commit has one hash, everywhere.
set -e
export GIT_CONFIG_GLOBAL=/dev/null GIT_CONFIG_NOSYSTEM=1 GIT_DEFAULT_HASH=sha1
export GIT_AUTHOR_NAME=Ada GIT_AUTHOR_EMAIL=ada@example.org
export GIT_COMMITTER_NAME=Ada GIT_COMMITTER_EMAIL=ada@example.org
export GIT_AUTHOR_DATE='2026-11-22T12:00:00+0000' GIT_COMMITTER_DATE='2026-11-22T12:00:00+0000'

commit() {
    git add --all
    git commit -q -m "$1"
}

say_more() {
    for number in "$@"; do
        echo "More of it ($number)." >> README.md
        commit "Say more ($number)"
    done
}

cat > odometry.py <<'END'
from rclpy.node import Node
from std_msgs.msg import Float64

RADIUS = 0.165


class Wheels(Node):
    def __init__(self):
        super().__init__("wheels")
        self.turning = 0.0
        self.speed = self.create_publisher(Float64, "speed", 10)
        self.create_timer(0.1, self.turn)

    def turn(self):
        self.turning += 0.01
        self.speed.publish(Float64(data=self.turning))


class Odometry(Node):
    def __init__(self):
        super().__init__("odometry")
        self.way = 0.0
        self.odom = self.create_publisher(Float64, "odom", 10)
        self.create_subscription(Float64, "speed", self.on_speed, 10)

    def on_speed(self, message):
        self.way += RADIUS * message.data * 0.1
        self.odom.publish(Float64(data=self.way))
END
cat > job.yaml <<'END'
nodes:
  - node: odometry:Wheels
  - node: odometry:Odometry
stop: {duration: 2s}
END
printf 'Wheels and odometry.\n' > README.md
git init -q -b main
commit 'Wheels and odometry'
git tag v1
say_more 1 2 3
git branch half
sed -i 's/0.165/0.1675/' odometry.py
commit 'Measure the wheels again'
say_more 4 5 6

git checkout -q half
sed -i 's/^from std_msgs/import nothing_there\n&/' odometry.py
commit 'Half a change'
sed -i '/nothing_there/d; s/0.165/0.1675/' odometry.py
commit 'Measure the wheels again'
say_more 4 5 6
git checkout -q main
