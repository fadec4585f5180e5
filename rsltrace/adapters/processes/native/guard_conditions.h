// Guard conditions: the process wakes itself with them, so the loop hears of those of the graph only.
#pragma once

#include <rmw/types.h>

#include <vector>

#include "link.h"

namespace rsltrace {

struct GuardCondition {
  bool is_triggered = false;
  bool is_of_graph = false;
  std::vector<Waiter *> waiters;  // threads that wait for it
};

inline GuardCondition &guard_condition(const rmw_guard_condition_t *handle) {
  return *static_cast<GuardCondition *>(handle->data);
}

void trigger(GuardCondition &condition);

// The condition of a node that is triggered when the graph has changed.
rmw_guard_condition_t *graph_condition(std::uint32_t node);
void forget_graph_condition(std::uint32_t node);
// The graph has changed since they were triggered last: whoever waits for them is to be woken.
void graph_has_changed();

}  // namespace rsltrace
