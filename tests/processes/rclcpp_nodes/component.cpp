// A component: it counts from a parameter, and logs what it hears.
#include <chrono>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_components/register_node_macro.hpp>
#include <std_msgs/msg/u_int64.hpp>

namespace tried {

class Counter : public rclcpp::Node {
 public:
  explicit Counter(const rclcpp::NodeOptions &options) : Node("unnamed", options) {
    count_ = declare_parameter("first", 0);
    publisher_ = create_publisher<std_msgs::msg::UInt64>("count", 10);
    subscription_ = create_subscription<std_msgs::msg::UInt64>(
        "other", 10, [this](const std_msgs::msg::UInt64 &message) {
          RCLCPP_INFO(get_logger(), "heard %lu", message.data);
        });
    timer_ = create_wall_timer(std::chrono::milliseconds(500), [this] {
      publisher_->publish(std_msgs::msg::UInt64().set__data(static_cast<std::uint64_t>(count_++)));
    });
  }

 private:
  std::int64_t count_;
  rclcpp::Publisher<std_msgs::msg::UInt64>::SharedPtr publisher_;
  rclcpp::Subscription<std_msgs::msg::UInt64>::SharedPtr subscription_;
  rclcpp::TimerBase::SharedPtr timer_;
};

}  // namespace tried

RCLCPP_COMPONENTS_REGISTER_NODE(tried::Counter)
