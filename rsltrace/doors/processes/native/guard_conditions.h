// Guard conditions: the process wakes itself with them, so the loop does not hear of most of them.
#pragma once

#include <rmw/types.h>

#include <vector>

#include "link.h"

namespace rsltrace {

struct GuardCondition {
  bool is_triggered = false;
  std::vector<Waiter *> waiters;  // threads that wait for it
};

inline GuardCondition &guard_condition(const rmw_guard_condition_t *handle) {
  return *static_cast<GuardCondition *>(handle->data);
}

void trigger(GuardCondition &condition);

// The condition of a node that is triggered when the graph has changed.
rmw_guard_condition_t *graph_condition(std::uint32_t node);
void forget_graph_condition(std::uint32_t node);
// The graph has changed since this process ran last.
void graph_has_changed();

}  // namespace rsltrace
