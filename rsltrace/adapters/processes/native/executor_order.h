// The order in which an executor of rclcpp runs what one wait has found.
#pragma once

#include <rcl/wait.h>

#include <cstddef>
#include <vector>

namespace rsltrace {

// Where what is ready has its places in a wait set, in the order of the loop.
struct ReadyPlaces {
  std::vector<std::size_t> subscriptions;
  std::vector<std::size_t> timers;
  std::vector<std::size_t> clients;
  std::vector<std::size_t> services;
};

// Let an executor of rclcpp that has waited see them one after the other, each kind for itself. Who
// waits otherwise sees them all: it has an order of its own.
void show_in_order(const rcl_wait_set_t &set, const ReadyPlaces &ready);

}  // namespace rsltrace
