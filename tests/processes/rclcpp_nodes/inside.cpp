// A node that talks to itself with intra-process communication.
#include <chrono>
#include <functional>
#include <memory>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int64.hpp>

using std_msgs::msg::UInt64;

struct Listener {
  void hear(UInt64::UniquePtr) {}
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  const auto options = rclcpp::NodeOptions().use_intra_process_comms(true);
  const auto node = std::make_shared<rclcpp::Node>("inside", options);
  const auto publisher = node->create_publisher<UInt64>("count", 10);
  Listener listener;
  const auto heard = node->create_subscription<UInt64>(
      "count", 10, std::bind(&Listener::hear, &listener, std::placeholders::_1));
  const auto timer = node->create_wall_timer(std::chrono::milliseconds(100), [&] {
    publisher->publish(std::make_unique<UInt64>());
  });
  rclcpp::spin(node);
}
