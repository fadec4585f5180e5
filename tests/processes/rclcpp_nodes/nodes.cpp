// Nodes of rclcpp with most of what rclcpp has: tied timers, parameters, a service and its client, a
// latched topic, and a listener whose executor runs in a thread of its own, as tf2's does.
//
// Usage: nodes single|multi|static|events
#include <chrono>
#include <memory>
#include <rclcpp/experimental/executors/events_executor/events_executor.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int64.hpp>
#include <std_srvs/srv/set_bool.hpp>
#include <string>
#include <thread>

using namespace std::chrono_literals;
using std_msgs::msg::UInt64;
using std_srvs::srv::SetBool;

class Talker : public rclcpp::Node {
 public:
  Talker() : Node("talker") {
    step_ = declare_parameter("step", 1);
    publisher_ = create_publisher<UInt64>("count", 10);
    latched_ = create_publisher<UInt64>("latched", rclcpp::QoS(1).transient_local());
    latched_->publish(UInt64().set__data(42));
    fast_ = create_wall_timer(100ms, [this] { tick(1); });
    slow_ = create_timer(200ms, [this] { tick(1000); });
    service_ = create_service<SetBool>(
        "enable", [this](SetBool::Request::SharedPtr asked, SetBool::Response::SharedPtr answer) {
          enabled_ = asked->data;
          answer->success = true;
          answer->message = enabled_ ? "on" : "off";
        });
    handle_ = add_on_set_parameters_callback([this](const std::vector<rclcpp::Parameter> &all) {
      for (const auto &one : all)
        if (one.get_name() == "step") step_ = one.as_int();
      return rcl_interfaces::msg::SetParametersResult().set__successful(true);
    });
  }

 private:
  void tick(std::uint64_t by) {
    count_ += by * static_cast<std::uint64_t>(step_);
    if (enabled_) publisher_->publish(UInt64().set__data(count_));
  }

  std::int64_t step_ = 1;
  std::uint64_t count_ = 0;
  bool enabled_ = true;
  rclcpp::Publisher<UInt64>::SharedPtr publisher_, latched_;
  rclcpp::TimerBase::SharedPtr fast_, slow_;
  rclcpp::Service<SetBool>::SharedPtr service_;
  OnSetParametersCallbackHandle::SharedPtr handle_;
};

class Listener : public rclcpp::Node {
 public:
  Listener() : Node("listener") {
    group_ = create_callback_group(rclcpp::CallbackGroupType::Reentrant);
    rclcpp::SubscriptionOptions options;
    options.callback_group = group_;
    heard_ = create_subscription<UInt64>(
        "count", 10,
        [this](const UInt64 &message) {
          rclcpp::sleep_for(1ms);  // others may run meanwhile, if there are threads
          RCLCPP_INFO(get_logger(), "heard %lu at %ld", message.data, now().nanoseconds());
        },
        options);
    client_ = create_client<SetBool>("enable");
    timer_ = create_wall_timer(500ms, [this] { ask(); });
    parameters_ = std::make_shared<rclcpp::AsyncParametersClient>(this, "talker");
  }

 private:
  void ask() {
    on_ = !on_;
    auto request = std::make_shared<SetBool::Request>();
    request->data = on_;
    client_->async_send_request(request, [this](rclcpp::Client<SetBool>::SharedFuture future) {
      RCLCPP_INFO(get_logger(), "it is %s", future.get()->message.c_str());
      if (!on_) parameters_->set_parameters({rclcpp::Parameter("step", ++step_)});
    });
  }

  bool on_ = true;
  std::int64_t step_ = 1;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::Subscription<UInt64>::SharedPtr heard_;
  rclcpp::Client<SetBool>::SharedPtr client_;
  rclcpp::TimerBase::SharedPtr timer_;
  std::shared_ptr<rclcpp::AsyncParametersClient> parameters_;
};

// Spins a callback group of a node in a thread of its own.
class ThreadedListener {
 public:
  explicit ThreadedListener(const rclcpp::Node::SharedPtr &node) {
    group_ = node->create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive, false);
    rclcpp::SubscriptionOptions options;
    options.callback_group = group_;
    latched_ = node->create_subscription<UInt64>(
        "latched", rclcpp::QoS(1).transient_local(), [node](const UInt64 &message) {
          RCLCPP_INFO(node->get_logger(), "latched %lu", message.data);
        }, options);
    heard_ = node->create_subscription<UInt64>(
        "count", 10, [node](const UInt64 &message) {
          if (message.data % 2 == 0) RCLCPP_INFO(node->get_logger(), "even %lu", message.data);
        }, options);
    executor_ = std::make_shared<rclcpp::executors::SingleThreadedExecutor>();
    executor_->add_callback_group(group_, node->get_node_base_interface());
    thread_ = std::thread([this] { executor_->spin(); });
  }
  ~ThreadedListener() {
    executor_->cancel();
    thread_.join();
  }

 private:
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::Subscription<UInt64>::SharedPtr latched_, heard_;
  rclcpp::Executor::SharedPtr executor_;
  std::thread thread_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  const std::string kind = argc > 1 ? argv[1] : "single";
  rclcpp::Executor::SharedPtr executor;
  if (kind == "multi") executor = std::make_shared<rclcpp::executors::MultiThreadedExecutor>();
  if (kind == "static") executor = std::make_shared<rclcpp::executors::StaticSingleThreadedExecutor>();
  if (kind == "events")
    executor = std::make_shared<rclcpp::experimental::executors::EventsExecutor>();
  if (!executor) executor = std::make_shared<rclcpp::executors::SingleThreadedExecutor>();
  auto talker = std::make_shared<Talker>();
  auto listener = std::make_shared<Listener>();
  {
    ThreadedListener threaded(listener);
    executor->add_node(talker);
    executor->add_node(listener);
    executor->spin();
  }
  rclcpp::shutdown();
  return 0;
}
