// RSLCPP's own nodes, unmodified: its headers, with the executor of the rclcpp that is installed.
#include <cmath>
#include <memory>
#include <rclcpp/rclcpp.hpp>
#include <rslcpp_helper_nodes/monitor.hpp>
#include <rslcpp_test/determinism/determinism_check.hpp>
#include <rslcpp_test/determinism/nodes.hpp>

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  {
    const rclcpp::NodeOptions options;
    rclcpp::executors::SingleThreadedExecutor executor;
    const auto monitor = std::make_shared<rslcpp::helper_nodes::SimulationMonitor>(
        [&executor](std::uint8_t) { executor.cancel(); }, options);
    const rclcpp::Node::SharedPtr nodes[] = {
        std::make_shared<NodeA>(options), std::make_shared<NodeB>(options),
        std::make_shared<NodeC>(options), std::make_shared<NodeD>(options), monitor};
    monitor->set_parameter(rclcpp::Parameter("timeout_s", 1000));  // the job ends the run
    for (const auto &node : nodes) executor.add_node(node);
    executor.spin();
  }
  check_final_states();
}
