// A planted bug: it follows the first of the obstacles in an unordered_map keyed by pointers.
#include <memory>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/string.hpp>
#include <string>
#include <unordered_map>
#include <vector>

using std_msgs::msg::String;

struct Obstacle {
  std::string name;
};

class Tracker : public rclcpp::Node {
 public:
  Tracker() : Node("tracker") {
    publisher_ = create_publisher<String>("followed", 10);
    timer_ = create_wall_timer(std::chrono::milliseconds(500), [this] { follow(); });
  }

 private:
  void follow() {
    obstacles_.push_back(std::make_unique<Obstacle>(Obstacle{"obstacle " + std::to_string(obstacles_.size())}));
    std::unordered_map<const Obstacle *, double> weights;
    for (const auto &one : obstacles_) weights[one.get()] = 1.0;
    publisher_->publish(String().set__data(weights.begin()->first->name));
  }

  std::vector<std::unique_ptr<Obstacle>> obstacles_;
  rclcpp::Publisher<String>::SharedPtr publisher_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Tracker>());
  rclcpp::shutdown();
}
