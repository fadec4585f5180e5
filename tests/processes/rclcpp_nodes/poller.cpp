// A loop at 50 Hz that looks what there is for eight subscriptions, two timers and a service: with the
// executor and the call that are named (single, static, multi, events; some, all, once).
#include <cstdlib>
#include <rclcpp/experimental/executors/events_executor/events_executor.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int64.hpp>
#include <std_srvs/srv/trigger.hpp>

using std_msgs::msg::UInt64;
using std_srvs::srv::Trigger;
using namespace std::chrono_literals;

namespace {

constexpr int TOPICS = 8;

void source() {
  auto node = std::make_shared<rclcpp::Node>("source");
  std::vector<rclcpp::Publisher<UInt64>::SharedPtr> topics;
  for (int i = 0; i < TOPICS; i++)
    topics.push_back(node->create_publisher<UInt64>("t" + std::to_string(i), 1));
  auto ask = node->create_client<Trigger>("ask");
  std::uint64_t count = 0;
  auto timer = node->create_wall_timer(20ms, [&] {
    UInt64 message;
    message.data = ++count;
    for (auto &topic : topics) topic->publish(message);
    if (count % 10 == 0) ask->async_send_request(std::make_shared<Trigger::Request>());
  });
  rclcpp::spin(node);
}

std::shared_ptr<rclcpp::Executor> executor(const std::string &name) {
  if (name == "static") return std::make_shared<rclcpp::executors::StaticSingleThreadedExecutor>();
  if (name == "multi") return std::make_shared<rclcpp::executors::MultiThreadedExecutor>();
  if (name == "events") return std::make_shared<rclcpp::experimental::executors::EventsExecutor>();
  return std::make_shared<rclcpp::executors::SingleThreadedExecutor>();
}

void poll(const std::string &name, const std::string &call) {
  auto node = std::make_shared<rclcpp::Node>("poller");
  auto seen = node->create_publisher<UInt64>("seen", 100);
  const auto say = [seen](std::uint64_t number) {
    UInt64 message;
    message.data = number;
    seen->publish(message);
  };
  std::vector<rclcpp::SubscriptionBase::SharedPtr> topics;
  for (int i = 0; i < TOPICS; i++)
    topics.push_back(node->create_subscription<UInt64>(
        "t" + std::to_string(i), 1, [=](UInt64::ConstSharedPtr) { say(i); }));
  std::vector<rclcpp::TimerBase::SharedPtr> timers;
  for (int i = 0; i < 2; i++)
    timers.push_back(node->create_wall_timer(20ms, [=] { say(10 + i); }));
  auto service = node->create_service<Trigger>(
      "ask", [=](Trigger::Request::SharedPtr, Trigger::Response::SharedPtr) { say(20); });
  auto spins = executor(name);
  spins->add_node(node);
  rclcpp::WallRate rate(50.0);
  while (rclcpp::ok()) {
    if (call == "some") spins->spin_some();
    if (call == "all") spins->spin_all(5ms);
    for (int i = 0; call == "once" && i < 3 * TOPICS; i++) spins->spin_once(0ns);
    rate.sleep();
  }
}

}  // namespace

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  const auto arguments = rclcpp::remove_ros_arguments(argc, argv);
  if (arguments.at(1) == "source") {
    source();
  } else {
    poll(arguments.at(1), arguments.at(2));
  }
  return 0;
}
