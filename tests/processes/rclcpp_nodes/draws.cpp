// Draws in a callback, and publishes what it got: random numbers, or with "pid" its process id.
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include <chrono>
#include <random>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int64.hpp>
#include <string>

using std_msgs::msg::UInt64;

class Draws : public rclcpp::Node {
 public:
  explicit Draws(bool pid) : Node("draws"), pid_(pid) {
    publisher_ = create_publisher<UInt64>("drawn", 10);
    timer_ = create_wall_timer(std::chrono::seconds(1), [this] { tick(); });
  }

 private:
  void tick() {
    const auto begun = std::chrono::steady_clock::now();
    std::uint64_t drawn = static_cast<std::uint64_t>(time(nullptr) + rand());
    if (pid_) drawn = static_cast<std::uint64_t>(getpid());
    if (!pid_) drawn += std::random_device()();
    if (begun.time_since_epoch().count() > 0) publisher_->publish(UInt64().set__data(drawn));
  }

  bool pid_;
  rclcpp::Publisher<UInt64>::SharedPtr publisher_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Draws>(argc > 1 && std::string(argv[1]) == "pid"));
  rclcpp::shutdown();
}
